# SPDX-License-Identifier: Apache-2.0
"""Which messages does a service not use, and why? The one rule for stamps, the counts for health, the words for people.

A message is used when its stamp is at most so old, at most `FUTURE` ahead of our clock, and newer than the last one.
The runner adds what it rejects itself: sequence numbers that do not rise, messages that are too large.
"""

from dataclasses import dataclass
from enum import StrEnum

from shared.stamps import FUTURE, supersedes

RECENT = 500_000_000
"""ns after which an input without messages counts as silent."""
LASTING = 50_000_000
"""ns over which an input's messages must be wrong: a burst after a moment's load is over sooner."""
MINUTE, HOUR, DAY, YEAR = 60.0, 3600.0, 86400.0, 365.25 * 86400  # s


class Kind(StrEnum):
    """Why a message is rejected."""

    OLD = "old"  # its stamp
    AHEAD = "ahead"  # its stamp, of our clock
    SEQUENCE = "sequence"  # its stamp or sequence number is not above the last one's
    SIZE = "size"  # over the limit of a message
    CONTENT = "content"  # does not fit the configuration
    REPEATED = "repeated"  # an old measurement under a new stamp


@dataclass(frozen=True, slots=True)
class _Arrival:
    """The newest message of an input: when it came, how old its stamp was, what was wrong with it, since when. ns.

    kind: None where it was used.
    """

    at: int
    age: int
    kind: Kind | None
    words: str
    since: int


class Rejections:
    """What one service rejected of each input. Inputs are named by their topic's key."""

    def __init__(self) -> None:
        self.counts: dict[tuple[str, Kind], int] = {}
        """Rejected messages since the start, by key and kind."""
        self.words: dict[tuple[str, Kind], str] = {}
        """What was wrong with the newest of them."""
        self._arrivals: dict[str, _Arrival] = {}

    def judge(self, key: str, stamp: int, last: int | None, now: int, max_age: float, unfit: str = "") -> bool:
        """Whether a message may be used; one that may not is counted.

        stamp: ns, when it was true; of a sweep, when it ended.  last: ns, that of the newest one in use.
        now: ns.  max_age: s.  unfit: what in it does not fit the configuration, in words.
        """
        age = now - stamp
        if age < -FUTURE:
            kind, words = Kind.AHEAD, f"stamps are {duration(-age)} ahead"
        elif age > round(max_age * 1e9):
            kind, words = Kind.OLD, _old(age)
        elif not supersedes(stamp, last, now):
            kind, words = Kind.SEQUENCE, "stamps stand still" if stamp == last else "stamps go back"
        elif unfit:
            kind, words = Kind.CONTENT, unfit
        else:
            self._arrivals[key] = _Arrival(now, age, None, "", now)
            return True
        self.reject(key, kind, words, now, age=age)
        return False

    def reject(self, key: str, kind: Kind, words: str, now: int, n: int = 1, age: int = 0) -> None:
        """Counts `n` messages that came until `now` (ns) and are not used; `words` say what is wrong with them."""
        self.count(key, kind, words, n)
        before = self._arrivals.get(key)
        since = before.since if before is not None and before.kind and _within(now - before.at) else now
        self._arrivals[key] = _Arrival(now, age, kind, words, since)

    def count(self, key: str, kind: Kind, words: str, n: int = 1) -> None:
        """Counts messages of which only a part is not used: the input itself is well."""
        self.counts[key, kind] = self.counts.get((key, kind), 0) + n
        self.words[key, kind] = words

    def why(self, key: str) -> str:
        """What was wrong with the newest message of an input; empty where it was used."""
        arrival = self._arrivals.get(key)
        return arrival.words if arrival is not None else ""

    def refused(self, key: str, now: int) -> str:
        """What is wrong with the stamps, sequence or size of this input's messages, as `scan: stamps are 1.0 s ahead`.

        Empty while they are used, when they have not been wrong for `LASTING` yet, and when none comes.
        """
        arrival = self._lasting(key, now)
        return _named(key, arrival.words) if arrival and arrival.kind is not Kind.CONTENT else ""

    def unfit(self, key: str, now: int) -> str:
        """What in the messages that come on this input does not fit the configuration; empty as `refused` is."""
        arrival = self._lasting(key, now)
        return arrival.words if arrival and arrival.kind is Kind.CONTENT else ""

    def told(self, key: str, now: int) -> str:
        """Why this input is old though its messages come: as `refused`, or they are late already when they come.

        To be asked when the input is old; empty when it is silent.
        """
        arrival = self._arrivals.get(key)
        if arrival is None or arrival.kind or not 0 <= now - arrival.at < arrival.age:
            return self.refused(key, now)
        return _named(key, _old(arrival.age))

    def _lasting(self, key: str, now: int) -> _Arrival | None:
        """The newest message, where messages come and have been wrong for `LASTING`."""
        arrival = self._arrivals.get(key)
        if arrival is None or arrival.kind is None or arrival.at - arrival.since < LASTING:
            return None
        return arrival if _within(now - arrival.at) else None


def duration(ns: int) -> str:
    """A duration (ns) in the unit that people read it in."""
    seconds = ns * 1e-9
    if seconds < 2 * MINUTE:
        return f"{seconds:.1f} s"
    for unit, name, until in ((MINUTE, "min", 0.99 * HOUR), (HOUR, "h", 2 * DAY), (DAY, "days", 2 * YEAR)):
        if seconds < until:
            return f"{seconds / unit:.0f} {name}"
    return f"{seconds / YEAR:.0f} years"


def _old(age: int) -> str:
    """ns.  A stamp of decades ago is one in seconds, or was never set."""
    return f"stamps are {duration(age)} old" + ("; are they ns?" if age > YEAR * 1e9 else "")


def _named(key: str, words: str) -> str:
    return f"{key.rpartition('/')[2]}: {words}"


def _within(silence: int) -> bool:
    return 0 <= silence <= RECENT
