# SPDX-License-Identifier: Apache-2.0
"""An RPLIDAR's streams as returns. It has no clock, but samples at a constant speed: their number is the clock."""

from statistics import median
from typing import Protocol

import numpy as np

from services.lidar_driver.device import Counts, Float64s, Returns, Uint8s, steps_of
from services.lidar_driver.framing import Framing
from services.lidar_driver.rplidar_capsules import Format, begins, sums
from services.lidar_driver.rplidar_nodes import LENGTH, Nodes

WIDEST = 120.0  # degrees that a capsule of a laser that turns may cover
SPEED_TIME = 0.2  # s of nodes from which the speed is found
MOST_RECENT = 15  # capsules from which the speed is found
BACK = 40.0  # degrees by which the first beam after lost ones may lie behind the last one before


class Scan(Protocol):
    """A stream under way. speed: turns/s."""

    speed: float | None

    def received(self, data: bytes) -> list[Returns]:
        """Takes bytes of the stream."""


class NodeScan:
    """Standard nodes. sample_time, byte_time: s."""

    def __init__(self, counts: Counts, sample_time: float, byte_time: float) -> None:
        self.nodes = Nodes(counts)
        self.sample_time, self.byte_time = sample_time, byte_time
        self.speed: float | None = None
        self.time = 0.0  # s on the clock that its sampling is
        self.degrees: float | None = None  # of the last beam
        self.turned, self.turned_in = 0.0, 0.0  # turns, and s that they took, since the speed was last found

    def received(self, data: bytes) -> list[Returns]:
        nodes, after, anew = self.nodes.cut(data)
        if not len(nodes):
            return []
        words = nodes[:, 1:].view("<u2")
        degrees, quarters = (words[:, 0] >> 1) / 64, words[:, 1]
        steps = steps_of(degrees, float(degrees[0]) if self.degrees is None else self.degrees)
        turned = np.where(anew, (steps + BACK) % 360 - BACK, (steps + 180) % 360 - 180)
        n_samples = np.ones(len(nodes))
        if self.speed:  # as many were lost as it turned meanwhile
            n_samples = np.where(anew, np.maximum(np.rint(turned / 360 / self.speed / self.sample_time), 1), 1)
        times = self.time + (n_samples * self.sample_time).cumsum()
        self.time, self.degrees = float(times[-1]), float(degrees[-1])
        self.turned += float(turned[~anew].sum()) / 360
        self.turned_in += float(np.count_nonzero(~anew)) * self.sample_time
        if self.turned_in >= SPEED_TIME:
            self.speed = max(self.turned / self.turned_in, 0.0)
            self.turned, self.turned_in = 0.0, 0.0
        returns = Returns(
            angles=-np.radians(degrees),
            ranges=np.where(quarters > 0, quarters * 0.25e-3, np.nan).astype(np.float32),
            intensities=(nodes[:, 0] >> 2).astype(np.float32),
            times=times,
            sent=times,
            ages=np.asarray((after + LENGTH) * self.byte_time, np.float64),
        )
        return [returns]


class CapsuleScan:
    """Express capsules of one format. sample_time, byte_time: s."""

    def __init__(self, counts: Counts, format_: Format, sample_time: float, byte_time: float) -> None:
        self.format = format_
        self.framing = Framing(format_.length, begins, sums, counts)
        self.sample_time, self.byte_time = sample_time, byte_time
        self.speed: float | None = None
        self.time = 0.0  # s on the clock that its sampling is
        self.before: Uint8s | None = None  # the last capsule: its beams are known when the next one has come
        self.recent: list[float] = []  # degrees from capsule to capsule

    def received(self, data: bytes) -> list[Returns]:
        """The beams of the capsules before each that comes: where the next begins tells how far it turned meanwhile."""
        capsules, after = self.framing.cut(data)
        if not len(capsules):
            return []
        joined = capsules if self.before is None else np.concatenate([self.before, capsules])
        self.before = capsules[-1:]
        words = joined[:, 2:4].view("<u2")[:, 0]
        starts, anew = (words & 0x7FFF) / 64, words >> 15 > 0
        turned = (starts[1:] - starts[:-1]) % 360
        passed = self._passed(turned)
        n, duration = self.format.n_beams, self.format.n_beams * self.sample_time
        n_capsules = passed if len(passed) == len(capsules) else np.concatenate([np.ones(1), passed])
        ends = self.time + n_capsules.cumsum() * duration
        self.time = float(ends[-1])
        whole = ~anew[1:] & (passed == 1) & (turned < WIDEST) & (turned > 0)
        if not whole.any():
            return []
        mm, offsets = self.format.beams(joined[:-1][whole], joined[1:][whole])
        place = np.arange(n)
        degrees = starts[:-1][whole, None] + turned[whole, None] * (place / n) - offsets.reshape(-1, n)
        began = (ends[-len(turned) :] - duration)[whole]  # when the following capsule began
        returns = Returns(
            angles=-np.radians(degrees).ravel(),
            ranges=np.where(mm > 0, mm * 1e-3, np.nan).ravel().astype(np.float32),
            intensities=None,
            times=(began[:, None] + (place + 1 - n) * self.sample_time).ravel(),
            sent=ends,
            ages=np.asarray((after + self.format.length) * self.byte_time, np.float64),
        )
        return [returns]

    def _passed(self, turned: Float64s) -> Float64s:
        """Capsules from each to the next, over one where some were lost; finds the speed from the last ones' median."""
        self.recent = (self.recent + turned.tolist())[-MOST_RECENT:]
        nominal = median(self.recent) if len(self.recent) > MOST_RECENT // 2 else 0.0
        if not nominal:
            return np.ones(len(turned))
        self.speed = nominal / 360 / (self.format.n_beams * self.sample_time)
        return np.maximum(np.rint(turned / nominal), 1)
