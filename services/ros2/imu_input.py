# SPDX-License-Identifier: Apache-2.0
"""The inertial sensor of a driven robot: sensor_msgs/Imu as `imu` in `base`.

Its mount is the robot file's. A gyro with the wrong sign turns the map the wrong way round, so readings are refused
where /tf_static contradicts the file.
"""

from math import nan
from typing import Any

from services.ros2.incoming_topics import MAX_TURN_RATE
from services.ros2.static_frames import StaticFrames
from shared.imu_axes import imu_in_base
from shared.messages import Imu
from shared.robot import ImuMount
from shared.ros_frames import level, tilt, upside_down
from shared.ros_readings import frame_name

MAX_ACCELERATION = 400.0  # m/s^2: the bound of shared/messages.py
NOT_MEASURED = -1.0  # first element of a covariance in sensor_msgs/Imu


class ImuInput:
    """Readings of one sensor."""

    def __init__(self, mount: ImuMount, frames: StaticFrames) -> None:
        self._mount, self._frames = mount, frames
        self._checked: object = None  # frame that was compared, and the transforms
        self._problem = ""

    def reading(self, message: Any, stamp: int) -> Imu:
        """A reading in `base`. stamp: ns on our clock.  Raises ValueError where it has no turn rate to be used."""
        frame = frame_name(message.header.frame_id)
        present = frame, self._frames.n_messages
        if present != self._checked:
            self._checked, self._problem = present, self._mount_problem(frame)
        if self._problem:
            raise ValueError(self._problem)
        rate = float(message.angular_velocity.z)
        if message.angular_velocity_covariance[0] == NOT_MEASURED or not abs(rate) <= MAX_TURN_RATE:
            raise ValueError("an inertial sensor without a turn rate")
        force = message.linear_acceleration
        parts = [float(part) for part in (force.x, force.y, force.z)]
        is_measured = message.linear_acceleration_covariance[0] != NOT_MEASURED
        if not is_measured or not all(abs(part) <= MAX_ACCELERATION for part in parts):
            parts = [nan, nan, nan]
        return imu_in_base(self._mount, stamp, rate, *parts)

    def _mount_problem(self, frame: str) -> str:
        """What /tf_static says against the mount in the robot file; empty where it agrees, or does not say it."""
        found = self._frames.base_from(frame)
        if found is None:
            return ""
        if not level(found):
            return f"by /tf_static {frame} is tilted by {tilt(found):.0f} degrees: its z is not the turn rate"
        if upside_down(found) == self._mount.upside_down:
            return ""
        how = "upside-down" if upside_down(found) else "upright"
        return f"by /tf_static {frame} is {how}: set robot.imu.upside_down={str(upside_down(found)).lower()}"
