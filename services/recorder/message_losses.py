# SPDX-License-Identifier: Apache-2.0
"""Messages missing from a recording: not received, by their sequence, or received and not written."""

from shared.recording import Drop

OVERLOAD = "overload"
"""Reason of a message that was not received: this process or a link was too slow."""

MessageSource = tuple[str, str]
"""Key and session; the sequence of each counts from 0."""


class MessageLosses:
    """Counts the missing messages by source. Messages before the first one received of a session do not count."""

    def __init__(self) -> None:
        self.n_missed = self.n_unwritten = 0
        self._next: dict[MessageSource, int] = {}
        self._missed: dict[tuple[str, MessageSource], tuple[int, int]] = {}  # reason, source -> first sequence, count

    def record_received(self, source: MessageSource, sequence: int) -> None:
        """Counts a received message; a gap in the sequence before it counts as missed."""
        expected = self._next.get(source, sequence)
        if sequence > expected:
            self.n_missed += sequence - expected
            self._add(OVERLOAD, source, expected, sequence - expected)
        self._next[source] = max(expected, sequence + 1)

    def record_unwritten(self, reason: str, source: MessageSource, sequence: int) -> None:
        """Counts a received message that is not in the file; reason: a code of shared/reasons.py."""
        self.n_unwritten += 1
        self._add(reason, source, sequence, 1)

    def take_drops(self, now: int) -> list[Drop]:
        """The messages missed since the last call, by reason and source, stamped `now` (ns)."""
        drops = [
            Drop(at=now, why=reason, key=key, session=session, first=first, n=n)
            for (reason, (key, session)), (first, n) in sorted(self._missed.items())
        ]
        self._missed = {}
        return drops

    def restore_drops(self, drops: list[Drop]) -> None:
        """Counts drops again that could not be written."""
        for drop in drops:
            self._add(drop.why, (drop.key, drop.session), drop.first, drop.n)

    def _add(self, reason: str, source: MessageSource, first: int, n: int) -> None:
        before, count = self._missed.get((reason, source), (first, 0))
        self._missed[(reason, source)] = (min(before, first), count + n)
