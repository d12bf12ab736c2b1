# SPDX-License-Identifier: Apache-2.0
"""The stack as pages see it: a tool's session that listens to what pages want, only while a page is open.

Its methods block, so the shell calls them on worker threads. `deliver` and `on_teleop` are called on Zenoh's threads.
"""

import threading
from collections.abc import Callable
from functools import partial
from typing import Any

from services.dashboard.frames import request_named
from shared import requests, topics
from shared.codec import CodecError, envelope_of
from shared.reasons import NOT_RUNNING
from shared.runners.client import Client, refusal, request_outcome
from shared.runners.transport import LatchedReader, StackAddress, oversize
from shared.topics import topic_of

CLOCK_WAIT_S = 0.2  # for the simulator's clock, which ticks 50 times a second
ASK_LIMIT_S, MAP_LIMIT_S = 5.0, 20.0  # until a service has replied; the mapper may look for the robot
Deliver = Callable[[str, bytes, bool], None]
"""(key, payload, latched): a message; latched: the value for late subscribers."""


class StackLink:
    """One session, opened and closed by its user. on_teleop: called while another tool drives."""

    def __init__(self, robot: str, where: StackAddress, deliver: Deliver, on_teleop: Callable[[], None]) -> None:
        self.robot, self._where = robot, where
        self.is_simulated = False
        self._deliver, self._on_teleop = deliver, on_teleop
        self._client: Client | None = None
        self._endings: dict[str, list[Callable[[], None]]] = {}  # by key

    def open(self) -> None:
        """Opens the session, if it is not open. Raises UserError where no router answers."""
        if self._client is not None:
            return
        client = Client(self.robot, self._where)
        client.__enter__()
        self._client = client
        client.listen_raw(topics.TELEOP.key, self._hear_teleop)
        ticked = threading.Event()
        end = client.listen_raw(topics.CLOCK.key, lambda key, payload: ticked.set())
        self.is_simulated = ticked.wait(CLOCK_WAIT_S)
        end()

    def close(self) -> None:
        """Closes the session."""
        if self._client is not None:
            self._client.__exit__(None, None, None)
        self._client, self._endings = None, {}

    def listen_to(self, keys: frozenset[str]) -> None:
        """Listens to these keys (without the robot's name) from now on, and to no others."""
        if self._client is None:
            return
        for key in self._endings.keys() - keys:
            for end in self._endings.pop(key):
                end()
        for key in keys - self._endings.keys():
            self._endings[key] = self._listen(self._client, key)

    def ask(self, key: str, payload: bytes) -> dict[str, Any]:
        """Sends a request of the core; the fields of the frame `reply` but for its `id`."""
        row, client = request_named(key), self._client
        if row is None or client is None:
            return refusal(NOT_RUNNING.code, "no connection to the stack", NOT_RUNNING.hint)
        return request_outcome(client, row, payload, MAP_LIMIT_S if row is requests.START_MAP else ASK_LIMIT_S)

    def _listen(self, client: Client, key: str) -> list[Callable[[], None]]:
        end = client.listen_raw(key, self._hear)
        topic = topic_of(key)
        if topic is None or not topic.latched:
            return [end]
        reader = LatchedReader(client.session, f"{self.robot}/{key}", partial(self._hear_latched, key))
        return [end, reader.close]

    def _hear(self, key: str, payload: bytes) -> None:
        if not oversize(payload):
            self._deliver(key, payload, False)

    def _hear_latched(self, key: str, payload: bytes) -> None:
        self._deliver(key, payload, True)

    def _hear_teleop(self, key: str, payload: bytes) -> None:
        try:
            is_other = envelope_of(payload).publisher != "dashboard"
        except CodecError:
            return
        if is_other:
            self._on_teleop()
