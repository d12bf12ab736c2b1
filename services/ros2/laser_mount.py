# SPDX-License-Identifier: Apache-2.0
"""Where /tf_static puts the laser of a driven robot, compared with the robot file's mount.

Mapper, guard and local control take the mount from the robot file, so a difference is an error of that file.
"""

from math import degrees
from typing import Any

import numpy as np

from shared.config import Mount
from shared.geometry import Pose2
from shared.ros_frames import Frames, level, planar, tilt, upside_down
from shared.ros_readings import frame_name, transform_row
from shared.types import Float64s

MAX_FRAMES = 256  # of /tf_static; a robot has some dozens
MAX_OFF_M, MAX_OFF_RAD = 0.02, 0.035
"""By these a mount may differ: the values of a robot's description are rounded to a centimetre and a degree or two."""


class LaserMount:
    """Static transforms, and what they say about a laser. base: the robot's frame in ROS."""

    def __init__(self, mount: Mount, base: str) -> None:
        self._mount, self._base = Pose2(mount.x, mount.y, mount.yaw), base
        self._rows: dict[str, tuple[str, Float64s]] = {}  # parent and transform by child
        self._checked = ""  # frame of the laser that was compared with the present transforms
        self.is_upside_down = False

    def add(self, message: Any) -> None:
        """Takes a tf2_msgs/TFMessage of /tf_static."""
        for row in message.transforms:
            child = frame_name(row.child_frame_id)
            if len(self._rows) < MAX_FRAMES or child in self._rows:
                self._rows[child] = frame_name(row.header.frame_id), transform_row(row.transform)
        self._checked = ""

    def check(self, laser: str) -> str:
        """What differs of a laser's frame, once after each change; empty where nothing does, or TF does not say it.

        Raises ValueError where a transform is none.
        """
        laser = frame_name(laser)
        if not self._rows or laser == self._checked:
            return ""
        self._checked = laser
        found = self._base_from(laser)
        if found is None:
            return ""
        if not level(found):
            return f"by /tf_static the laser is tilted by {tilt(found):.0f} degrees: it does not measure the plane"
        self.is_upside_down = upside_down(found)
        given = planar(found)
        off = self._mount.inverse() @ given
        if self._mount.distance(given) <= MAX_OFF_M and abs(off.yaw) <= MAX_OFF_RAD:
            return ""
        mount = self._mount
        return (
            f"by /tf_static {laser} is at x {given.x:.3f} m, y {given.y:.3f} m, yaw {degrees(given.yaw):.1f} degrees "
            f"of {self._base}; the robot file has {mount.x:.3f}, {mount.y:.3f}, {degrees(mount.yaw):.1f}: "
            f"set robot.laser.mount={{x: {given.x:.3f}, y: {given.y:.3f}, yaw: {given.yaw:.4f}}}"
        )

    def _base_from(self, laser: str) -> Float64s | None:
        """(4, 4), or None where no transforms lead there."""
        frames = Frames()
        for child, (parent, row) in self._rows.items():
            frames.add(parent, child, 0, row, static=True)
        found = frames.find(self._base, laser, np.zeros(1, np.int64))
        return None if found is None else np.asarray(found[0])
