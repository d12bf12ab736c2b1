# SPDX-License-Identifier: Apache-2.0
"""STOP of a tool, or its release, until the guard of the robot confirms it."""

import time

from shared import reasons, topics
from shared.config import UserError
from shared.messages import EmergencyStop, GuardState, GuardStatus
from shared.reasons import reason_text
from shared.runners.client import Client
from shared.runners.transport import StackAddress
from shared.types import NS_PER_S

PATIENCE_S = 3.0
STATUS_S = 0.5  # s within which a new client has the guard's newest status
LATCHED = tuple(reason.code for reason in (reasons.WHEEL_STUCK, reasons.WHEEL_ASTRAY, reasons.ENCODERS_BROKEN))
"""Faults that a release ends."""


def confirm_stop(client: Client, press: bool, by: str) -> None:
    """Presses or releases STOP, again and again until the guard confirms. The client follows topics.GUARD.

    Only a status that came after the first order confirms it. A release also ends latched faults. It keeps its first
    stamp, so that a STOP that was pressed meanwhile holds. That is the time of the call, by the guard's clock where it
    is ahead: a new client does not know a simulator's clock yet.
    Raises UserError where the guard does not confirm within 3 s.
    """
    called, released_at = time.monotonic(), client.now()
    known = None if press else client.wait(topics.GUARD, lambda _: True, STATUS_S)
    began = time.monotonic()
    if known is not None:
        released_at = max(released_at, known.stamp - round((began - called) * NS_PER_S))

    def confirms(status: GuardStatus) -> bool:
        is_stopped = status.state is GuardState.STOPPED
        holds = is_stopped if press else not is_stopped and status.reason not in LATCHED
        return holds and client.age(topics.GUARD) < time.monotonic() - began

    while time.monotonic() < began + PATIENCE_S:
        client.publish(topics.ESTOP(EmergencyStop(client.now() if press else released_at, press, by)))
        if client.wait(topics.GUARD, confirms, 0.1) is not None:
            return
    status = client.latest(topics.GUARD)
    if status is None:
        raise UserError(
            "the guard does not answer: STOP is not confirmed", "is it running? switch the robot off by hand"
        )
    hint = (
        "switch the robot off by hand" if press else "see the reason, and guard/status: zenav topic echo guard/status"
    )
    raise UserError(f"the guard does not confirm: it is {status.state} ({reason_text(status.reason)})", hint)


def confirm_stop_of(robot: str, where: StackAddress, press: bool, by: str) -> None:
    """The same for a robot of a router, with a session of its own."""
    with Client(robot, where) as client:
        client.follow(topics.GUARD)
        confirm_stop(client, press, by)
