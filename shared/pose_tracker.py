# SPDX-License-Identifier: Apache-2.0
"""The newest pose on the map: the mapper's correction combined with odometry.

Odometry continues the pose between two corrections, as the frames of REP 105 mean it. The rules for jumps are our own.
"""

from shared.geometry import Pose2
from shared.messages import Localization, Odometry, PoseEstimate

MAX_CORRECTION_M = 0.5
"""A larger correction counts as a jump."""
MAX_SPEED_MPS = 5.0
"""Odometry that moves faster, beyond MAX_CORRECTION_M, has restarted elsewhere."""


class PoseTracker:
    """Combines `pose` and `odom`. `map_from_base` is None before the first `pose`."""

    def __init__(self) -> None:
        self._estimate: PoseEstimate | None = None
        self._odometry: Odometry | None = None

    @property
    def map_from_base(self) -> Pose2 | None:
        """The best present estimate; None before the first `pose`."""
        if self._estimate is None or self._odometry is None:
            return self._estimate.map_from_base if self._estimate else None
        return self._estimate.map_from_odom @ self._odometry.odom_from_base

    @property
    def is_lost(self) -> bool:
        """Whether the mapper reports that the robot is lost."""
        return self._estimate is not None and self._estimate.state is Localization.LOST

    def add_estimate(self, estimate: PoseEstimate) -> bool:
        """Applies a mapper's pose. Returns whether the robot jumped on the map by more than MAX_CORRECTION_M."""
        before, self._estimate = self.map_from_base, estimate
        after = self.map_from_base
        return before is not None and after is not None and before.distance(after) > MAX_CORRECTION_M

    def add_odometry(self, odometry: Odometry) -> None:
        """Applies odometry. Where it restarts elsewhere, the pose on the map stays until the next `pose`."""
        last = self._odometry
        stays = self.map_from_base
        if last is not None and self._estimate is not None and stays is not None and _has_restarted(last, odometry):
            self._estimate = PoseEstimate(
                stamp=self._estimate.stamp,
                map_from_base=stays,
                map_from_odom=stays @ odometry.odom_from_base.inverse(),
                covariance=self._estimate.covariance,
                quality=self._estimate.quality,
                state=self._estimate.state,
            )
        self._odometry = odometry


def _has_restarted(before: Odometry, after: Odometry) -> bool:
    elapsed = abs(after.stamp - before.stamp) * 1e-9
    return before.odom_from_base.distance(after.odom_from_base) > MAX_CORRECTION_M + MAX_SPEED_MPS * min(elapsed, 1.0)
