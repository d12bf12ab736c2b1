# SPDX-License-Identifier: Apache-2.0
"""What was missed: messages that never came, by their sequence, and those that came and could not be written."""

from shared.recording import Drop

OVERLOAD = "overload"
"""Why a message did not come: this process or a link was too slow for it."""

Source = tuple[str, str]
"""Key and session: what counts its messages from 0."""


class Losses:
    """Counts by source. What a session sent before the recorder heard of it is not missed."""

    def __init__(self) -> None:
        self.n_missed = self.n_unwritten = 0
        self._next: dict[Source, int] = {}
        self._missed: dict[tuple[str, Source], tuple[int, int]] = {}  # why, source -> first sequence, count

    def came(self, source: Source, sequence: int) -> None:
        """A message came; those between it and the one before did not."""
        expected = self._next.get(source, sequence)
        if sequence > expected:
            self.n_missed += sequence - expected
            self._add(OVERLOAD, source, expected, sequence - expected)
        self._next[source] = max(expected, sequence + 1)

    def unwritten(self, why: str, source: Source, sequence: int) -> None:
        """A message that came is not in the file, for a reason."""
        self.n_unwritten += 1
        self._add(why, source, sequence, 1)

    def taken(self, now: int) -> list[Drop]:
        """What was missed since the last call, noticed by `now` (ns), by reason."""
        found = [Drop(now, why, *source, first, n) for (why, source), (first, n) in sorted(self._missed.items())]
        self._missed = {}
        return found

    def give_back(self, drops: list[Drop]) -> None:
        """They could not be written down either."""
        for drop in drops:
            self._add(drop.why, (drop.key, drop.session), drop.first, drop.n)

    def _add(self, why: str, source: Source, first: int, n: int) -> None:
        before, count = self._missed.get((why, source), (first, 0))
        self._missed[(why, source)] = (min(before, first), count + n)
