# SPDX-License-Identifier: Apache-2.0
"""A robot with ROS 2 that zenav drives: its /scan and /odom come in, and the velocity goes out as /cmd_vel.

Stamps are of the robot's clock, which is another computer's. A message is as old as it comes later than the robot's
fastest one in the last 10 to 20 s (sender_clocks.py). So a clock that differs does no harm. After a clock is set back,
messages are too old until the former minimum is forgotten, and the guard stops the robot.
"""

from typing import Any

import numpy as np

from services.ros2.incoming_topics import TWIST, TWIST_STAMPED, IncomingTopic
from services.ros2.orders import publish_order
from services.ros2.outgoing_topics import DEFAULT, OutgoingTopic
from services.ros2.rmw_names import Qos, Reliability
from services.ros2.ros_types import RosTypes
from services.ros2.sender_clocks import SenderClocks
from shared import topics
from shared.messages import BaseOdometry, Velocity
from shared.ros_messages import ODOM, SCAN, RosMessages, pose2
from shared.ros_readings import covariance, laser_scan
from shared.service import Out
from shared.types import NS_PER_S

SENSOR_QOS = Qos(Reliability.BEST_EFFORT, depth=5)
ROBOT_SCAN, ROBOT_ODOM = "/scan", "/odom"
ROBOT_TOPICS = (
    IncomingTopic(ROBOT_SCAN, (SCAN,), SENSOR_QOS),
    IncomingTopic(ROBOT_ODOM, (ODOM,), SENSOR_QOS),
)
COMMAND, STAMPED_COMMAND = "/cmd_vel", "/cmd_vel of stamped messages"
COMMAND_TOPICS = (
    OutgoingTopic(COMMAND, TWIST, DEFAULT, (), lambda state, message, publisher: None),
    OutgoingTopic(STAMPED_COMMAND, TWIST_STAMPED, DEFAULT, (), lambda state, message, publisher: None),
)
"""Both types of one name: a robot subscribes to one of them."""
CLOCK = b"robot"  # one for all topics: a scan has the stamp of its first beam, and odometry comes sooner
MAX_SILENCE_NS = 200_000_000  # without a velocity of base_driver, after which the robot gets zero


class RobotInput:
    """Translates between a robot with ROS 2 and the stack. Times are ns on the stack's clock."""

    def __init__(self, types: RosTypes, make: RosMessages) -> None:
        self._types, self._make = types, make
        self._clocks = SenderClocks()
        self._command: Velocity | None = None  # the newest, while the robot moves by it

    def message(self, name: str, type_: str, data: bytes, now: int) -> Out:
        """A message of ROBOT_TOPICS. Raises ValueError where it is none."""
        message = self._types.decode(data, type_)
        sent = message.header.stamp.sec * NS_PER_S + message.header.stamp.nanosec
        stamp = now - self._clocks.age(CLOCK, sent, now)
        if name == ROBOT_SCAN:
            yield topics.SCAN(laser_scan(message, stamp, mirrored=False))
        else:
            yield topics.BASE_MOTION(self._odometry(message, stamp))

    def velocity(self, command: Velocity, now: int) -> Out:
        """The velocity of base_driver, for the robot."""
        self._command = command if command.v or command.w else None
        yield from self._published(command.v, command.w, now)

    def tick(self, now: int) -> Out:
        """Zero, where base_driver fell silent while the robot moves."""
        if self._command is not None and not 0 <= now - self._command.stamp < MAX_SILENCE_NS:
            self._command = None
            yield from self._published(0.0, 0.0, now)

    def _published(self, v: float, w: float, now: int) -> Out:
        twist = self._make.twist(v, w)
        stamped = self._make.new(TWIST_STAMPED, header=self._make.header(now, self._make.frames.base), twist=twist)
        yield publish_order(now, COMMAND, self._types.encode(twist))
        yield publish_order(now, STAMPED_COMMAND, self._types.encode(stamped))

    def _odometry(self, message: Any, stamp: int) -> BaseOdometry:
        twist = message.twist.twist
        odometry = BaseOdometry(
            stamp=stamp,
            epoch=0,
            has_pose=True,
            odom_from_base=pose2(message.pose.pose),
            has_twist=True,
            v=float(twist.linear.x),
            vy=float(twist.linear.y),
            w=float(twist.angular.z),
            covariance=covariance(message.pose.covariance),
            twist_covariance=np.zeros(9),
            battery=float("nan"),
        )
        if (problem := odometry.problem()) is not None:
            raise ValueError(problem)
        return odometry
