# SPDX-License-Identifier: Apache-2.0
"""When a service's tick is due: on a fixed grid, or in step with the topic that it follows."""

from shared.runners.clock import SECOND

NOT_BEFORE = 0.5  # periods after a tick within which a message does not call the next one
CAUGHT_UP = 0.45  # periods until the next tick then: the next message will come later after a tick than this one
SLACK = 0.2  # periods that a message may come late on the second tick after the last, before that one goes ahead


class Metronome:
    """The deadline of one tick, ns on the stack's clock.

    One that follows a topic is due as soon as a message of it was taken, then a period after that, and so on until the
    next message: what the tick makes of a message does not wait for a grid that knows nothing of it.
    """

    def __init__(self, hz: float, follows: str, now: int) -> None:
        self.period, self.follows = round(SECOND / hz), follows
        self.due = now
        self._last = self._heard = now - self.period
        self._since: int | None = None  # ticks since the one that a message called

    def is_due(self, now: int) -> bool:
        """Whether it ticks now; also where the clock was set back and the deadline is far away."""
        return self.due <= now or self.due - now > 2 * self.period

    def ticked(self, now: int) -> None:
        """The tick happens now: missed ones are skipped."""
        self._last = now
        if self._since is not None:
            self._since += 1
        upcoming = self.due + self.period + (round(SLACK * self.period) if self._since == 2 else 0)
        if not now < upcoming <= now + 2 * self.period:
            upcoming = now + self.period - (now - self.due) % self.period
        self.due = upcoming

    def heard(self, key: str, now: int) -> None:
        """A message on a topic's key was taken."""
        if key != self.follows:
            return
        fast = 0 <= now - self._heard < self.period
        self._heard = now
        if not 0 <= now - self._last <= NOT_BEFORE * self.period:
            self.due, self._since = now, 0
        elif not fast:
            self.due = min(self.due, now + round(CAUGHT_UP * self.period))
