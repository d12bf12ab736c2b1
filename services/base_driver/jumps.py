# SPDX-License-Identifier: Apache-2.0
"""Do the encoders' counts jump so often that the wheels' motion is unknown?

One jump is a restarted board or a disturbed reading. Several within a moment are a fault: the robot stands while they
go on and a second after. A fault that comes again and again is a broken encoder or cable, and a person must look.
"""

from collections import deque

MIN_JUMPS, WINDOW = 3, 300_000_000  # this many within as many ns are a fault; a reading that is wrong once makes two
HOLD = 1_000_000_000  # ns without a jump after which the fault ends
MIN_FAULTS, FAULTS_WINDOW = 3, 60_000_000_000  # this many faults within as many ns are one that stays
COUNTED = 60_000_000_000  # ns for which a jump is counted in the status
MAX_KEPT = 4096  # jumps: over a minute of 50 reports a second


class JumpWatch:
    """Knows when the encoders jumped, ns on our clock. A jump in the future does not count: the clock was set back."""

    def __init__(self) -> None:
        self._jumps: deque[int] = deque(maxlen=MAX_KEPT)
        self._faults: deque[int] = deque(maxlen=MIN_FAULTS)  # when they began
        self._until = 0

    def jumped(self, now: int) -> bool:
        """Takes a jump; whether it begins a fault that must stay, because there were so many."""
        goes_on = self.holds(now)
        self._jumps.append(now)
        if not goes_on and self._n_within(now, WINDOW) < MIN_JUMPS:
            return False
        self._until = now + HOLD
        if goes_on:
            return False
        self._faults.append(now)
        return sum(0 <= now - at < FAULTS_WINDOW for at in self._faults) >= MIN_FAULTS

    def holds(self, now: int) -> bool:
        """Whether the robot must stand for it."""
        return 0 < self._until - now <= HOLD

    def told(self, now: int) -> str:
        """How often they jumped of late, in words; empty when they did not."""
        n = self._n_within(now, COUNTED)
        return f"the encoders jumped {n} {'time' if n == 1 else 'times'} in the last minute" if n else ""

    def release(self) -> None:
        """A person has looked."""
        self._faults.clear()
        self._until = 0

    def _n_within(self, now: int, ns: int) -> int:
        return sum(0 <= now - at < ns for at in self._jumps)
