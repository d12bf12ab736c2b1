# SPDX-License-Identifier: Apache-2.0
"""The poses of the last seconds of odometry by time, for de-skewing scans.

Poses between messages are linear, as in Cartographer's TransformInterpolationBuffer. The rule for a restart is our own.
"""

import numpy as np

from shared.config import Drive
from shared.geometry import Pose2, arc, wrapped
from shared.messages import Odometry
from shared.types import NS_PER_S, Float64s

CAPACITY = 256  # messages: 5 s at 50 Hz, more than the longest sweep and its delay
EXTRAPOLATION_S = 0.1  # that the last twist goes on beyond the newest message


class OdometryBuffer:
    """Poses in `odom` by time. A restart of odometry clears it, as points of the former frame have no place in the new
    one.

    latest: the newest message; None before the first one.
    """

    def __init__(self, drive: Drive) -> None:
        self.drive = drive
        self.latest: Odometry | None = None
        # rows [first, end) are known, row `end` is extrapolated; at the end of the arrays the newest rows move to the
        # front, so that they stay in one piece
        self._stamps = np.zeros(2 * CAPACITY + 1, np.int64)
        self._poses = np.zeros((2 * CAPACITY + 1, 3))  # x, y, yaw without jumps of whole turns
        self._first = self._end = 0

    def add(self, odometry: Odometry) -> bool:
        """Takes the newest message. Returns False where it does not continue the last one: odometry restarted."""
        last = self.latest
        pose = odometry.odom_from_base
        is_restart = last is not None and not self._continues(last, odometry)
        if last is None or is_restart:
            self._first = self._end = 0
            yaw = pose.yaw
        else:
            before = float(self._poses[self._end - 1, 2])
            yaw = before + wrapped(pose.yaw - before)
        self._append(odometry, yaw)
        self.latest = odometry
        return not is_restart

    def covers(self, first: int, last: int) -> bool:
        """Whether the poses from `first` to `last` (ns) are known: at most 0.1 s before, 0.2 s after the messages."""
        if self._first == self._end:
            return False
        begin = self._stamps[self._first] - EXTRAPOLATION_S * NS_PER_S
        return bool(begin <= first and last <= self._stamps[self._end - 1] + 2 * EXTRAPOLATION_S * NS_PER_S)

    def poses(self, seconds: Float64s, since: int) -> Float64s:
        """(n, 3) x, y, yaw of the base in `odom` at `since` (ns) + seconds (n,), linear between messages.

        Beyond both ends it is the nearest known pose, after 0.1 s of the newest twist. Needs a message.
        """
        rows = slice(self._first, self._end + 1)
        times = (self._stamps[rows] - since) / NS_PER_S
        poses = np.empty((len(seconds), 3))
        for column in range(3):
            poses[:, column] = np.interp(seconds, times, self._poses[rows, column])
        return poses

    @property
    def odom_from_base(self) -> Pose2:
        """The newest pose; the identity without one."""
        return self.latest.odom_from_base if self.latest else Pose2()

    def _append(self, odometry: Odometry, yaw: float) -> None:
        if self._end == 2 * CAPACITY:
            for rows in self._stamps, self._poses:
                rows[: CAPACITY - 1] = rows[CAPACITY + 1 : -1]
            self._first, self._end = 0, CAPACITY - 1
        pose, i = odometry.odom_from_base, self._end
        further = pose @ arc(odometry.v * EXTRAPOLATION_S, odometry.w * EXTRAPOLATION_S)
        self._stamps[i : i + 2] = odometry.stamp, odometry.stamp + round(EXTRAPOLATION_S * NS_PER_S)
        self._poses[i] = pose.x, pose.y, yaw
        self._poses[i + 1] = further.x, further.y, yaw + odometry.w * EXTRAPOLATION_S
        self._end += 1
        self._first = max(self._first, self._end - CAPACITY)

    def _continues(self, last: Odometry, odometry: Odometry) -> bool:
        elapsed = (odometry.stamp - last.stamp) / NS_PER_S
        if elapsed <= 0:
            return False
        moved = last.odom_from_base.distance(odometry.odom_from_base)
        turned = abs(wrapped(odometry.odom_from_base.yaw - last.odom_from_base.yaw))
        fastest = max(self.drive.max_speed, self.drive.max_reverse_speed)
        # twice the drive's limits, with a margin for bumps and coarse encoders
        return moved <= 2 * fastest * elapsed + 0.1 and turned <= 2 * self.drive.max_turn_rate * elapsed + 0.2
