# SPDX-License-Identifier: Apache-2.0
"""A simulated base that controls its own speed: velocity to wheel speeds, and its own odometry from its wheels."""

from math import nan

import numpy as np

from shared.config import Drive
from shared.geometry import Pose2, arc
from shared.messages import BaseOdometry

WHEEL_VARIANCE = 2e-5  # m^2 for each m of a wheel; as the default of odometry.wheel_variance
MIN_VARIANCE = 1e-9  # m^2, rad^2: a covariance of zeros means that there is none


def rim_turns(v: float, w: float, drive: Drive) -> tuple[float, float]:
    """rad/s of the left and the right wheel for v (m/s) and w (rad/s)."""
    half = w * drive.wheel_distance / 2
    return (v - half) / drive.left_radius, (v + half) / drive.right_radius


class BaseOdometer:
    """Dead reckoning of the base's own computer, with the sizes of `robot.drive`. Its pose begins at 0."""

    def __init__(self, drive: Drive) -> None:
        self.drive = drive
        self.pose = Pose2()
        self._travel = 0.0  # m, of both wheels
        self._last: tuple[float, float] | None = None  # rad of both wheels

    def update(self, left: float, right: float) -> Pose2:
        """The pose when the wheels have turned so far, rad."""
        before_left, before_right = self._last or (left, right)
        self._last = left, right
        left_m = (left - before_left) * self.drive.left_radius
        right_m = (right - before_right) * self.drive.right_radius
        self._travel += abs(left_m) + abs(right_m)
        self.pose = self.pose @ arc((left_m + right_m) / 2, (right_m - left_m) / self.drive.wheel_distance)
        return self.pose

    def odometry(
        self, stamp: int, epoch: int, angles: tuple[float, float], speeds: tuple[float, float], battery: float = nan
    ) -> BaseOdometry:
        """The message at wheel angles (rad) and speeds (rad/s) of left and right. stamp, epoch: ns; battery: V."""
        pose = self.update(*angles)
        left, right = speeds[0] * self.drive.left_radius, speeds[1] * self.drive.right_radius
        variance = WHEEL_VARIANCE * self._travel / 4 + MIN_VARIANCE
        diagonal = np.diag([variance, variance, 4 * variance / self.drive.wheel_distance**2])
        return BaseOdometry(
            stamp=stamp,
            epoch=epoch,
            has_pose=True,
            odom_from_base=pose,
            has_twist=True,
            v=(left + right) / 2,
            vy=0.0,
            w=(right - left) / self.drive.wheel_distance,
            covariance=diagonal.ravel(),
            twist_covariance=np.zeros(9),
            battery=battery,
        )
