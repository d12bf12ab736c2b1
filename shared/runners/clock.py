# SPDX-License-Identifier: Apache-2.0
"""The stack's clock in a live process: the wall clock, or simulated time at another speed."""

import time

from shared.config import UserError
from shared.types import NS_PER_S


class StackClock:
    """The stack's clock (ns). From `epoch` (ns) on it runs `speed` times as fast as the wall clock."""

    def __init__(self, epoch: int = 0, speed: float = 1.0) -> None:
        self.epoch, self.speed = epoch, speed

    def now(self) -> int:
        return self.at(time.time_ns())

    def at(self, wall: int) -> int:
        """The stack's time (ns) at a time of the wall clock (ns)."""
        return wall if self.speed == 1.0 else self.epoch + round((wall - self.epoch) * self.speed)

    def seconds(self, duration: int) -> float:
        """Real time (s) of a duration (ns) of the stack's clock."""
        return duration / NS_PER_S / self.speed


def clock_from(text: str) -> StackClock:
    """The clock given as EPOCH:SPEED; the wall clock where it is empty. Raises UserError."""
    if not text:
        return StackClock()
    epoch, _, speed = text.partition(":")
    try:
        clock = StackClock(int(epoch), float(speed))
    except ValueError:
        raise UserError(f"{text!r} is no clock", "write EPOCH:SPEED, like 1700000000000000000:4") from None
    if not 0.01 <= clock.speed <= 100:
        raise UserError(f"a speed of {clock.speed} cannot be run", "choose 0.01 to 100")
    return clock
