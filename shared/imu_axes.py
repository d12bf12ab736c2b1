# SPDX-License-Identifier: Apache-2.0
"""Readings of an inertial sensor turned into `base`, by how it sits on the robot."""

from math import cos, sin

from shared.messages import Imu
from shared.robot import ImuMount


def imu_in_base(
    mount: ImuMount, stamp: int, yaw_rate: float, acceleration_x: float, acceleration_y: float, acceleration_z: float
) -> Imu:
    """A reading in the axes of `base`. stamp: ns.  yaw_rate: rad/s about the sensor's z.  accelerations: m/s^2."""
    up = -1.0 if mount.upside_down else 1.0  # a sensor upside down is turned about its x axis
    c, s = cos(mount.yaw), sin(mount.yaw)
    x, y = acceleration_x, up * acceleration_y
    return Imu(stamp, up * yaw_rate, c * x - s * y, s * x + c * y, up * acceleration_z)
