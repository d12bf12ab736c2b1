# SPDX-License-Identifier: Apache-2.0
"""The stack's clock in a live process: the wall's, or the simulator's at any speed."""

import time

from shared.config import UserError

SECOND = 1_000_000_000


class Clock:
    """The stack's clock, ns: the wall's, or one that left the wall's at `epoch` and runs `speed` times as fast."""

    def __init__(self, epoch: int = 0, speed: float = 1.0) -> None:
        self.epoch, self.speed = epoch, speed

    def now(self) -> int:
        return self.at(time.time_ns())

    def at(self, wall: int) -> int:
        """When the wall's clock shows `wall` (ns)."""
        return wall if self.speed == 1.0 else self.epoch + round((wall - self.epoch) * self.speed)

    def seconds(self, duration: int) -> float:
        """Real seconds that this many ns of the stack's clock take."""
        return duration / SECOND / self.speed


def clock_from(text: str) -> Clock:
    """The clock given as EPOCH:SPEED; the wall clock where it is empty. Raises UserError."""
    if not text:
        return Clock()
    epoch, _, speed = text.partition(":")
    try:
        clock = Clock(int(epoch), float(speed))
    except ValueError:
        raise UserError(f"{text!r} is no clock", "write EPOCH:SPEED, like 1700000000000000000:4") from None
    if not 0.01 <= clock.speed <= 100:
        raise UserError(f"a speed of {clock.speed} cannot be run", "choose 0.01 to 100")
    return clock
