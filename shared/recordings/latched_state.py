# SPDX-License-Identifier: Apache-2.0
"""The values that late subscribers would get: the last one of each latched key, merged where its class can."""

from collections.abc import Callable
from typing import NamedTuple

from shared import topics
from shared.codec import CodecError, Envelope, decode, encode, envelope_of
from shared.messages import Message
from shared.runners.host import merged


class Value(NamedTuple):
    """A latched key's value, as bytes with the envelope of the last message in it."""

    key: str
    type: type[Message]
    payload: bytes
    envelope: Envelope


class LatchedState:
    """The latched values after a sequence of messages."""

    def __init__(self) -> None:
        self._payloads: dict[str, bytes] = {}
        self._merged: dict[str, tuple[Message, Envelope]] = {}

    def take(self, key: str, payload: bytes) -> bool:
        """Applies a message of a key. Returns False, without a change, where it is not latched or not valid."""
        topic = topics.topic_of(key)
        if topic is None or not topic.latched:
            return False
        if not hasattr(topic.type, "merged"):
            self._payloads[key] = payload
            return True
        try:
            message, envelope = decode(topic.type, payload)
        except CodecError:
            return False
        before = self._merged.get(key)
        self._merged[key] = merged(before[0] if before else None, message), envelope
        return True

    def take_whole(self, key: str, payload: bytes) -> bool:
        """Applies a whole latched value. Returns False where it is not newer than the present one, or not valid."""
        topic = topics.topic_of(key)
        if topic is None or not topic.latched:
            return False
        try:
            message, envelope = decode(topic.type, payload)
        except CodecError:
            return False
        present = self._envelope(key)
        if present is not None and present.sent >= envelope.sent:
            return False
        if hasattr(topic.type, "merged"):
            self._merged[key] = message, envelope
        else:
            self._payloads[key] = payload
        return True

    def values(self) -> list[Value]:
        """The present values, sorted by key."""
        values = []
        for key in sorted({*self._payloads, *self._merged}):
            envelope = self._envelope(key)
            topic = topics.topic_of(key)
            if envelope is not None and topic is not None:  # a late subscriber would drop it, too
                values.append(Value(key, topic.type, self.value(key)(), envelope))
        return values

    def value(self, key: str) -> Callable[[], bytes]:
        """A function that returns the bytes of a key's present value, also later. KeyError where there is none."""
        if key in self._merged:
            message, envelope = self._merged[key]
            return lambda: encode(message, envelope)
        payload = self._payloads[key]
        return lambda: payload

    def _envelope(self, key: str) -> Envelope | None:
        """The envelope of the last message in a key's value; None where there is none, or it is not valid."""
        if key in self._merged:
            return self._merged[key][1]
        try:
            return envelope_of(self._payloads[key])
        except (KeyError, CodecError):
            return None
