# SPDX-License-Identifier: Apache-2.0
"""STOP of a tool, or its release, until the guard of the robot confirms it."""

import time

from shared import topics
from shared.config import UserError
from shared.messages import EmergencyStop, GuardState, GuardStatus
from shared.reasons import reason_text
from shared.runners.client import Client
from shared.runners.transport import StackAddress


def confirm_stop(client: Client, press: bool, by: str) -> None:
    """Presses or releases STOP, again and again until the guard confirms. The client follows topics.GUARD.

    Raises UserError where the guard does not confirm within 3 s.
    """

    def confirmed(status: GuardStatus) -> bool:
        return (status.state is GuardState.STOPPED) == press

    limit = time.monotonic() + 3.0
    while time.monotonic() < limit:
        client.publish(topics.ESTOP(EmergencyStop(client.now(), press, by)))
        if client.wait(topics.GUARD, lambda s: client.age(topics.GUARD) < 1 and confirmed(s), 0.1) is not None:
            return
    status = client.latest(topics.GUARD)
    if status is None:
        raise UserError(
            "the guard does not answer: STOP is not confirmed", "is it running? switch the robot off by hand"
        )
    raise UserError(
        f"the guard does not confirm: it is {status.state} ({reason_text(status.reason)})",
        "switch the robot off by hand",
    )


def confirm_stop_of(robot: str, where: StackAddress, press: bool, by: str) -> None:
    """The same for a robot of a router, with a session of its own."""
    with Client(robot, where) as client:
        client.follow(topics.GUARD)
        confirm_stop(client, press, by)
