# SPDX-License-Identifier: Apache-2.0
"""Which messages on a key are accepted: those in order, from the registered publisher, from one process at a time.

The order of arrival is not enough. After a network fault old messages arrive in a burst. A second process may publish
on the key. The sender's session, sequence and send time decide.
"""

from enum import Enum, auto

from shared.codec import Envelope
from shared.messages import Message
from shared.stamps import FUTURE, precedes
from shared.topics import Topic

SILENT_AFTER = 300_000_000
"""ns without a message after which a stream's publisher counts as gone and another may take its place."""


class Verdict(Enum):
    """TAKE; GAP: take, messages before it were lost; OLD: out of order or repeated; INTRUDER: another publisher."""

    TAKE = auto()
    GAP = auto()
    OLD = auto()
    INTRUDER = auto()


class Admission:
    """Filter of the messages of one key, in the order of arrival."""

    def __init__(self, topic: Topic[Message]) -> None:
        self._topic = topic
        # events of several publishers, as STOP, whose clocks differ: each counts, and its stamp says for what
        self._is_of_several = topic.hz == 0 and topic.by != "*" and len(topic.publishers) > 1
        self.session = ""
        """Of the last message that was taken; empty before the first."""
        self._sequence = -1
        self._sent = 0
        self.heard = 0
        """ns, the stack's clock, when the last message was taken."""
        self._arrived = -1  # the last sequence that came as a message, not as a kept value
        self.words = ""
        """Fault of the last message that was OLD; none where a kept value had brought it already."""
        self.complete = True
        """Whether no message of the publisher's session is missing since its first one, or since a latched value."""

    def judge(self, envelope: Envelope, now: int, kept: bool = False) -> Verdict:
        """The verdict on a message that is handled at `now` (ns, the stack's clock).

        kept: a latched value for late subscribers, which contains all messages up to its sequence. It is accepted also
        where its last message was accepted before, if an earlier one is missing.
        """
        if envelope.publisher not in self._topic.publishers:
            return Verdict.INTRUDER
        if envelope.session == self.session:
            heard = envelope.sequence == self._sequence and (self.complete or not kept)
            if envelope.sequence < self._sequence or heard:
                self.words = "the sequence stands still" if heard else "the sequence goes back"
                if not kept and envelope.sequence > self._arrived:
                    self._arrived, self.words = envelope.sequence, ""
                return Verdict.OLD
            gap = envelope.sequence > self._sequence + 1
            self.complete = kept or (self.complete and not gap)
        elif self._topic.hz == 0:
            if (kept or not self._is_of_several) and precedes(envelope.sent, self._sent, now):
                self.words = "sent before the last one"
                return Verdict.OLD
            gap = False
        else:
            if self.session and 0 <= now - self.heard < SILENT_AFTER:
                return Verdict.INTRUDER
            if precedes(envelope.sent, self._sent, now):
                self.words = "sent before the last one"
                return Verdict.OLD
            gap = False
        if envelope.session != self.session:
            self.complete = kept or envelope.sequence == 0
            self._arrived = -1
        if not kept:
            self._arrived = envelope.sequence
        self.session, self._sequence, self.heard = envelope.session, envelope.sequence, now
        newest = self._sent if self._is_of_several and self._sent <= now + FUTURE else 0
        self._sent = max(min(envelope.sent, now), newest)  # a clock that is ahead must not make later messages old
        return Verdict.GAP if gap else Verdict.TAKE
