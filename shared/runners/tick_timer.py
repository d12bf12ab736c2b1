# SPDX-License-Identifier: Apache-2.0
"""When is a service's tick due? At a fixed rate, or right after each message of a topic."""

from shared.types import NS_PER_S

MIN_INTERVAL = 0.5  # periods after a tick; an earlier message does not cause the next tick
SHORT_INTERVAL = 0.45  # periods until the next tick in that case: the next message then comes later after a tick
SLACK = 0.2  # periods; the second tick after a message waits for a late message for so long


class TickTimer:
    """The deadline of one tick, ns on the stack's clock.

    A tick that follows a topic is due right after a message of the topic, then once a period until the next message.
    So a command from a new message does not wait for the next tick of a fixed rate.
    """

    def __init__(self, hz: float, follows: str, now: int) -> None:
        self.period, self.follows = round(NS_PER_S / hz), follows
        self.due = now
        self._last = self._heard = now - self.period
        self._since: int | None = None  # ticks since the one after a message

    def is_due(self, now: int) -> bool:
        """Whether the tick is due at `now` (ns); also where the clock was set back far before the deadline."""
        return self.due <= now or self.due - now > 2 * self.period

    def advance(self, now: int) -> None:
        """Sets the next deadline after a tick at `now` (ns). Missed ticks are skipped."""
        self._last = now
        if self._since is not None:
            self._since += 1
        upcoming = self.due + self.period + (round(SLACK * self.period) if self._since == 2 else 0)
        if not now < upcoming <= now + 2 * self.period:
            upcoming = now + self.period - (now - self.due) % self.period
        self.due = upcoming

    def follow(self, key: str, now: int) -> None:
        """Moves the deadline after a message on a key, if the tick follows it."""
        if key != self.follows:
            return
        fast = 0 <= now - self._heard < self.period
        self._heard = now
        if not 0 <= now - self._last <= MIN_INTERVAL * self.period:
            self.due, self._since = now, 0
        elif not fast:
            self.due = min(self.due, now + round(SHORT_INTERVAL * self.period))
