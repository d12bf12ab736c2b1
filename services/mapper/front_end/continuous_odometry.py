# SPDX-License-Identifier: Apache-2.0
"""Odometry as one continuous motion, across restarts of its publisher; what is older has fewer samples.

Poses between samples are linear, as in Cartographer's TransformInterpolationBuffer. Beyond the last one its twist
continues, as in Cartographer's PoseExtrapolator. To leave out jumps is our own.
"""

from bisect import bisect_left, bisect_right
from dataclasses import dataclass
from math import hypot, pi
from typing import ClassVar

import numpy as np
from pydantic import Field

from shared.config import Drive, Section
from shared.geometry import Pose2, arc, interpolated, wrapped
from shared.messages import Odometry
from shared.types import Float64s

MAX_SAMPLES = 4000  # the newest 10 s at 200 Hz are complete


class OdometryConfig(Section):
    """Waiting for odometry, and the limits of a motion."""

    timeout: float = Field(1.0, ge=0.1, le=10, description="s without odometry until scans are matched without it")
    max_wait: float = Field(0.1, ge=0, le=1, description="s that a scan waits for odometry to cover its end")
    max_jump: float = Field(0.3, ge=0, le=5, description="m beyond the drive's limits; a larger step is no motion")
    max_jump_turn: float = Field(
        0.5, ge=0, le=6, description="rad beyond the drive's limits; a larger step is no motion"
    )

    RENAMED: ClassVar[dict[str, str]] = {"late": "max_wait", "jump": "max_jump", "jump_turn": "max_jump_turn"}


@dataclass(frozen=True, slots=True)
class OdometrySample:
    """Odometry at `stamp`, ns: v m/s, w rad/s, the pose as published, and start_from_base without the jumps."""

    stamp: int
    odom_from_base: Pose2
    start_from_base: Pose2
    v: float
    w: float


class ContinuousOdometry:
    """Odometry by time, in the frame `start`: `base` at the first sample. Later jumps are left out.

    A step beyond the drive's limits counts as no motion: its publisher was restarted.  n_jumps: number of such steps.
    """

    def __init__(self, config: OdometryConfig, drive: Drive) -> None:
        self.config, self.drive = config, drive
        self.samples: list[OdometrySample] = []
        self.n_jumps = 0

    def add(self, odometry: Odometry, is_restart: bool = False) -> bool:
        """Adds a message; False if its stamp is older than the last one's. is_restart: the step to it is no motion."""
        if not self.samples:
            motion = Pose2()
            start_from_last = Pose2()
        else:
            last = self.samples[-1]
            if odometry.stamp < last.stamp:
                return False
            start_from_last = last.start_from_base
            motion = last.odom_from_base.inverse() @ odometry.odom_from_base
            if is_restart or not self.is_drivable(motion, (odometry.stamp - last.stamp) * 1e-9):
                self.n_jumps += not is_restart
                motion = Pose2()
            if odometry.stamp == last.stamp:
                self.samples.pop()
        self.samples.append(
            OdometrySample(odometry.stamp, odometry.odom_from_base, start_from_last @ motion, odometry.v, odometry.w)
        )
        if len(self.samples) > MAX_SAMPLES:  # the motion since the last scan stays, however long the laser is silent
            del self.samples[1 : MAX_SAMPLES // 2 : 2]
        return True

    def clear(self) -> None:
        """Removes all samples: the clock was set back."""
        self.samples.clear()

    @property
    def newest(self) -> int:
        """ns, stamp of the last sample; -1 where there is none."""
        return self.samples[-1].stamp if self.samples else -1

    def start_from_base(self, stamp: int) -> Pose2:
        """The pose at a time, ns, linear between samples.

        Before the first sample it is that of the first. After the last one its twist is extrapolated, for
        `timeout` at most.
        """
        i = bisect_left(self.samples, stamp, key=lambda sample: sample.stamp)
        if i == len(self.samples):
            return self._extrapolated(self.samples[-1], stamp)
        if i == 0 or self.samples[i].stamp == stamp:
            return self.samples[i].start_from_base
        a, b = self.samples[i - 1], self.samples[i]
        return interpolated(a.start_from_base, b.start_from_base, (stamp - a.stamp) / (b.stamp - a.stamp))

    def odom_from_start(self, stamp: int) -> Pose2:
        """The transform to the frame that the publisher uses at that time, ns."""
        i = bisect_left(self.samples, stamp, key=lambda sample: sample.stamp)
        sample = self.samples[min(i, len(self.samples) - 1)]
        return sample.odom_from_base @ sample.start_from_base.inverse()

    def motion_during(self, begin: int, end: int) -> tuple[Float64s, Float64s]:
        """The motion from begin to end, ns: (k,) s from the end, <= 0, and (k, 3) end_from_base, yaw unwrapped."""
        first = bisect_right(self.samples, begin, key=lambda sample: sample.stamp)
        last = bisect_left(self.samples, end, key=lambda sample: sample.stamp)
        stamps = [begin, *(s.stamp for s in self.samples[first:last]), end]
        end_from_start = self.start_from_base(end).inverse()
        poses = [end_from_start @ self.start_from_base(stamp) for stamp in stamps]
        rows = np.array([(p.x, p.y, p.yaw) for p in poses])
        rows[:, 2] = np.unwrap(rows[:, 2])
        rows[:, 2] -= 2 * pi * np.round(rows[-1, 2] / (2 * pi))
        return np.array([(stamp - end) * 1e-9 for stamp in stamps]), rows

    def is_drivable(self, motion: Pose2, seconds: float) -> bool:
        """Whether a motion over so many seconds lies within the drive's limits."""
        # stamps come in bursts: the motion before a burst then seems to take milliseconds
        seconds = max(seconds, 0.2)
        max_path = self.drive.max_speed * seconds * 1.5 + self.config.max_jump
        max_turn = self.drive.max_turn_rate * seconds * 1.5 + self.config.max_jump_turn
        return hypot(motion.x, motion.y) <= max_path and abs(wrapped(motion.yaw)) <= max_turn

    def _extrapolated(self, sample: OdometrySample, stamp: int) -> Pose2:
        seconds = min((stamp - sample.stamp) * 1e-9, self.config.timeout)
        return sample.start_from_base @ arc(sample.v * seconds, sample.w * seconds)
