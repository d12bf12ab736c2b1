# SPDX-License-Identifier: Apache-2.0
"""zenav maps and drives a robot that has ROS 2: its laser, its odometry and /cmd_vel are topics of another computer."""

import threading
import time
from contextlib import contextmanager

import numpy as np

from services.ros2.rmw_names import Entity, Qos, RosName, RosNode, attachment, topic_key
from services.ros2.ros_types import Distro, ros_types
from shared import topics
from shared.config import load_robot
from shared.geometry import Pose2
from shared.messages import LaserScan, Odometry
from shared.ros_messages import ODOM, SCAN, RosFrames, RosMessages
from tests.stack.processes import running
from tests.unit.services.ros2.network import free_port, router, session

ROBOT = load_robot("x80sv").robot
TYPES = ros_types(Distro.JAZZY)
MAKE = RosMessages(TYPES.types, RosFrames())
TWIST = "geometry_msgs/msg/Twist"
HALF_X, HALF_Y = 2.5, 1.5  # m, of a rectangular room with the robot's start in its middle
CLOCK_NS = -7200 * 10**9  # of the robot, less ours
PERIOD_S, TICKS_A_SCAN = 0.02, 5
SERVICES = ("base_driver", "odometry", "mapper", "planner", "local_ctrl", "guard", "navigator", "ros2")
SETTINGS = ("robot.drive.kind=velocity", "robot.ranges=[]", "ros2.drives=true")


class RosRobot:
    """A node that moves as /cmd_vel says, and publishes /odom and /scan. It stands without a new command for 0.5 s."""

    def __init__(self, opened) -> None:
        self._session, self.pose, self._command, self._commanded_at = opened, Pose2(), (0.0, 0.0), 0.0
        self.n_commands, self._n = 0, 0
        self._ending = threading.Event()
        self._subscriber = opened.declare_subscriber(self._key("/cmd_vel", TWIST), self._hear)
        node = RosNode(0, str(opened.info.zid()), "/", "robot")
        command = RosName("/cmd_vel", TWIST, TYPES.hash_of(TWIST))
        self._token = opened.liveliness().declare_token(node.endpoint_token(1, Entity.SUBSCRIPTION, command, Qos()))
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        self._ending.set()
        self._thread.join()

    def _key(self, name, type_):
        return topic_key(0, RosName(name, type_, TYPES.hash_of(type_)))

    def _hear(self, sample) -> None:
        twist = TYPES.decode(sample.payload.to_bytes(), TWIST)
        self._command, self._commanded_at = (twist.linear.x, twist.angular.z), time.monotonic()
        self.n_commands += 1

    def _run(self) -> None:
        due, tick = time.monotonic(), 0
        while not self._ending.wait(max(0.0, due - time.monotonic())):
            due, tick = due + PERIOD_S, tick + 1
            v, w = self._command if time.monotonic() - self._commanded_at < 0.5 else (0.0, 0.0)
            self.pose = self.pose @ Pose2(v * PERIOD_S, 0.0, w * PERIOD_S)
            stamp = time.time_ns() + CLOCK_NS
            covariance = np.diag([1e-4, 1e-4, 1e-4]).ravel()
            self._send("/odom", ODOM, MAKE.odometry(Odometry(stamp, self.pose, v, w, covariance)))
            if tick % TICKS_A_SCAN == 0:
                self._send("/scan", SCAN, MAKE.scan(self._scan(stamp)))

    def _send(self, name, type_, message) -> None:
        self._n += 1
        data = attachment(self._n, time.time_ns() + CLOCK_NS, bytes(16))
        self._session.put(self._key(name, type_), TYPES.encode(message), attachment=data)

    def _scan(self, stamp) -> LaserScan:
        laser, mount = ROBOT.laser, ROBOT.laser.mount
        at = self.pose @ Pose2(mount.x, mount.y, mount.yaw)
        angles = at.yaw + laser.angle_min + laser.angle_increment * np.arange(laser.n_beams)
        with np.errstate(divide="ignore"):
            to_x = (np.copysign(HALF_X, np.cos(angles)) - at.x) / np.cos(angles)
            to_y = (np.copysign(HALF_Y, np.sin(angles)) - at.y) / np.sin(angles)
        noise = np.random.default_rng(self._n).normal(0, 0.005, laser.n_beams)
        ranges = (np.minimum(to_x, to_y) + noise).astype(np.float32)
        return LaserScan(stamp, laser.angle_min, laser.angle_increment, 0.0, laser.range_min, laser.range_max, ranges)


@contextmanager
def ros_robot(port):
    with session("client", port) as opened:
        robot = RosRobot(opened)
        try:
            yield robot
        finally:
            robot.close()


def test_a_robot_with_ros_is_mapped_and_driven_to_a_goal_and_stands_when_its_laser_is_lost(tmp_path):
    port = free_port()
    settings = (*SETTINGS, f"ros2.port.device=zenoh://tcp/127.0.0.1:{port}")
    with router(port), ros_robot(port) as robot, running(tmp_path, SERVICES, settings=settings) as stack:
        stack.client.follow(topics.CMD_VEL)
        task = stack.go(Pose2(0.8, 0.3, 0.0))
        stack.until(stack.reached(task), 60)
        assert robot.pose.distance(Pose2(0.8, 0.3, 0.0)) < 0.35
        estimate = stack.client.latest(topics.POSE).map_from_base
        assert estimate.distance(robot.pose) < 0.1
        stack.go(Pose2(-1.2, 0.0, 0.0))
        stack.until(lambda: stack.client.latest(topics.CMD_VEL).v > 0.05)
        robot.close()
        stack.until(lambda: stack.client.latest(topics.CMD_VEL).v == 0.0)
