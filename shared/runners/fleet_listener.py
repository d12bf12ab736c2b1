# SPDX-License-Identifier: Apache-2.0
"""The sessions of a fleet's tool: one for each stack or router, that hears every robot there."""

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from types import TracebackType
from typing import Any

import zenoh

from shared.codec import CodecError, decode
from shared.robot_view import FLEET_TOPICS, RobotView
from shared.runners import transport
from shared.runners.presence import presences
from shared.runners.transport import stack_address
from shared.topics import Topic

Sample = tuple[str, Topic[Any], str, bytes, float, int]
"""stack, topic, key, payload, s (monotonic), ns (wall clock)"""


class FleetListener:
    """Hears every robot of some stacks while its `with` block runs. Zenoh's threads only file bytes."""

    def __init__(self, stacks: list[str], topics: Sequence[Topic[Any]] = FLEET_TOPICS) -> None:
        self._stacks, self._topics = stacks, topics
        self._sessions: dict[str, zenoh.Session] = {}
        self._waiting: deque[Sample] = deque()
        self._changed = threading.Event()
        self._readers: list[Any] = []
        self._views: dict[tuple[str, str], RobotView] = {}

    def __enter__(self) -> "FleetListener":
        for stack in self._stacks:
            session = self._sessions[stack] = transport.opened(stack_address(stack))
            for topic in self._topics:
                self._readers.append(session.declare_subscriber(f"*/{topic.key}", partial(self._file, stack, topic)))
                if topic.latched:
                    session.get(
                        f"*/{topic.key}",
                        partial(self._file_reply, stack, topic),
                        target=zenoh.QueryTarget.ALL,
                        consolidation=zenoh.ConsolidationMode.NONE,
                        timeout=2.0,
                    )
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        for session in self._sessions.values():
            session.close()  # type: ignore[no-untyped-call]  # zenoh's own

    def hear(self, seconds: float, until: Callable[[list[RobotView]], bool] = lambda views: False) -> list[RobotView]:
        """The robots, by name and stack, after `seconds`, or as soon as `until` holds for them."""
        end = time.monotonic() + seconds
        while True:
            self._decode()
            if until(self.views) or time.monotonic() >= end:
                return self.views
            self._changed.wait(max(0.0, min(0.1, end - time.monotonic())))
            self._changed.clear()

    @property
    def views(self) -> list[RobotView]:
        """The robots that were heard, by name and stack."""
        return [self._views[key] for key in sorted(self._views)]

    def ask_addresses(self) -> None:
        """Reads where each robot was started, and with which version."""
        for stack, session in self._sessions.items():
            for view in self._views.values():
                view.addresses = [] if view.stack == stack else view.addresses
            for presence in presences(session):
                view = self._view(presence.name, stack)
                view.addresses.append((presence.address, presence.version))

    def _view(self, name: str, stack: str) -> RobotView:
        return self._views.setdefault((name, stack), RobotView(name, stack))

    def _file(self, stack: str, topic: Topic[Any], sample: zenoh.Sample) -> None:
        at, now = time.monotonic(), time.time_ns()
        self._waiting.append((stack, topic, str(sample.key_expr), sample.payload.to_bytes(), at, now))
        self._changed.set()

    def _file_reply(self, stack: str, topic: Topic[Any], reply: zenoh.Reply) -> None:
        if reply.ok is not None:
            self._file(stack, topic, reply.ok)

    def _decode(self) -> None:
        for _ in range(len(self._waiting)):
            stack, topic, key, payload, at, now = self._waiting.popleft()
            try:
                message, envelope = decode(topic.type, payload)
            except CodecError:
                continue  # the robot's own services count it
            if envelope.publisher in topic.publishers:
                self._view(key.partition("/")[0], stack).add(topic, message, envelope, at, now)
