# SPDX-License-Identifier: Apache-2.0
"""The device's clock against the stack's, from when bytes left there and when they came here.

A byte never arrives before it was sent, and now and then hardly later: the line under all (sent, arrived - sent) is the
offset and the drift. The line is the edge of the lower convex hull under the middle of a sliding window (Zhang, Liu,
Xia 2002, 'Clock synchronization algorithms for network measurements', section IV).
"""

from itertools import pairwise

import numpy as np
from pydantic import Field

from services.lidar_driver.device import Float64s
from shared.config import Section

N_SLOTS = 20  # of the window; each keeps its earliest arrival
MET_FOR = 3.0  # s after a meeting of the clocks in which it is compared to arrivals; later they have drifted apart
LONGEST_DELAY = 0.5  # s
LONGEST_REPLY = 2_000_000  # ns that a reply of a few characters takes; the rest of a question's time was before it
SETTLED = 0.2  # share of the window that must be seen before a drift is believed


class DeviceClockConfig(Section):
    """How the device's clock is followed."""

    window: float = Field(10.0, ge=1, le=600, description="s of arrivals that are looked at")
    drift: float = Field(
        0.02, ge=0, le=0.2, description="largest drift believed, s/s; lasers without a clock are as good as their motor"
    )
    tolerance: float = Field(
        0.05, ge=0.002, le=10, description="s by which an arrival must be too early, or all of them late, to start anew"
    )
    patience: float = Field(1.0, ge=0.1, le=60, description="s for which all are late before the clocks start anew")


class DeviceClock:
    """Maps the device's seconds to the stack's ns. Of no use before the first observation."""

    def __init__(self, config: DeviceClockConfig) -> None:
        self.config = config
        self.n_restarts = 0
        self.begin()

    def begin(self) -> None:
        """Forgets all: another device may be there."""
        self.delay = 0.0  # s that even the earliest bytes take, where that can be known
        self.restart()

    def restart(self) -> None:
        """Forgets the clocks: the device's or the stack's started anew."""
        self.zero: int | None = None  # ns on the stack's clock; offsets count from here
        self.slots: dict[int, tuple[float, float]] = {}  # slot -> device's s, offset s
        self.drift, self.pivot, self.offset = 0.0, 0.0, 0.0
        self.near_at = 0  # ns, when an arrival was last near the line
        self.met: tuple[float, int] | None = None  # s on the device's clock, ns on the stack's at that time

    def meet(self, device: float, after: int, before: int) -> None:
        """The device's clock stood at `device` s between these two times, ns: what tells the bytes' own delay."""
        self.met = device, before - min((before - after) // 2, LONGEST_REPLY)

    def observe(self, stamp: int, sent: Float64s, ages: Float64s) -> None:
        """sent: (p,) s on the device's clock.  They arrived `ages` (p,) s before `stamp` (ns, the stack's clock)."""
        if self.zero is None:
            self.zero, self.pivot, self.near_at = stamp, float(sent[-1]), stamp
            self.offset = float(np.min(-ages - sent))
        offsets = (stamp - self.zero) * 1e-9 - ages - sent
        above = offsets - self._line(sent)
        best = int(np.argmin(above))
        lowest = float(above[best])
        near = abs(lowest) <= self.config.tolerance
        if near:
            self.near_at = stamp
        if lowest < -self.config.tolerance or not 0 <= stamp - self.near_at <= self.config.patience * 1e9:
            self.restart()
            self.n_restarts += 1
            self.observe(stamp, sent, ages)
            return
        self._keep(float(sent[best]), float(offsets[best]), lowest)
        if self.met is not None and float(sent[best]) - self.met[0] < MET_FOR:
            at, stack = self.met
            earliest = float(self._line(at)) + at - (stack - self.zero) * 1e-9
            self.delay = min(max(earliest, 0.0), LONGEST_DELAY)

    def stack_time(self, device: float) -> int:
        """ns on the stack's clock at `device` s on the device's."""
        return (self.zero or 0) + round((device + float(self._line(device)) - self.delay) * 1e9)

    def _line(self, device: Float64s | float) -> Float64s | float:
        return self.offset + self.drift * (device - self.pivot)

    def _keep(self, sent: float, offset: float, above: float) -> None:
        width = self.config.window / N_SLOTS
        slot = int(sent // width)
        before = self.slots.get(slot)
        if before is not None and above >= before[1] - self._line(before[0]):
            return
        self.slots[slot] = sent, offset
        self.slots = {k: v for k, v in self.slots.items() if slot - N_SLOTS < k <= slot}
        points = sorted(self.slots.values())
        span = points[-1][0] - points[0][0]
        if span >= SETTLED * self.config.window:
            most = self.config.drift
            self.drift = min(max(middle_slope(points), -most), most)
        self.pivot = points[-1][0]
        self.offset = min(y - self.drift * (x - self.pivot) for x, y in points)


def middle_slope(points: list[tuple[float, float]]) -> float:
    """The slope of the lower convex hull's edge under the middle of two or more points, sorted by x."""
    hull: list[tuple[float, float]] = []
    for point in points:
        while len(hull) > 1 and _turns_right(hull[-2], hull[-1], point):
            hull.pop()
        hull.append(point)
    middle = (points[0][0] + points[-1][0]) / 2
    a, b = next((a, b) for a, b in pairwise(hull) if b[0] >= middle)
    return (b[1] - a[1]) / (b[0] - a[0])


def _turns_right(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
    return (b[0] - a[0]) * (c[1] - a[1]) <= (b[1] - a[1]) * (c[0] - a[0])
