# SPDX-License-Identifier: Apache-2.0
"""The channels that clients see: one per Foxglove topic, advertised at its first message, with its last value.

A message is decoded and converted only where a client has subscribed to its channel.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from foxglove import Channel, Context

from shared import topics
from shared.codec import CodecError, decode, envelope_of
from shared.config import Robot
from shared.topics import topic_of
from zenav.foxglove.schemas import MessageContext, SchemaRow, encode_message, encoding_of, rows_of


@dataclass(frozen=True, slots=True)
class Outlet:
    """A row and the channel that carries it."""

    row: SchemaRow
    channel: Channel


class Channels:
    """Everything that is shown, by the stack's keys. One thread calls it; `ask` may come from others."""

    def __init__(self, context: Context, robot: Robot) -> None:
        self._context, self._robot = context, robot
        self._channels: dict[str, Channel] = {}
        self._outlets: dict[str, tuple[Outlet, ...]] = {}
        self._last: dict[str, bytes] = {}
        self._makers: dict[str, Callable[[], Any]] = {}
        self._asked: deque[str] = deque()

    def declare(self, row: SchemaRow, last: Callable[[], Any] | None = None) -> Channel:
        """A row's channel. last: makes the value that a late client gets, or None."""
        if row.topic not in self._channels:
            encoding, schema = encoding_of(row.type)
            self._channels[row.topic] = Channel(
                row.topic, schema=schema, message_encoding=encoding, context=self._context
            )
        if last is not None:
            self._makers[row.topic] = last
        return self._channels[row.topic]

    def wanted(self, topic: str) -> bool:
        """Whether a client listens to a Foxglove topic."""
        return topic in self._channels and self._channels[topic].has_sinks()

    def send(self, row: SchemaRow, value: Any, at: int) -> None:
        """Sends a value of a row at `at` (ns, the stack's clock); None is nothing to send."""
        if value is not None:
            self.declare(row).log(encode_message(value), log_time=max(0, at))

    def show(self, key: str, payload: bytes) -> None:
        """Sends a payload on a key to the clients that subscribed."""
        outlets = self._outlets_of(key)
        if self._overtaken(key, payload):
            return
        if _kept(key):
            self._last[key] = payload
        wanted = [outlet.row for outlet in outlets if outlet.channel.has_sinks()]
        if wanted:
            self._shown(key, payload, wanted)

    def ask(self, topic: str) -> None:
        """A client has begun to listen to a Foxglove topic: `answer` sends it what is there."""
        self._asked.append(topic)

    def answer(self, now: int) -> None:
        """Sends the last values of what was asked for since the last call."""
        asked = set()
        while self._asked:
            asked.add(self._asked.popleft())
        for topic in asked:
            if topic in self._makers:
                value = self._makers[topic]()
                if value is not None:
                    self._channels[topic].log(encode_message(value), log_time=max(0, now))
            for key, payload in self._last.items():
                rows = [outlet.row for outlet in self._outlets_of(key) if outlet.row.topic == topic]
                if rows:
                    self._shown(key, payload, rows)

    def _overtaken(self, key: str, payload: bytes) -> bool:
        """Whether it is a value kept for late joiners that is older than what has come meanwhile."""
        topic, last = topic_of(key), self._last.get(key)
        if topic is None or not topic.latched or last is None:
            return False
        try:
            before, now = envelope_of(last), envelope_of(payload)
        except CodecError:
            return False  # its decoder reports the error
        return now.session == before.session and now.sequence < before.sequence

    def _outlets_of(self, key: str) -> tuple[Outlet, ...]:
        if key not in self._outlets:
            self._outlets[key] = tuple(Outlet(row, self.declare(row)) for row in rows_of(key))
        return self._outlets[key]

    def _shown(self, key: str, payload: bytes, rows: list[SchemaRow]) -> None:
        topic = topic_of(key)
        if topic is None:
            return
        try:
            message, envelope = decode(topic.type, payload)
        except CodecError:
            return  # its reader among the services counts and reports it
        seen = MessageContext(envelope.publisher, self._robot)
        for row in rows:
            self.send(row, row.make(message, seen), envelope.sent)


def _kept(key: str) -> bool:
    """Whether a late client gets the last message on a key: where the next one may be long in coming."""
    topic = topic_of(key)
    return topic is not None and (topic.latched or topic is topics.HEALTH)
