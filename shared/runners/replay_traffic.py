# SPDX-License-Identifier: Apache-2.0
"""Messages of a replay: the recorded ones, and in place of some the new publications of replayed services."""

from collections.abc import Iterator
from typing import TypeVar

from shared import topics
from shared.codec import CodecError, Envelope, decode, envelope_of
from shared.config import UserError
from shared.messages import Message
from shared.recording import Recording
from shared.runners.host import LATCHED, MESSAGE, Sent, merged
from shared.runners.journal import Event, Life
from shared.topics import TOPICS, Topic, key_of

M = TypeVar("M", bound=Message)


class ReplayTraffic:
    """Messages by (key, session) and sequence, recorded or published by a replayed service.

    ended: the completed sessions, and the time (ns) of their last event.
    """

    def __init__(self, recording: Recording, lives: list[Life], all_lives: list[Life]) -> None:
        self.sessions = {life.session for life in lives}
        self.ended = {life.session: 0 for life in lives if not life.events}
        self.recorded: dict[tuple[str, str], dict[int, bytes]] = {}
        self.held: dict[str, tuple[Message, Envelope]] = {}  # by key, the latched values when the recording began
        self._payloads: dict[tuple[str, str], dict[int, bytes]] = {}
        self._kept: dict[tuple[str, str, int], bytes] = {}
        self._restored = dict(_restored_values(all_lives))
        taken = {(e.key, e.session) for life in lives for e in life.events if e.kind in (MESSAGE, LATCHED)}
        for source, event in self._restored.items():
            if source in taken:
                taken.add((event.key, event.session))
        said = {key_of(t, life.name) for life in lives for t in TOPICS if life.name in t.publishers}
        keys = said | {key for key, _ in taken} | set(topics.LATCHED_KEYS)
        whole: dict[tuple[str, str], dict[int, bytes]] = {}
        for entry in recording.entries(keys):
            try:
                envelope = envelope_of(entry.payload)
            except CodecError:
                continue  # no service accepted it
            source, topic = (entry.key, envelope.session), topics.topic_of(entry.key)
            if entry.latched and topic is not None:
                self.held.setdefault(entry.key, (valid(topic.type, entry.payload), envelope))
                self._kept[(*source, envelope.sequence)] = entry.payload
                if source in taken:
                    whole.setdefault(source, {}).setdefault(envelope.sequence, entry.payload)
            elif envelope.session in self.sessions and topic not in (topics.HEALTH, topics.JOURNAL):
                self.recorded.setdefault(source, {})[envelope.sequence] = entry.payload
            elif source in taken:  # of several with one sequence number, the first was taken and the others rejected
                self._payloads.setdefault(source, {}).setdefault(envelope.sequence, entry.payload)
        for source, payloads in whole.items():
            self._payloads[source] = payloads | self._payloads.get(source, {})

    def publish(self, sent: Sent) -> bool:
        """Adds a publication of a replayed service. Returns whether it equals the recorded one."""
        source, sequence = (sent.key, sent.envelope.session), sent.envelope.sequence
        self._payloads.setdefault(source, {})[sequence] = sent.payload
        return self.recorded.get(source, {}).get(sequence, sent.payload) == sent.payload

    def payload(self, key: str, session: str, sequence: int) -> bytes:
        """The bytes of a message; the recorded ones after the last journal of a killed service. Raises MissingError."""
        source = (key, session)
        found = self._payloads.get(source, {}).get(sequence)
        if found is None and session in self.ended:
            found = self.recorded.get(source, {}).get(sequence)
            if found is not None and envelope_of(found).sent < self.ended[session]:
                found = None
        if found is None:
            raise MissingError(key, session, sequence)
        return found

    def kept(self, key: str, session: str, sequence: int) -> bytes | None:
        """A recorded latched value; None where its publisher is replayed."""
        return None if session in self.sessions else self._kept.get((key, session, sequence))

    def latched(self, topic: Topic[Message], key: str, session: str, sequence: int) -> Message:
        """The latched value after a message: all messages of its session up to there, merged. Raises MissingError.

        It includes the value that a restarted publisher restored.
        """
        kept, first, held = None, 0, self.held.get(key)
        before = self._restored.get((key, session))
        if held is not None and held[1].session == session and held[1].sequence <= sequence:
            kept, first = held[0], held[1].sequence + 1
        elif before is not None:
            kept = self.latched(topic, key, before.session, before.number)
        for number in range(first, sequence + 1):
            kept = merged(kept, valid(topic.type, self.payload(key, session, number)))
        if kept is None:
            raise MissingError(key, session, sequence)
        return kept


def _restored_values(lives: list[Life]) -> Iterator[tuple[tuple[str, str], Event]]:
    """By (key, session): the event in which a restarted service got its own latched value back."""
    for life in lives:
        for event in life.events:
            topic = topics.topic_of(event.key) if event.kind == LATCHED else None
            if topic is not None and life.name in topic.publishers:
                yield (event.key, life.session), event


class MissingError(Exception):
    """The message is not in the recording, or not yet published."""

    def __init__(self, key: str, session: str, sequence: int) -> None:
        super().__init__(f"{key} #{sequence} of {session} is missing")
        self.session = session


def valid(type_: type[M], payload: bytes) -> M:
    """A decoded message of a recording. Raises UserError where it is not valid in this version."""
    try:
        return decode(type_, payload)[0]
    except CodecError as error:
        what = f"a recorded {type_.__name__} is not valid in this version: {error}"
        raise UserError(what, "replay with the version that recorded it") from None
