# SPDX-License-Identifier: Apache-2.0
"""The poses of the last 3 s of odometry by time, for de-skewing scans."""

from collections import deque

import numpy as np

from shared.config import Drive
from shared.geometry import Pose2, wrapped
from shared.messages import Odometry
from shared.types import Float64s

MAX_MESSAGES = 150  # 3 s at 50 Hz: the longest sweep and its delay


class OdometryBuffer:
    """Poses in `odom` by time. A restart of odometry clears it, as points of the former frame have no place in the new
    one.
    """

    def __init__(self, drive: Drive) -> None:
        self.drive = drive
        self.latest: Odometry | None = None
        self._rows: deque[tuple[float, float, float]] = deque(maxlen=MAX_MESSAGES)
        self._stamps: deque[int] = deque(maxlen=MAX_MESSAGES)

    def add(self, odometry: Odometry) -> bool:
        """Takes the newest message. Returns False where it does not continue the last one: odometry restarted."""
        last = self.latest
        pose = odometry.odom_from_base
        continues = last is not None and self._continues(last, odometry)
        if last is None or not continues:
            self._rows.clear()
            self._stamps.clear()
            yaw = pose.yaw
        else:
            before = self._rows[-1][2]
            yaw = before + wrapped(pose.yaw - before)
        self._rows.append((pose.x, pose.y, yaw))
        self._stamps.append(odometry.stamp)
        self.latest = odometry
        return last is None or continues

    def poses(self, stamps: Float64s, since: int) -> Float64s:
        """(n, 3) x, y, yaw in `odom` at `since` (ns) + stamps (n,) s; beyond both ends the nearest known pose."""
        times = np.array([(stamp - since) * 1e-9 for stamp in self._stamps])
        rows = np.array(self._rows)
        return np.column_stack([np.interp(stamps, times, column) for column in rows.T])

    @property
    def odom_from_base(self) -> Pose2:
        """The newest pose."""
        return self.latest.odom_from_base if self.latest else Pose2()

    def _continues(self, last: Odometry, odometry: Odometry) -> bool:
        elapsed = (odometry.stamp - last.stamp) * 1e-9
        if elapsed <= 0:
            return False
        moved = last.odom_from_base.distance(odometry.odom_from_base)
        turned = abs(wrapped(odometry.odom_from_base.yaw - last.odom_from_base.yaw))
        fastest = max(self.drive.max_speed, self.drive.max_reverse_speed)
        # twice the drive's limits, with a margin for bumps and coarse encoders
        return moved <= 2 * fastest * elapsed + 0.1 and turned <= 2 * self.drive.max_turn_rate * elapsed + 0.2
