# SPDX-License-Identifier: Apache-2.0
"""Do the encoders' counts jump so often that the wheels' motion is unknown?

One jump is a restarted board or a disturbed reading. MIN_JUMPS within WINDOW_NS are a fault: the robot stops until
HOLD_NS after the last jump. MIN_FAULTS within FAULTS_WINDOW_NS are a broken encoder or cable: a latched fault.
"""

from collections import deque

MIN_JUMPS, WINDOW_NS = 3, 300_000_000  # this many within as many ns are a fault; a reading that is wrong once makes two
HOLD_NS = 1_000_000_000  # ns without a jump after which the fault ends
MIN_FAULTS, FAULTS_WINDOW_NS = 3, 60_000_000_000  # this many faults within as many ns are one that stays
REPORT_WINDOW_NS = 60_000_000_000  # ns for which a jump is counted in the status
MAX_STORED_JUMPS = 4096  # jumps: over a minute of 50 reports a second


class EncoderJumpDetector:
    """Stores the times of jumps (ns). Jumps in the future, after the clock was set back, do not count."""

    def __init__(self) -> None:
        self._jumps: deque[int] = deque(maxlen=MAX_STORED_JUMPS)
        self._faults: deque[int] = deque(maxlen=MIN_FAULTS)  # when they began
        self._active_until = 0

    def add_jump(self, now: int) -> bool:
        """Adds a jump at `now` (ns); returns whether it is one of so many that the fault must be latched."""
        continues = self.is_active(now)
        self._jumps.append(now)
        if not continues and self._n_within(now, WINDOW_NS) < MIN_JUMPS:
            return False
        self._active_until = now + HOLD_NS
        if continues:
            return False
        self._faults.append(now)
        return sum(0 <= now - at < FAULTS_WINDOW_NS for at in self._faults) >= MIN_FAULTS

    def is_active(self, now: int) -> bool:
        """Whether the robot must stop because of jumps."""
        return 0 < self._active_until - now <= HOLD_NS

    def description(self, now: int) -> str:
        """Number of jumps in the last minute as text; empty without jumps."""
        n = self._n_within(now, REPORT_WINDOW_NS)
        return f"the encoders jumped {n} {'time' if n == 1 else 'times'} in the last minute" if n else ""

    def release(self) -> None:
        """Ends the fault, after an e-stop release."""
        self._faults.clear()
        self._active_until = 0

    def _n_within(self, now: int, ns: int) -> int:
        return sum(0 <= now - at < ns for at in self._jumps)
