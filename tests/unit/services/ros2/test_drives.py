# SPDX-License-Identifier: Apache-2.0
"""A short drive in each format and distribution: of a robot with ROS 2, and by a goal of a ROS 2 node."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

from services.ros2.action_goal import GoalState
from services.ros2.ros_types import UUID, Distro, ros_types
from shared import requests, sample_messages
from shared.config import load_robot
from shared.geometry import Pose2
from shared.messages import BaseOdometry, LaserScan, Message, NavState, Odometry
from shared.ros_messages import RosFrames, RosMessages
from tests.unit.services.ros2.network import LIMIT_S, ROBOT, free_port, router, session
from tests.unit.services.ros2.wired_core import Node, WiredCore

LASER = load_robot(ROBOT).robot.laser
CLOCK_NS = -3600 * 10**9  # of the robot, less ours
PERIOD_S, SPEED, GOAL_M = 0.02, 0.5, 0.2
TWIST, TWIST_STAMPED = "geometry_msgs/msg/Twist", "geometry_msgs/msg/TwistStamped"
TO_POSE, TO_POSE_TYPE = "/navigate_to_pose", "nav2_msgs/action/NavigateToPose"
WIRES = [(bridge, distro) for bridge in ("rmw_zenoh", "dds") for distro in Distro]


@contextmanager
def wired(bridge: str, distro: Distro, hear: Any, **section: Any) -> Iterator[tuple[WiredCore, Node]]:
    port = free_port()
    with router(port):
        core = WiredCore(port, hear, bridge=bridge, distro=distro, **section)
        core.device.start()
        try:
            core.wait_open()
            with session("client", port) as opened:
                yield core, Node(opened, ros_types(distro), bridge)
        finally:
            core.device.close()


class RosRobot:
    """A node that moves along its x axis as /cmd_vel says, and publishes /odom and /scan."""

    def __init__(self, node: Node, command_type: str) -> None:
        self.node, self.x, self._v = node, 0.0, 0.0
        self.make = RosMessages(node.types.types, RosFrames())
        self._declared = node.subscribe("/cmd_vel", command_type, self._obey)
        self._ending, self.stands = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        self._ending.set()
        self._thread.join()

    def _obey(self, message: Any) -> None:
        self._v = getattr(message, "twist", message).linear.x
        (self.stands.clear if self._v else self.stands.set)()

    def _run(self) -> None:
        while not self._ending.wait(PERIOD_S):
            self.x += self._v * PERIOD_S
            stamp = time.time_ns() + CLOCK_NS
            odometry = Odometry(stamp, Pose2(self.x, 0.0, 0.0), self._v, 0.0, np.zeros(9))
            self.node.publish("/odom", self.make.odometry(odometry))
            self.node.publish("/scan", self.make.scan(sample_messages.scan(stamp, LASER)))


@pytest.mark.parametrize("command_type", [TWIST, TWIST_STAMPED])
@pytest.mark.parametrize(("bridge", "distro"), WIRES)
def test_a_robot_with_ros_drives_to_a_place_and_stands(bridge, distro, command_type):
    kinds: set[type[Message]] = set()
    poses: list[float] = []

    def drive(core: WiredCore, message: Message) -> None:
        """Stands in for the stack: forward until odometry is there."""
        kinds.add(type(message))
        if isinstance(message, BaseOdometry):
            poses.append(message.odom_from_base.x)
            assert abs(core.service.now - message.stamp) < LIMIT_S * 1e9, "on our clock"
            core.command(SPEED if message.odom_from_base.x < GOAL_M else 0.0)

    with wired(bridge, distro, drive, drives=True) as (core, node):
        robot = RosRobot(node, command_type)
        try:
            core.wait(lambda: len(poses) > 10 and poses[-1] >= GOAL_M and poses[-1] == poses[-10])
            assert robot.x == pytest.approx(poses[-1])
            assert {BaseOdometry, LaserScan} <= kinds
            assert not [event for event in core.events if event["event"] == "rejected" and "type" in event["text"]]
        finally:
            robot.close()


@pytest.mark.parametrize("bridge", ["rmw_zenoh", "dds"])
def test_a_robot_with_ros_that_moves_when_the_bridge_ends_gets_zero(bridge):
    moves = threading.Event()

    def drive(core: WiredCore, message: Message) -> None:
        if isinstance(message, BaseOdometry):
            core.command(SPEED)
            if message.v > 0:
                moves.set()

    with wired(bridge, Distro.JAZZY, drive, drives=True) as (core, node):
        robot = RosRobot(node, TWIST)
        try:
            assert moves.wait(LIMIT_S)
            core.end()
            assert robot.stands.wait(LIMIT_S)
        finally:
            robot.close()


@pytest.mark.parametrize(("bridge", "distro"), WIRES)
def test_a_goal_of_a_node_is_accepted_followed_and_reached(bridge, distro):
    with wired(bridge, distro, lambda core, message: None) as (core, node):
        make, feedback, came = RosMessages(node.types.types, RosFrames()), [], threading.Event()

        def hear(message: Any) -> None:
            feedback.append(message)
            came.set()

        declared = node.subscribe(f"{TO_POSE}/_action/feedback", f"{TO_POSE_TYPE}_FeedbackMessage", hear)
        goal_id = make.new(UUID, uuid=np.arange(16, dtype=np.uint8))
        goal = make.new(f"{TO_POSE_TYPE}_Goal", pose=make.posed(0, Pose2(1.0, 2.0, 0.0), "map"), behavior_tree="")
        request = make.new(f"{TO_POSE_TYPE}_SendGoal_Request", goal_id=goal_id, goal=goal)
        assert node.call(f"{TO_POSE}/_action/send_goal", f"{TO_POSE_TYPE}_SendGoal", request).accepted
        assert core.asked == [requests.NAVIGATE.key]

        for _ in range(100):
            core.status(NavState.NAVIGATING, 1.5)
            if came.wait(0.1):
                break
        assert feedback[0].feedback.distance_remaining == 1.5
        core.status(NavState.REACHED)
        request = make.new(f"{TO_POSE_TYPE}_GetResult_Request", goal_id=goal_id)
        response = node.call(f"{TO_POSE}/_action/get_result", f"{TO_POSE_TYPE}_GetResult", request)
        assert response.status == GoalState.SUCCEEDED
        assert getattr(response.result, "error_code", 0) == 0
        assert declared
