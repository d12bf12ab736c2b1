# SPDX-License-Identifier: Apache-2.0
"""Offset and drift between the device's clock and the stack's clock, from send and arrival times of bytes.

A byte arrives after it was sent, and sometimes almost without delay. So a line below all points (sent, arrived - sent)
gives offset and drift. It is the edge of the lower convex hull below the middle of a sliding window.

Zhang, Liu and Xia, 'Clock synchronization algorithms for network measurements', INFOCOM 2002, section IV.
"""

from itertools import pairwise

import numpy as np
from pydantic import Field

from shared.config import Section
from shared.types import Float64s

N_SLOTS = 20  # slots of the window; each keeps its earliest arrival
MAX_READING_AGE_S = 3.0  # age up to which a clock reading is used; later the clocks drift apart
MAX_DELAY_S = 0.5  # s
MAX_REPLY_NS = 2_000_000  # transfer time of a reply of a few characters; the device read its clock before it
MIN_WINDOW_SHARE = 0.2  # share of the window that the points must cover before the drift is estimated


class DeviceClockConfig(Section):
    """Estimation of the device's clock."""

    window: float = Field(10.0, ge=1, le=600, description="s, length of the sliding window of arrivals")
    drift: float = Field(
        0.02, ge=0, le=0.2, description="maximum drift, s/s; a laser without a clock drifts with its motor"
    )
    tolerance: float = Field(
        0.05,
        ge=0.002,
        le=10,
        description="s; the estimate restarts when an arrival is earlier, or all arrivals are later, by more than this",
    )
    patience: float = Field(
        1.0, ge=0.1, le=60, description="s for which all arrivals are late before the estimate restarts"
    )


class DeviceClock:
    """Maps times of the device (s) to times of the stack (ns); valid after the first observation."""

    def __init__(self, config: DeviceClockConfig) -> None:
        self.config = config
        self.n_restarts = 0
        self.reset()

    def reset(self) -> None:
        """Resets everything, for a new connection: the device may be another one."""
        self.delay = 0.0  # s, minimum delay of bytes, known only from clock readings
        self.restart()

    def restart(self) -> None:
        """Restarts the estimate, after a restart or jump of either clock. The minimum delay stays."""
        self.zero_ns: int | None = None  # ns on the stack's clock; origin of the offsets
        self.slots: dict[int, tuple[float, float]] = {}  # slot -> time of the device s, offset s
        self.drift, self.pivot, self.offset = 0.0, 0.0, 0.0
        self.near_at = 0  # ns, last arrival near the line
        self.clock_reading: tuple[float, int] | None = None  # s on the device's clock, ns on the stack's clock

    def add_clock_reading(self, device: float, after: int, before: int) -> None:
        """Adds a reading of the device's clock (s) between two times of the stack (ns). It gives the minimum delay."""
        self.clock_reading = device, before - min((before - after) // 2, MAX_REPLY_NS)

    def observe(self, stamp: int, sent: Float64s, ages: Float64s) -> None:
        """Adds packets sent at `sent` (p,) s on the device's clock, which arrived `ages` (p,) s before `stamp` (ns)."""
        if self.zero_ns is None:
            self.zero_ns, self.pivot, self.near_at = stamp, float(sent[-1]), stamp
            self.offset = float(np.min(-ages - sent))
        offsets = (stamp - self.zero_ns) * 1e-9 - ages - sent
        offsets_above_line = offsets - self._line(sent)
        best = int(np.argmin(offsets_above_line))
        lowest = float(offsets_above_line[best])
        is_near = abs(lowest) <= self.config.tolerance
        if is_near:
            self.near_at = stamp
        if lowest < -self.config.tolerance or not 0 <= stamp - self.near_at <= self.config.patience * 1e9:
            self.restart()
            self.n_restarts += 1
            self.observe(stamp, sent, ages)
            return
        self._add_to_hull(float(sent[best]), float(offsets[best]), lowest)
        if self.clock_reading is not None and float(sent[best]) - self.clock_reading[0] < MAX_READING_AGE_S:
            at, stack = self.clock_reading
            earliest = float(self._line(at)) + at - (stack - self.zero_ns) * 1e-9
            self.delay = min(max(earliest, 0.0), MAX_DELAY_S)

    def stack_time(self, device: float) -> int:
        """Time on the stack's clock (ns) at `device` s on the device's clock."""
        return (self.zero_ns or 0) + round((device + float(self._line(device)) - self.delay) * 1e9)

    def _line(self, device: Float64s | float) -> Float64s | float:
        return self.offset + self.drift * (device - self.pivot)

    def _add_to_hull(self, sent: float, offset: float, offsets_above_line: float) -> None:
        width = self.config.window / N_SLOTS
        slot = int(sent // width)
        before = self.slots.get(slot)
        if before is not None and offsets_above_line >= before[1] - self._line(before[0]):
            return
        self.slots[slot] = sent, offset
        self.slots = {k: v for k, v in self.slots.items() if slot - N_SLOTS < k <= slot}
        points = sorted(self.slots.values())
        span = points[-1][0] - points[0][0]
        if span >= MIN_WINDOW_SHARE * self.config.window:
            max_drift = self.config.drift
            self.drift = min(max(slope_below_middle(points), -max_drift), max_drift)
        self.pivot = points[-1][0]
        self.offset = min(y - self.drift * (x - self.pivot) for x, y in points)


def slope_below_middle(points: list[tuple[float, float]]) -> float:
    """Slope of the lower convex hull's edge below the middle of the x range; points: two or more, sorted by x."""
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
