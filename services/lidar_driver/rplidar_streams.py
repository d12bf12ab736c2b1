# SPDX-License-Identifier: Apache-2.0
"""Scan streams of an RPLIDAR. The device has no clock; times follow from the number of samples at a constant rate."""

from statistics import median
from typing import Protocol

import numpy as np

from services.lidar_driver.device import PacketCounts, Returns, differences
from services.lidar_driver.packet_framing import PacketFramer
from services.lidar_driver.rplidar_capsules import CapsuleFormat, is_checksum_valid, is_header
from services.lidar_driver.rplidar_nodes import LENGTH, NodeFramer
from shared.types import Float64s, UInt8s

MAX_CAPSULE_DEG = 120.0  # maximum angle of a capsule
MIN_SPEED_TIME_S = 0.2  # s of nodes that give the speed
N_RECENT = 15  # capsules that give the speed
MAX_STEP_BACK_DEG = 40.0  # degrees back from the last beam before a loss to the first one after it


class BeamStream(Protocol):
    """A scan in progress. speed: turns/s, None unknown."""

    speed: float | None

    def receive(self, data: bytes) -> list[Returns]:
        """Decodes bytes of the stream."""


class NodeStream:
    """Standard nodes. sample_time, byte_time: s."""

    def __init__(self, counts: PacketCounts, sample_time: float, byte_time: float) -> None:
        self.nodes = NodeFramer(counts)
        self.sample_time, self.byte_time = sample_time, byte_time
        self.speed: float | None = None
        self.time = 0.0  # s on the clock of its samples
        self.degrees: float | None = None  # of the last beam
        self.turned, self.turning_time = 0.0, 0.0  # turns, and s that they took, since the speed was last found

    def receive(self, data: bytes) -> list[Returns]:
        nodes, after, is_resync = self.nodes.extract(data)
        if not len(nodes):
            return []
        words = nodes[:, 1:].view("<u2")
        degrees, quarters = (words[:, 0] >> 1) / 64, words[:, 1]
        steps = differences(degrees, float(degrees[0]) if self.degrees is None else self.degrees)
        turned = np.where(is_resync, (steps + MAX_STEP_BACK_DEG) % 360 - MAX_STEP_BACK_DEG, (steps + 180) % 360 - 180)
        n_samples = np.ones(len(nodes))
        if self.speed:  # lost samples follow from the angle turned
            n_samples = np.where(is_resync, np.maximum(np.rint(turned / 360 / self.speed / self.sample_time), 1), 1)
        times = self.time + (n_samples * self.sample_time).cumsum()
        self.time, self.degrees = float(times[-1]), float(degrees[-1])
        self.turned += float(turned[~is_resync].sum()) / 360
        self.turning_time += float(np.count_nonzero(~is_resync)) * self.sample_time
        if self.turning_time >= MIN_SPEED_TIME_S:
            self.speed = max(self.turned / self.turning_time, 0.0)
            self.turned, self.turning_time = 0.0, 0.0
        returns = Returns(
            angles=-np.radians(degrees),
            ranges=np.where(quarters > 0, quarters * 0.25e-3, np.nan).astype(np.float32),
            intensities=(nodes[:, 0] >> 2).astype(np.float32),
            times=times,
            sent=times,
            ages=np.asarray((after + LENGTH) * self.byte_time, np.float64),
        )
        return [returns]


class CapsuleStream:
    """Express capsules of one format. sample_time, byte_time: s."""

    def __init__(self, counts: PacketCounts, format_: CapsuleFormat, sample_time: float, byte_time: float) -> None:
        self.format = format_
        self.framing = PacketFramer(format_.length, is_header, is_checksum_valid, counts)
        self.sample_time, self.byte_time = sample_time, byte_time
        self.speed: float | None = None
        self.time = 0.0  # s on the clock of its samples
        self.last_capsule: UInt8s | None = None  # its beams need the angle of the next one
        self.recent: list[float] = []  # degrees from capsule to capsule

    def receive(self, data: bytes) -> list[Returns]:
        """Decodes the capsules that have a successor: its first angle gives the angle that the laser turned."""
        capsules, after = self.framing.extract(data)
        if not len(capsules):
            return []
        joined = capsules if self.last_capsule is None else np.concatenate([self.last_capsule, capsules])
        self.last_capsule = capsules[-1:]
        words = joined[:, self.format.angle_at :][:, :2].copy().view("<u2")[:, 0]
        starts, is_resync = (words & 0x7FFF) / 64, words >> 15 > 0
        turned = (starts[1:] - starts[:-1]) % 360
        capsule_steps = self._capsule_steps(turned)
        n, duration = self.format.n_beams, self.format.n_beams * self.sample_time
        n_capsules = (
            capsule_steps if len(capsule_steps) == len(capsules) else np.concatenate([np.ones(1), capsule_steps])
        )
        ends = self.time + n_capsules.cumsum() * duration
        self.time = float(ends[-1])
        whole = ~is_resync[1:] & (capsule_steps == 1) & (turned < MAX_CAPSULE_DEG) & (turned > 0)
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

    def _capsule_steps(self, turned: Float64s) -> Float64s:
        """Number of capsules from each to the next, over 1 after a loss; updates the speed from the median angle."""
        self.recent = (self.recent + turned.tolist())[-N_RECENT:]
        nominal = median(self.recent) if len(self.recent) > N_RECENT // 2 else 0.0
        if not nominal:
            return np.ones(len(turned))
        self.speed = nominal / 360 / (self.format.n_beams * self.sample_time)
        return np.maximum(np.rint(turned / nominal), 1)
