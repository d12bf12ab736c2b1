# SPDX-License-Identifier: Apache-2.0
"""A robot with ROS 2 that zenav drives: its sensors and odometry come in, and the velocity goes out as /cmd_vel.

Stamps are of the robot's clock, which is another computer's. A message is as old as it comes later than the robot's
fastest one in the last 10 to 20 s. So a clock that differs does no harm. While a clock that was set is not believed
(robot_clock.py), the robot gets zero. Odometry passes as too old then, by which the guard says `bad_stamps`, and other
messages are refused.

The laser's mount is the robot file's. /tf_static gives it too: a difference is logged, and an upside-down laser's beams
are turned about.
"""

from dataclasses import replace
from typing import Any

import numpy as np

from services.ros2.config import Ros2Config
from services.ros2.imu_input import ImuInput
from services.ros2.incoming_topics import TWIST, TWIST_STAMPED, IncomingTopic
from services.ros2.laser_mount import LaserMount
from services.ros2.orders import publish_order
from services.ros2.outgoing_topics import LATCHED, TF_QOS
from services.ros2.rmw_names import Qos, Reliability
from services.ros2.robot_clock import STEADY_NS, RobotClock
from services.ros2.ros_types import RosTypes
from services.ros2.static_frames import StaticFrames
from shared import topics
from shared.config import Robot
from shared.geometry import Pose2
from shared.messages import MAX_CONTACTS, BaseOdometry, Contacts, Velocity
from shared.robot import ImuMount
from shared.ros_messages import ODOM, SCAN, TF, RosMessages, pose2, pose_of_transform
from shared.ros_readings import covariance, frame_name, laser_scan, stamp_of
from shared.service import Log, Out
from shared.topics import Publication
from shared.types import NS_PER_S, Float64s

HAZARDS = "irobot_create_msgs/msg/HazardDetectionVector"
SENSOR_QOS = Qos(Reliability.BEST_EFFORT, depth=5)
ROBOT_SCAN, ROBOT_ODOM, ROBOT_TF, ROBOT_STATIC_TF = "/scan", "/odom", "/tf", "/tf_static"
ROBOT_BATTERY, ROBOT_HAZARDS = "/battery_state", "/hazard_detection"
ROBOT_IMU = "/imu"
ROBOT_TOPICS = (
    IncomingTopic(ROBOT_SCAN, (SCAN,), SENSOR_QOS),
    IncomingTopic(ROBOT_ODOM, (ODOM,), SENSOR_QOS),
    IncomingTopic(ROBOT_TF, (TF,), TF_QOS),
    IncomingTopic(ROBOT_STATIC_TF, (TF,), LATCHED),
    IncomingTopic(ROBOT_BATTERY, ("sensor_msgs/msg/BatteryState",), SENSOR_QOS),
    IncomingTopic(ROBOT_HAZARDS, (HAZARDS,), SENSOR_QOS),
    IncomingTopic(ROBOT_IMU, ("sensor_msgs/msg/Imu",), SENSOR_QOS),
)
"""Of /odom and /tf one is subscribed to, and /imu by a setting (`robot_topics`)."""
BUMP, CLIFF, WHEEL_DROP = 1, 2, 4
"""of irobot_create_msgs/HazardDetection. A dropped wheel is a cliff; stalled wheels are base_driver's to detect."""
MAX_VOLTAGE, MAX_VOLTAGE_AGE_NS = 100.0, 60_000_000_000  # V; ns, of the last message of the battery
COMMAND, STAMPED_COMMAND = "/cmd_vel", "/cmd_vel of stamped messages"
COMMAND_TYPES = {COMMAND: TWIST, STAMPED_COMMAND: TWIST_STAMPED}
"""Both types of one name, by label: a robot subscribes to one of them (command_subscribers.py)."""
MIN_CLOCK_STEP_NS = 1_000_000_000  # by which the robot's clock must differ to be reported
MAX_SILENCE_NS = 200_000_000  # without a velocity of base_driver, after which the robot gets zero


def robot_topics(config: Ros2Config) -> tuple[IncomingTopic, ...]:
    """What our node subscribes to of a robot that is driven."""
    left_out = {ROBOT_ODOM if config.odometry == "tf" else ROBOT_TF} | (set() if config.imu else {ROBOT_IMU})
    return tuple(row for row in ROBOT_TOPICS if row.name not in left_out)


def contacts_of(detections: Any, stamp: int) -> Contacts:
    """Bumpers and cliff sensors, by the frames in which they detect something. stamp: ns."""
    names = [(int(row.type), frame_name(row.header.frame_id)) for row in detections[:MAX_CONTACTS]]
    bumpers = tuple(sorted({name for type_, name in names if type_ == BUMP}))
    cliffs = tuple(sorted({name for type_, name in names if type_ in (CLIFF, WHEEL_DROP)}))
    return Contacts(stamp, bumpers, cliffs, False)


class ClockDoubtError(ValueError):
    """A message whose age is not known, for the robot's clock was set."""


class RobotInput:
    """Translates between a robot with ROS 2 and the stack. Times are ns on the stack's clock."""

    def __init__(self, config: Ros2Config, types: RosTypes, make: RosMessages, robot: Robot) -> None:
        self._types, self._make, self._has_contacts = types, make, robot.has_contacts
        self._clock = RobotClock()  # one for all topics: a scan has the stamp of its first beam, and odometry is sooner
        self._base_clock = RobotClock()  # of a board that is a computer of its own, as a Create 3
        self._frames = StaticFrames(config.frames.base)
        self._mount = LaserMount(robot.laser.mount, self._frames)
        self._imu = ImuInput(robot.imu or ImuMount(), self._frames)
        self._said_offset = 0  # ns by which our clock is ahead of the robot's, as it was logged last
        self._said_doubt = ""
        self._command: Velocity | None = None  # the newest, while the robot moves by it
        self._voltage = float("nan")
        self._voltage_at = 0  # ns, when it came

    def message(self, name: str, type_: str, data: bytes, now: int) -> Out:
        """A message of ROBOT_TOPICS. Raises ValueError where it is none."""
        message = self._types.decode(data, type_)
        if name == ROBOT_SCAN:
            yield from self._scan(message, now)
        elif name == ROBOT_ODOM:
            yield self._motion(_odometry_of_topic(message, self._stamp(message.header, now)))
        elif name == ROBOT_TF:
            yield from self._moving(message, now)
        elif name == ROBOT_STATIC_TF:
            self._frames.add(message)
        elif name == ROBOT_BATTERY:
            self._voltage, self._voltage_at = float(message.voltage), now
        elif name == ROBOT_IMU:
            yield topics.IMU(self._imu.reading(message, self._believed_stamp(message.header, now, self._clock)))
        elif self._has_contacts:
            stamp = self._believed_stamp(message.header, now, self._base_clock)
            yield topics.CONTACTS(contacts_of(message.detections, stamp))

    def velocity(self, command: Velocity, now: int) -> Out:
        """The velocity of base_driver, for the robot. Zero where it is old, or the robot's clock is not believed."""
        is_old = now - command.stamp >= MAX_SILENCE_NS  # it waited while this process was held up
        v, w = (command.v, command.w) if self._clock.is_believed and not is_old else (0.0, 0.0)
        self._command = command if v or w else None
        yield from self._published(v, w, now)

    @property
    def state(self) -> str:
        """Words for the health on the robot's clock; empty where it is as ours."""
        if self._said_doubt:
            return f"its clock {self._said_doubt}"
        return f"its clock is {_offset_text(self._said_offset)} ours" if self._said_offset else ""

    def tick(self, now: int) -> Out:
        """Zero, where base_driver fell silent while the robot moves; a log line where the robot's clock was set."""
        yield from self._clock_lines()
        if self._command is not None and not 0 <= now - self._command.stamp < MAX_SILENCE_NS:
            self._command = None
            yield from self._published(0.0, 0.0, now)

    def on_shutdown(self, now: int) -> Out:
        """Zero, where the robot moves: after our end nothing stops it."""
        if self._command is not None:
            yield from self._published(0.0, 0.0, now)

    def _clock_lines(self) -> Out:
        """A line when the clock is doubted, and when it is believed again or differs."""
        doubt, offset = self._clock.doubt, self._clock.offset or 0
        if bool(doubt) != bool(self._said_doubt):
            self._said_doubt = doubt
            wait = f"the robot stands until it is steady for {STEADY_NS // NS_PER_S} s"
            yield Log("WARNING", f"ROS 2: the robot's clock {f'{doubt}: {wait}' if doubt else 'is believed again'}")
        if abs(offset - self._said_offset) > MIN_CLOCK_STEP_NS:
            self._said_offset = offset if abs(offset) > MIN_CLOCK_STEP_NS else 0
            words = f"{_offset_text(offset)} ours" if self._said_offset else "as ours again"
            yield Log("WARNING", f"ROS 2: the robot's clock is {words}")

    def _stamp(self, header: Any, now: int) -> int:
        """The time of a header on our clock; long ago where the robot's clock is not believed."""
        return now - self._clock.age(stamp_of(header), now)

    @staticmethod
    def _believed_stamp(header: Any, now: int, clock: RobotClock) -> int:
        """The time of a header on our clock. Raises ClockDoubtError where the robot's is not believed."""
        stamp = now - clock.age(stamp_of(header), now)
        if not clock.is_believed:
            raise ClockDoubtError(
                f"its stamp is {clock.off / NS_PER_S:.1f} s off the robot's clock: its age is not known"
            )
        return stamp

    def _motion(self, odometry: BaseOdometry) -> Publication:
        """Odometry with the battery's voltage, which comes seldom; NaN where it is old or none."""
        is_recent = 0 <= odometry.stamp - self._voltage_at < MAX_VOLTAGE_AGE_NS
        is_measured = 0 < self._voltage <= MAX_VOLTAGE
        battery = self._voltage if is_recent and is_measured else float("nan")
        return topics.BASE_MOTION(replace(odometry, battery=battery))

    def _scan(self, message: Any, now: int) -> Out:
        warning = self._mount.check(message.header.frame_id)
        if warning:
            yield Log("WARNING", f"ROS 2: {warning}")
        stamp = self._believed_stamp(message.header, now, self._clock)
        yield topics.SCAN(laser_scan(message, stamp, self._mount.is_upside_down))

    def _moving(self, message: Any, now: int) -> Out:
        """The odometry among transforms. Raises ValueError where `odom` has another child than the base."""
        frames = self._make.frames
        children = {str(row.child_frame_id): row for row in message.transforms if row.header.frame_id == frames.odom}
        if frames.base in children:
            row = children[frames.base]
            yield self._motion(_odometry_of_transform(row.transform, self._stamp(row.header, now)))
        elif children:
            child = next(iter(children))
            raise ValueError(f"{frames.odom} has the child {child}, not {frames.base}: set ros2.frames.base={child}")

    def _published(self, v: float, w: float, now: int) -> Out:
        twist = self._make.twist(v, w)
        stamped = self._make.new(TWIST_STAMPED, header=self._make.header(now, self._make.frames.base), twist=twist)
        yield publish_order(now, COMMAND, self._types.encode(twist))
        yield publish_order(now, STAMPED_COMMAND, self._types.encode(stamped))


def _offset_text(offset: int) -> str:
    """offset: ns by which our clock is ahead of the robot's."""
    return f"{abs(offset) / NS_PER_S:.1f} s {'behind' if offset > 0 else 'ahead of'}"


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
