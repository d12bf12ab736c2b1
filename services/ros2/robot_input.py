# SPDX-License-Identifier: Apache-2.0
"""A robot with ROS 2 that zenav drives: its laser and odometry come in, and the velocity goes out as /cmd_vel.

Stamps are of the robot's clock, which is another computer's. A message is as old as it comes later than the robot's
fastest one in the last 10 to 20 s (sender_clocks.py). So a clock that differs does no harm. After a clock is set back,
messages are too old until the former minimum is forgotten, and the guard stops the robot.

The laser's mount is the robot file's. /tf_static gives it too: a difference is logged, and an upside-down laser's beams
are turned about.
"""

from typing import Any

import numpy as np

from services.ros2.config import Ros2Config
from services.ros2.incoming_topics import TWIST, TWIST_STAMPED, IncomingTopic
from services.ros2.laser_mount import LaserMount
from services.ros2.orders import publish_order
from services.ros2.outgoing_topics import DEFAULT, LATCHED, TF_QOS, OutgoingTopic
from services.ros2.rmw_names import Qos, Reliability
from services.ros2.ros_types import RosTypes
from services.ros2.sender_clocks import SenderClocks
from shared import topics
from shared.config import Laser
from shared.geometry import Pose2
from shared.messages import BaseOdometry, Velocity
from shared.ros_messages import ODOM, SCAN, TF, RosMessages, pose2, pose_of_transform
from shared.ros_readings import covariance, laser_scan, stamp_of
from shared.service import Log, Out
from shared.types import Float64s

SENSOR_QOS = Qos(Reliability.BEST_EFFORT, depth=5)
ROBOT_SCAN, ROBOT_ODOM, ROBOT_TF, ROBOT_STATIC_TF = "/scan", "/odom", "/tf", "/tf_static"
ROBOT_TOPICS = (
    IncomingTopic(ROBOT_SCAN, (SCAN,), SENSOR_QOS),
    IncomingTopic(ROBOT_ODOM, (ODOM,), SENSOR_QOS),
    IncomingTopic(ROBOT_TF, (TF,), TF_QOS),
    IncomingTopic(ROBOT_STATIC_TF, (TF,), LATCHED),
)
"""Of /odom and /tf one is subscribed to (`robot_topics`)."""
COMMAND, STAMPED_COMMAND = "/cmd_vel", "/cmd_vel of stamped messages"
COMMAND_TOPICS = (
    OutgoingTopic(COMMAND, TWIST, DEFAULT, (), lambda state, message, publisher: None),
    OutgoingTopic(STAMPED_COMMAND, TWIST_STAMPED, DEFAULT, (), lambda state, message, publisher: None),
)
"""Both types of one name: a robot subscribes to one of them."""
CLOCK = b"robot"  # one for all topics: a scan has the stamp of its first beam, and odometry comes sooner
MAX_SILENCE_NS = 200_000_000  # without a velocity of base_driver, after which the robot gets zero


def robot_topics(odometry: str) -> tuple[IncomingTopic, ...]:
    """What our node subscribes to. odometry: "odom" or "tf", the topic that has it."""
    left_out = ROBOT_ODOM if odometry == "tf" else ROBOT_TF
    return tuple(row for row in ROBOT_TOPICS if row.name != left_out)


class RobotInput:
    """Translates between a robot with ROS 2 and the stack. Times are ns on the stack's clock."""

    def __init__(self, config: Ros2Config, types: RosTypes, make: RosMessages, laser: Laser) -> None:
        self._types, self._make = types, make
        self._clocks = SenderClocks()
        self._mount = LaserMount(laser.mount, config.frames.base)
        self._command: Velocity | None = None  # the newest, while the robot moves by it

    def message(self, name: str, type_: str, data: bytes, now: int) -> Out:
        """A message of ROBOT_TOPICS. Raises ValueError where it is none."""
        message = self._types.decode(data, type_)
        if name == ROBOT_SCAN:
            yield from self._scan(message, now)
        elif name == ROBOT_ODOM:
            yield topics.BASE_MOTION(_odometry_of_topic(message, self._stamp(message.header, now)))
        elif name == ROBOT_TF:
            yield from self._moving(message, now)
        else:
            self._mount.add(message)

    def velocity(self, command: Velocity, now: int) -> Out:
        """The velocity of base_driver, for the robot."""
        self._command = command if command.v or command.w else None
        yield from self._published(command.v, command.w, now)

    def tick(self, now: int) -> Out:
        """Zero, where base_driver fell silent while the robot moves."""
        if self._command is not None and not 0 <= now - self._command.stamp < MAX_SILENCE_NS:
            self._command = None
            yield from self._published(0.0, 0.0, now)

    def _stamp(self, header: Any, now: int) -> int:
        """The time of a header on our clock."""
        return now - self._clocks.age(CLOCK, stamp_of(header), now)

    def _scan(self, message: Any, now: int) -> Out:
        warning = self._mount.check(message.header.frame_id)
        if warning:
            yield Log("WARNING", f"ROS 2: {warning}")
        yield topics.SCAN(laser_scan(message, self._stamp(message.header, now), self._mount.is_upside_down))

    def _moving(self, message: Any, now: int) -> Out:
        """The odometry among transforms. Raises ValueError where `odom` has another child than the base."""
        frames = self._make.frames
        children = {str(row.child_frame_id): row for row in message.transforms if row.header.frame_id == frames.odom}
        if frames.base in children:
            row = children[frames.base]
            yield topics.BASE_MOTION(_odometry_of_transform(row.transform, self._stamp(row.header, now)))
        elif children:
            child = next(iter(children))
            raise ValueError(f"{frames.odom} has the child {child}, not {frames.base}: set ros2.frames.base={child}")

    def _published(self, v: float, w: float, now: int) -> Out:
        twist = self._make.twist(v, w)
        stamped = self._make.new(TWIST_STAMPED, header=self._make.header(now, self._make.frames.base), twist=twist)
        yield publish_order(now, COMMAND, self._types.encode(twist))
        yield publish_order(now, STAMPED_COMMAND, self._types.encode(stamped))


def _odometry_of_topic(message: Any, stamp: int) -> BaseOdometry:
    """Of nav_msgs/Odometry."""
    twist = message.twist.twist
    velocity = float(twist.linear.x), float(twist.linear.y), float(twist.angular.z)
    return _odometry(stamp, pose2(message.pose.pose), velocity, covariance(message.pose.covariance))


def _odometry_of_transform(transform: Any, stamp: int) -> BaseOdometry:
    """Of geometry_msgs/Transform, which has neither a velocity nor a covariance."""
    return _odometry(stamp, pose_of_transform(transform), None, np.zeros(9))


def _odometry(stamp: int, pose: Pose2, velocity: tuple[float, float, float] | None, spread: Float64s) -> BaseOdometry:
    """velocity: m/s forward and to the left, rad/s; None without one.  spread: the pose's covariance, (9,)."""
    v, vy, w = velocity or (0.0, 0.0, 0.0)
    odometry = BaseOdometry(
        stamp=stamp,
        epoch=0,
        has_pose=True,
        odom_from_base=pose,
        has_twist=velocity is not None,
        v=v,
        vy=vy,
        w=w,
        covariance=spread,
        twist_covariance=np.zeros(9),
        battery=float("nan"),
    )
    if (problem := odometry.problem()) is not None:
        raise ValueError(problem)
    return odometry
