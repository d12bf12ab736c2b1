# SPDX-License-Identifier: Apache-2.0
"""The odometry of the last seconds as one continuous motion, whatever its publisher did meanwhile."""

from bisect import bisect_left, bisect_right
from dataclasses import dataclass
from math import hypot, pi

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from shared.config import Drive, Section
from shared.geometry import Pose2, arc, interpolated, wrapped
from shared.messages import Odometry

Float64s = NDArray[np.float64]

KEPT = 4000  # samples: 20 s at 200 Hz


class OdometryConfig(Section):
    """How odometry becomes the prior of a match."""

    timeout: float = Field(1.0, ge=0.1, le=10, description="s without odometry until scans are matched without it")
    late: float = Field(0.1, ge=0, le=1, description="s that a scan waits for odometry to cover its end")
    jump: float = Field(0.3, ge=0, le=5, description="m beyond what the drive can do until a step is no motion")
    jump_turn: float = Field(0.5, ge=0, le=6, description="rad beyond what the drive can do until a step is no motion")


@dataclass(frozen=True, slots=True)
class Sample:
    """Odometry at `stamp`: as published, and as continuous motion (start_from_base), where jumps are left out."""

    stamp: int
    odom_from_base: Pose2
    start_from_base: Pose2
    v: float
    w: float


class OdometryTrack:
    """Odometry by time. A jump that the drive cannot do (a restarted publisher) counts as no motion at all."""

    def __init__(self, config: OdometryConfig, drive: Drive) -> None:
        self.config, self.drive = config, drive
        self.samples: list[Sample] = []
        self.n_jumps = 0

    def add(self, odometry: Odometry, broken: bool = False) -> bool:
        """Takes a message; False where its stamp is older than the last one's. broken: no motion led here."""
        if not self.samples:
            motion = Pose2()
            start_from_last = Pose2()
        else:
            last = self.samples[-1]
            if odometry.stamp < last.stamp:
                return False
            start_from_last = last.start_from_base
            motion = last.odom_from_base.inverse() @ odometry.odom_from_base
            if broken or not self.plausible(motion, (odometry.stamp - last.stamp) * 1e-9):
                self.n_jumps += not broken
                motion = Pose2()
            if odometry.stamp == last.stamp:
                self.samples.pop()
        self.samples.append(
            Sample(odometry.stamp, odometry.odom_from_base, start_from_last @ motion, odometry.v, odometry.w)
        )
        if len(self.samples) > KEPT:
            del self.samples[: KEPT // 2]
        return True

    def clear(self) -> None:
        """Forgets everything: the clock was set back."""
        self.samples.clear()

    @property
    def newest(self) -> int:
        """ns, stamp of the last sample; -1 where there is none."""
        return self.samples[-1].stamp if self.samples else -1

    def at(self, stamp: int) -> Pose2:
        """start_from_base at a time; held before the first sample, extrapolated with the last twist after the last."""
        i = bisect_left(self.samples, stamp, key=lambda sample: sample.stamp)
        if i == len(self.samples):
            return self._extrapolated(self.samples[-1], stamp)
        if i == 0 or self.samples[i].stamp == stamp:
            return self.samples[i].start_from_base
        a, b = self.samples[i - 1], self.samples[i]
        return interpolated(a.start_from_base, b.start_from_base, (stamp - a.stamp) / (b.stamp - a.stamp))

    def odom_from_start(self, stamp: int) -> Pose2:
        """From the continuous motion to the frame that the publisher uses at that time."""
        i = bisect_left(self.samples, stamp, key=lambda sample: sample.stamp)
        sample = self.samples[min(i, len(self.samples) - 1)]
        return sample.odom_from_base @ sample.start_from_base.inverse()

    def during(self, begin: int, end: int) -> tuple[Float64s, Float64s]:
        """The motion from begin to end: (k,) s before the end, and (k, 3) end_from_base, yaw unwrapped."""
        first = bisect_right(self.samples, begin, key=lambda sample: sample.stamp)
        last = bisect_left(self.samples, end, key=lambda sample: sample.stamp)
        stamps = [begin, *(s.stamp for s in self.samples[first:last]), end]
        end_from_start = self.at(end).inverse()
        poses = [end_from_start @ self.at(stamp) for stamp in stamps]
        rows = np.array([(p.x, p.y, p.yaw) for p in poses])
        rows[:, 2] = np.unwrap(rows[:, 2])
        rows[:, 2] -= 2 * pi * np.round(rows[-1, 2] / (2 * pi))
        return np.array([(stamp - end) * 1e-9 for stamp in stamps]), rows

    def plausible(self, motion: Pose2, seconds: float) -> bool:
        """Whether the drive can do a motion."""
        # stamps come in bursts: what moved before a burst is told within milliseconds
        seconds = max(seconds, 0.2)
        far = self.drive.max_speed * seconds * 1.5 + self.config.jump
        turned = self.drive.max_turn_rate * seconds * 1.5 + self.config.jump_turn
        return hypot(motion.x, motion.y) <= far and abs(wrapped(motion.yaw)) <= turned

    def _extrapolated(self, sample: Sample, stamp: int) -> Pose2:
        seconds = min((stamp - sample.stamp) * 1e-9, self.config.timeout)
        return sample.start_from_base @ arc(sample.v * seconds, sample.w * seconds)
