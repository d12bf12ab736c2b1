# SPDX-License-Identifier: Apache-2.0
"""A tool's session that listens to some keys of the stack, and to others from time to time: for bridges of services.

Its methods block. `deliver` is called on Zenoh's threads.
"""

from collections.abc import Callable
from functools import partial

from shared.runners.client import Client
from shared.runners.transport import LatchedReader, StackAddress, oversize
from shared.topics import topic_of

Deliver = Callable[[str, bytes, bool], None]
"""(key, payload, latched): a message; latched: the value for late subscribers."""


class StackListener:
    """One session, opened and closed by its user."""

    def __init__(self, robot: str, where: StackAddress, deliver: Deliver) -> None:
        self.robot, self._where, self._deliver = robot, where, deliver
        self.client: Client | None = None
        self._endings: dict[str, list[Callable[[], None]]] = {}  # by key

    def connect(self) -> Client:
        """Opens the session, if it is not open. Raises UserError where no router answers."""
        if self.client is None:
            client = Client(self.robot, self._where)
            client.__enter__()
            self.client = client
        return self.client

    def close(self) -> None:
        """Closes the session."""
        if self.client is not None:
            self.client.__exit__(None, None, None)
        self.client, self._endings = None, {}

    def listen_to(self, keys: frozenset[str]) -> None:
        """Listens to these keys (without the robot's name) from now on, and to no others."""
        if self.client is None:
            return
        for key in self._endings.keys() - keys:
            for end in self._endings.pop(key):
                end()
        for key in keys - self._endings.keys():
            self._endings[key] = self._listen(self.client, key)

    def pass_on(self, key: str, payload: bytes) -> None:
        """Gives the stack another robot's message. key: with that robot's name."""
        if self.client is not None:
            self.client.put_raw(key, payload)

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
