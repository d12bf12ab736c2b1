# SPDX-License-Identifier: Apache-2.0
"""The stack as pages see it: a tool's session that listens to what pages want, only while a page is open.

Its methods block, so the shell calls them on worker threads. `deliver` and `on_teleop` are called on Zenoh's threads.
"""

import threading
from collections.abc import Callable
from typing import Any

from services.dashboard.frames import request_named
from shared import requests, topics
from shared.codec import CodecError, envelope_of
from shared.reasons import NOT_RUNNING
from shared.runners.client import Client, refusal, request_outcome
from shared.runners.stack_listener import Deliver, StackListener
from shared.runners.transport import StackAddress

CLOCK_WAIT_S = 0.2  # for the simulator's clock, which ticks 50 times a second
ASK_LIMIT_S, MAP_LIMIT_S = 5.0, 20.0  # until a service has replied; the mapper may look for the robot


class StackLink(StackListener):
    """One session, opened and closed by its user. on_teleop: called while another tool drives."""

    def __init__(self, robot: str, where: StackAddress, deliver: Deliver, on_teleop: Callable[[], None]) -> None:
        super().__init__(robot, where, deliver)
        self.is_simulated = False
        self._on_teleop = on_teleop

    def connect(self) -> Client:
        """Opens the session, if it is not open. Raises UserError where no router answers."""
        if self.client is not None:
            return self.client
        client = super().connect()
        client.listen_raw(topics.TELEOP.key, self._hear_teleop)
        ticked = threading.Event()
        end = client.listen_raw(topics.CLOCK.key, lambda key, payload: ticked.set())
        self.is_simulated = ticked.wait(CLOCK_WAIT_S)
        end()
        return client

    def ask(self, key: str, payload: bytes) -> dict[str, Any]:
        """Sends a request of the core; the fields of the frame `reply` but for its `id`."""
        row, client = request_named(key), self.client
        if row is None or client is None:
            return refusal(NOT_RUNNING.code, "no connection to the stack", NOT_RUNNING.hint)
        return request_outcome(client, row, payload, MAP_LIMIT_S if row is requests.START_MAP else ASK_LIMIT_S)

    def _hear_teleop(self, key: str, payload: bytes) -> None:
        try:
            is_other = envelope_of(payload).publisher != "dashboard"
        except CodecError:
            return
        if is_other:
            self._on_teleop()
