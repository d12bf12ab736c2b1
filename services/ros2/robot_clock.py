# SPDX-License-Identifier: Apache-2.0
"""The clock of a driven robot: the age of its messages, and whether it was set.

The method is our own. A clock that is set, forward or back, changes the difference of both clocks at once. Then no
message shows its age, for a link that is slow may have the same effect. So a new difference is believed after it was
steady. Until then messages count as old, and the guard stops the robot.
"""

from dataclasses import dataclass

from services.ros2.sender_clocks import SenderClocks
from shared.types import NS_PER_S

MAX_JUMP_NS = NS_PER_S // 2
"""By which a message may come earlier or later than the fastest one. NTP sets clocks that differ by more than 0.128 s
(RFC 5905, STEPT), and slews others. A hold-up of a radio link is mostly shorter."""
STEADY_NS = 10 * NS_PER_S  # for which a new difference must stay within MAX_JUMP_NS
MAX_GAP_NS = NS_PER_S  # without a message, after which that time starts again
SETTLING_NS = 2 * NS_PER_S  # after the first message, in which the fastest one counts: they wait for our start
CLEARLY_NS = NS_PER_S  # for which messages come late until that is said: a shorter hold-up is not the clock
UNTRUSTED_NS = 2 * NS_PER_S  # least age of a message that is not believed: over all maximum ages of the stack
CLOCK = b"robot"


@dataclass(slots=True)
class _Trial:
    """Differences since a message that did not fit: the smallest and largest, ns.  since, last: ns on our clock.

    was_set_forward: messages came earlier than possible. Then the former clock must be steady again, too.
    """

    low: int
    high: int
    since: int
    last: int
    was_set_forward: bool


class RobotClock:
    """Compares the robot's clock with ours. Times are ns."""

    def __init__(self) -> None:
        self._clocks = SenderClocks()
        self._trial: _Trial | None = None
        self._began: int | None = None
        self.offset: int | None = None
        """ns by which our clock is ahead of the robot's, as it is believed; None before the first message."""

    def age(self, sent: int, now: int) -> int:
        """ns by which a message is later than the fastest one; UNTRUSTED_NS or more where the clock is not believed.

        sent: on the robot's clock.  now: on ours.
        """
        difference = now - sent
        if self._began is None or now < self._began:  # the first message; or our own clock was set back
            self._began, self.offset, self._trial, self._clocks = now, None, None, SenderClocks()
        if self.offset is None or self._fits(difference, now):
            age = self._clocks.age(CLOCK, sent, now)
            self.offset = difference - age
            return age
        return max(abs(difference - self.offset), UNTRUSTED_NS)

    @property
    def is_believed(self) -> bool:
        """Whether the last message fits the clock."""
        return self._trial is None

    @property
    def off(self) -> int:
        """ns by which the last message does not fit the clock; 0 where it does."""
        trial = self._trial
        return 0 if trial is None or self.offset is None else abs(trial.low - self.offset)

    @property
    def doubt(self) -> str:
        """Why the clock is not believed, in words; empty where it is, and in a short hold-up of messages."""
        trial = self._trial
        if trial is None or self.offset is None:
            return ""
        if trial.was_set_forward:
            return f"was set forward by {self.off / NS_PER_S:.1f} s"
        if trial.last - trial.since < CLEARLY_NS:
            return ""
        return f"was set back by {self.off / NS_PER_S:.1f} s, or its messages come so late"

    def _fits(self, difference: int, now: int) -> bool:
        """Whether a message's difference is that of the clock as it is believed, or becomes that."""
        assert self.offset is not None
        assert self._began is not None
        trial = self._trial
        was_set_forward = trial is not None and trial.was_set_forward
        is_settling = now - self._began < SETTLING_NS and difference < self.offset
        if is_settling or (abs(difference - self.offset) <= MAX_JUMP_NS and not was_set_forward):
            self._trial = None  # the messages were late, the clock is as before
            return True
        if trial is None or not self._goes_on(trial, difference, now):
            was_set_forward |= difference < self.offset
            self._trial = _Trial(difference, difference, now, now, was_set_forward)
            return False
        trial.low, trial.high, trial.last = min(trial.low, difference), max(trial.high, difference), now
        if now - trial.since < STEADY_NS:
            return False
        self._trial, self._clocks = None, SenderClocks()
        return True

    @staticmethod
    def _goes_on(trial: _Trial, difference: int, now: int) -> bool:
        spread = max(trial.high, difference) - min(trial.low, difference)
        return spread <= MAX_JUMP_NS and 0 <= now - trial.last <= MAX_GAP_NS
