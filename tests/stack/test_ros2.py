# SPDX-License-Identifier: Apache-2.0
"""A ROS 2 node on a simulated stack: it sends goals, drives, presses STOP; all of it replays to the byte."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from services.ros2.action_goal import GoalState
from services.ros2.outgoing_map import GRID_UPDATE
from services.ros2.ros_types import UUID, Distro, ros_types
from shared import topics
from shared.geometry import Pose2
from shared.messages import GuardState
from shared.ros_messages import GRID, RosFrames, RosMessages
from tests.stack.processes import ALL, StackProcesses, assert_replays, running
from tests.unit.services.ros2.network import RosPeer, free_port, router, session

TYPES = ros_types(Distro.JAZZY)
MAKE = RosMessages(TYPES.types, RosFrames())
ACTION, TYPE = "/navigate_to_pose", "nav2_msgs/action/NavigateToPose"
TRIGGER = "std_srvs/srv/Trigger"


@contextmanager
def joined(folder: Path, path: Path) -> Iterator[tuple[StackProcesses, RosPeer]]:
    """A stack with its recorder, the bridge, a router and a node."""
    port = free_port()
    settings = (f"recorder.file={path}", f"ros2.port.device=zenoh://tcp/127.0.0.1:{port}")
    with router(port), running(folder, (*ALL, "recorder", "ros2"), settings=settings) as stack:
        stack.client.follow(topics.CMD_VEL)
        with session("client", port) as opened:
            stack.until(lambda: stack.healths["ros2"].state == "in domain 0")
            yield stack, RosPeer(opened, TYPES)


def commanded(stack: StackProcesses, v: float) -> bool:
    command = stack.client.latest(topics.CMD_VEL)
    return command is not None and command.v == pytest.approx(v, abs=0.01)


def trigger(peer: RosPeer, name: str) -> Any:
    return peer.call(name, TRIGGER, TYPES.new(f"{TRIGGER}_Request", structure_needs_at_least_one_member=0))[0]


def reach_goal(peer: RosPeer) -> None:
    """Sends a goal by the action, and waits for its result."""
    goal_id = MAKE.new(UUID, uuid=np.arange(16, dtype=np.uint8))
    goal = MAKE.new(f"{TYPE}_Goal", pose=MAKE.posed(0, Pose2(0.5, 0.0, 0.0), "map"), behavior_tree="")
    peer.subscribe(f"{ACTION}/_action/feedback", f"{TYPE}_FeedbackMessage")
    request = MAKE.new(f"{TYPE}_SendGoal_Request", goal_id=goal_id, goal=goal)
    assert peer.call(f"{ACTION}/_action/send_goal", f"{TYPE}_SendGoal", request)[0].accepted
    peer.wait(f"{TYPE}_FeedbackMessage", lambda message: message.feedback.distance_remaining > 0)
    request = MAKE.new(f"{TYPE}_GetResult_Request", goal_id=goal_id)
    response, _ = peer.call(f"{ACTION}/_action/get_result", f"{TYPE}_GetResult", request, limit=60.0)
    assert response.status == GoalState.SUCCEEDED


def spin(peer: RosPeer) -> None:
    """Turns by the action, and waits for its result."""
    type_ = "nav2_msgs/action/Spin"
    goal_id = MAKE.new(UUID, uuid=np.arange(1, 17, dtype=np.uint8))
    allowed = MAKE.new("builtin_interfaces/msg/Duration", sec=20, nanosec=0)
    goal = MAKE.new(f"{type_}_Goal", target_yaw=0.8, time_allowance=allowed)
    request = MAKE.new(f"{type_}_SendGoal_Request", goal_id=goal_id, goal=goal)
    assert peer.call("/spin/_action/send_goal", f"{type_}_SendGoal", request)[0].accepted
    request = MAKE.new(f"{type_}_GetResult_Request", goal_id=goal_id)
    response, _ = peer.call("/spin/_action/get_result", f"{type_}_GetResult", request, limit=30.0)
    assert (response.status, response.result.error_msg) == (GoalState.SUCCEEDED, "")


def test_a_node_sees_the_map_its_changes_and_the_costs_of_the_planner(tmp_path):
    with joined(tmp_path / "logs", tmp_path / "ros2.mcap") as (stack, peer):
        peer.subscribe("/map", GRID)
        peer.subscribe("/map_updates", GRID_UPDATE)
        whole, _ = peer.wait(GRID)
        assert whole.header.frame_id == "map"
        task = stack.go(Pose2(0.8, 0.3, 0.0))
        change, _ = peer.wait(GRID_UPDATE, limit=60.0)
        assert len(change.data) == change.width * change.height
        assert change.x >= 0
        stack.until(stack.reached(task), 60)
        other = RosPeer(peer.session, TYPES)
        other.subscribe("/global_costmap/costmap", GRID)
        costs, _ = other.wait(GRID, lambda message: max(message.data) == 100 and 99 in message.data)
        assert costs.header.frame_id == "map"


def test_a_node_sends_a_goal_drives_and_presses_stop_and_that_replays_to_the_byte(tmp_path):
    path = tmp_path / "ros2.mcap"
    with joined(tmp_path / "logs", path) as (stack, peer):
        reach_goal(peer)
        spin(peer)
        numbers = iter(range(10**6))

        def driving() -> bool:
            peer.publish("/cmd_vel", MAKE.twist(-0.1, 0.0), next(numbers))
            return commanded(stack, -0.1)

        stack.until(driving)
        stack.until(lambda: commanded(stack, 0.0))  # the node is silent
        assert trigger(peer, "/estop").success
        stack.until(lambda: stack.client.latest(topics.GUARD).state is GuardState.STOPPED)
        assert trigger(peer, "/estop_release").success
        peer.session.put(peer.key("/cmd_vel", "geometry_msgs/msg/Twist"), b"junk")
        peer.session.put(
            peer.key("/goal_pose", "geometry_msgs/msg/PoseStamped"), b"\x00\x01\x00\x00", attachment=bytes(33)
        )
        stack.until(lambda: stack.healths["ros2"].rejected)
    assert_replays(path, "ros2", ("cmd/teleop", "estop", "port/tx/ros2"))
