# SPDX-License-Identifier: Apache-2.0
"""Which messages does a service not use, and why? The rule for stamps, counts for health, and words for the user.

A message is used when its stamp is newer than the last one, within a maximum age, and at most `FUTURE` ahead of our
clock. The runner adds its own rejections: sequence numbers that do not rise, messages that are too large.
"""

from dataclasses import dataclass
from enum import StrEnum

from shared.stamps import FUTURE, supersedes

RECENT = 500_000_000
"""ns after which an input without messages counts as silent."""
LASTING = 50_000_000
"""ns for which an input's messages must be wrong: a burst after high load is shorter."""
MINUTE, HOUR, DAY, YEAR = 60.0, 3600.0, 86400.0, 365.25 * 86400  # s


class RejectionCause(StrEnum):
    """Why a message is rejected."""

    OLD = "old"  # its stamp
    AHEAD = "ahead"  # its stamp, of our clock
    SEQUENCE = "sequence"  # its stamp or sequence number is not above the last one's
    SIZE = "size"  # over the limit of a message
    CONTENT = "content"  # does not fit the configuration
    REPEATED = "repeated"  # an old measurement under a new stamp
    ACCESS = "access"  # its sender may not send it


@dataclass(frozen=True, slots=True)
class _Arrival:
    """The newest message of an input: arrival (ns), age of its stamp (ns), and its fault since when (ns).

    kind: None where it was used.
    """

    at: int
    age: int
    kind: RejectionCause | None
    detail: str
    since: int


class Rejections:
    """Rejected messages of one service, by the topic key of the input. now: ns."""

    def __init__(self) -> None:
        self.counts: dict[tuple[str, RejectionCause], int] = {}
        """Rejected messages since the start, by key and kind."""
        self.words: dict[tuple[str, RejectionCause], str] = {}
        """Fault of the newest of them."""
        self._arrivals: dict[str, _Arrival] = {}

    def judge(self, key: str, stamp: int, last: int | None, now: int, max_age: float, unfit: str = "") -> bool:
        """Whether a message may be used; one that may not is counted.

        stamp: ns; of a sweep, its end.  last: ns, stamp of the newest message in use.  now: ns.  max_age: s.
        unfit: contradiction to the configuration, in words; empty without one.
        """
        age = now - stamp
        if age < -FUTURE:
            kind, detail = RejectionCause.AHEAD, f"stamps are {duration(-age)} ahead"
        elif age > round(max_age * 1e9):
            kind, detail = RejectionCause.OLD, _old(age)
        elif not supersedes(stamp, last, now):
            kind, detail = RejectionCause.SEQUENCE, "stamps stand still" if stamp == last else "stamps go back"
        elif unfit:
            kind, detail = RejectionCause.CONTENT, unfit
        else:
            self._arrivals[key] = _Arrival(now, age, None, "", now)
            return True
        self.reject(key, kind, detail, now, age=age)
        return False

    def reject(self, key: str, kind: RejectionCause, detail: str, now: int, n: int = 1, age: int = 0) -> None:
        """Counts `n` messages until `now` (ns) that are not used. detail: their fault."""
        self.count(key, kind, detail, n)
        before = self._arrivals.get(key)
        since = before.since if before is not None and before.kind and _within(now - before.at) else now
        self._arrivals[key] = _Arrival(now, age, kind, detail, since)

    def count(self, key: str, kind: RejectionCause, detail: str, n: int = 1) -> None:
        """Counts messages with a part that is not used. The input itself stays valid."""
        self.counts[key, kind] = self.counts.get((key, kind), 0) + n
        self.words[key, kind] = detail

    def last_problem(self, key: str) -> str:
        """Fault of the newest message of an input; empty where it was used."""
        arrival = self._arrivals.get(key)
        return arrival.detail if arrival is not None else ""

    def stamp_problem(self, key: str, now: int) -> str:
        """Fault of this input's stamps, sequence or size, as `scan: stamps are 1.0 s ahead`.

        Empty while messages are used, when they were wrong for less than `LASTING`, and when none arrives.
        """
        arrival = self._lasting(key, now)
        return _named(key, arrival.detail) if arrival and arrival.kind is not RejectionCause.CONTENT else ""

    def content_problem(self, key: str, now: int) -> str:
        """Contradiction of this input's messages to the configuration; empty in the cases of `stamp_problem`."""
        arrival = self._lasting(key, now)
        return arrival.detail if arrival and arrival.kind is RejectionCause.CONTENT else ""

    def late_cause(self, key: str, now: int) -> str:
        """Why an input with messages is old: its `stamp_problem`, or messages that arrive late.

        Call it when the input is old. Empty when the input is silent.
        """
        arrival = self._arrivals.get(key)
        if arrival is None or arrival.kind or not 0 <= now - arrival.at < arrival.age:
            return self.stamp_problem(key, now)
        return _named(key, _old(arrival.age))

    def _lasting(self, key: str, now: int) -> _Arrival | None:
        """The newest message, where messages arrive and were wrong for `LASTING`."""
        arrival = self._arrivals.get(key)
        if arrival is None or arrival.kind is None or arrival.at - arrival.since < LASTING:
            return None
        return arrival if _within(now - arrival.at) else None


def duration(ns: int) -> str:
    """A duration (ns) in words, in a suitable unit."""
    seconds = ns * 1e-9
    if seconds < 2 * MINUTE:
        return f"{seconds:.1f} s"
    for unit, name, until in ((MINUTE, "min", 0.99 * HOUR), (HOUR, "h", 2 * DAY), (DAY, "days", 2 * YEAR)):
        if seconds < until:
            return f"{seconds / unit:.0f} {name}"
    return f"{seconds / YEAR:.0f} years"


def _old(age: int) -> str:
    """Words for an age (ns). A stamp of decades ago is in seconds, or was never set."""
    return f"stamps are {duration(age)} old" + ("; are they ns?" if age > YEAR * 1e9 else "")


def _named(key: str, detail: str) -> str:
    return f"{key.rpartition('/')[2]}: {detail}"


def _within(silence: int) -> bool:
    return 0 <= silence <= RECENT
