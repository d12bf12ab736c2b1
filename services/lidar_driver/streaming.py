# SPDX-License-Identifier: Apache-2.0
"""What lasers share that measure and stream by themselves: packets of one length come, nothing is said to them."""

from collections.abc import Callable

from services.lidar_driver.device import Bools, Counts, Uint8s
from services.lidar_driver.framing import Framing


class Streaming:
    """Their state between readings. length, begins, sums: as Framing takes them.

    speed: turns/s.  last: what counts in the last packet, an index or ticks.  time: s on the device's clock, unwrapped,
    when that packet was complete.
    """

    scanning = True
    met = None

    def __init__(
        self, baud: int, length: int, begins: Callable[[Uint8s, Uint8s], Bools], sums: Callable[[Uint8s], Bools]
    ) -> None:
        self.counts = Counts()
        self.byte_time = 10.0 / baud  # s
        self.trouble = ""
        self._packets = length, begins, sums
        self.opened(0)

    def opened(self, now: int) -> bytes:
        self.framing = Framing(*self._packets, self.counts)
        self.speed: float | None = None
        self.last: int | None = None
        self.time = 0.0
        return b""

    def due(self, now: int) -> bytes:
        return b""

    def farewell(self) -> bytes:
        return b""
