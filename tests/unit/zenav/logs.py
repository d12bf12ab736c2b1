# SPDX-License-Identifier: Apache-2.0
"""Logs that tests make up."""

import numpy as np

from shared.geometry import Pose2
from tests.unit.services.mapper.rooms import ROOM, cast


def room_log(n=40, mount=Pose2(0.2, 0.0, 0.0), first=100.0):  # noqa: B008  # a pose is a value
    """A CARMEN log of a robot that circles in a made-up room; its odometry's wheels are 3 % too small."""
    angles = np.radians(np.arange(-90, 90))
    true, odom = Pose2(), Pose2()
    for k in range(n):
        step = Pose2(0.06, 0, 0.1)
        true, odom = true @ step, odom @ Pose2(0.062, 0, 0.1)
        stamp = first + 0.2 * k
        laser, seen = true @ mount, odom @ mount
        ranges = cast(ROOM, np.tile((laser.x, laser.y), (180, 1)), laser.yaw + angles)
        ranges[ranges > 30] = 81.83
        yield f"ODOM {odom.x:.6f} {odom.y:.6f} {odom.yaw:.6f} 0 0 0 {stamp - 0.1:.6f} host 0"
        yield (
            "FLASER 180 " + " ".join(f"{r:.2f}" for r in ranges)
            + f" {seen.x:.6f} {seen.y:.6f} {seen.yaw:.6f} {odom.x:.6f} {odom.y:.6f} {odom.yaw:.6f} {stamp:.6f} host 0"
        )  # fmt: skip
