# SPDX-License-Identifier: Apache-2.0
"""Where /tf_static puts the laser of a driven robot, compared with the robot file's mount.

Mapper, guard and local control take the mount from the robot file, so a difference is an error of that file.
"""

from math import degrees

from services.ros2.static_frames import StaticFrames
from shared.config import Mount
from shared.geometry import Pose2
from shared.ros_frames import level, planar, tilt, upside_down
from shared.ros_readings import frame_name

MAX_OFF_M, MAX_OFF_RAD = 0.02, 0.035
"""By these a mount may differ: the values of a robot's description are rounded to a centimetre and a degree or two."""


class LaserMount:
    """What the static transforms say about a laser's mount."""

    def __init__(self, mount: Mount, frames: StaticFrames) -> None:
        self._mount, self._frames = Pose2(mount.x, mount.y, mount.yaw), frames
        self._checked: object = None  # frame of the laser that was compared, and the transforms
        self.is_upside_down = False

    def check(self, laser: str) -> str:
        """What differs of a laser's frame, once after each change; empty where nothing does, or TF does not say it.

        Raises ValueError where a transform is none.
        """
        laser = frame_name(laser)
        present = laser, self._frames.n_messages
        if present == self._checked:
            return ""
        self._checked = present
        found = self._frames.base_from(laser)
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
            f"of {self._frames.base}; the robot file has {mount.x:.3f}, {mount.y:.3f}, {degrees(mount.yaw):.1f}: "
            f"set robot.laser.mount={{x: {given.x:.3f}, y: {given.y:.3f}, yaw: {given.yaw:.4f}}}"
        )
