# SPDX-License-Identifier: Apache-2.0
"""Goals, feedback and results of the actions, from ROS's messages to the stack's and back."""

from typing import Any

import numpy as np

from services.ros2.action_goal import ActionGoal, GoalState
from services.ros2.action_topics import Action
from services.ros2.incoming_topics import pose_in_map
from services.ros2.nav2_errors import COLLISION_AHEAD, action_error, navigation_error
from services.ros2.ros_types import Distro
from shared import requests
from shared.geometry import Pose2
from shared.messages import Message, NavStatus, PoseEstimate
from shared.requests import MAX_ROUTE_POSES, DriveStraight, Navigate, Request, Spin
from shared.ros_messages import RosMessages
from shared.types import NS_PER_S

MOTIONS = frozenset(COLLISION_AHEAD)
MAX_TIME_S = 300.0  # of Spin and DriveStraight
MAX_NUMBER = 2**15 - 1  # of an int16
MAX_ROUNDS = 10**6  # of shared/requests.py, Navigate
MAX_STATUSES = 200  # of waypoints, in feedback: five times a second
PENDING, COMPLETED, MISSED = 0, 1, 3  # nav2_msgs/WaypointStatus


def stack_request(now: int, action: Action, goal: Any, frame: str) -> tuple[Request[Any, Any], Message]:
    """The request of a goal. now: ns.  frame: of the map.  Raises ValueError where it is no goal."""
    if action.kind not in MOTIONS:
        return requests.NAVIGATE, navigate_request(now, action, goal, frame)
    if getattr(goal, "disable_collision_checks", False):
        raise ValueError("collision checks are never disabled")
    allowed = goal.time_allowance
    seconds = min(max(allowed.sec + allowed.nanosec / NS_PER_S, 0.0), MAX_TIME_S)
    if action.kind == "Spin":
        return requests.SPIN, Spin(now, float(goal.target_yaw), seconds)
    return requests.DRIVE_STRAIGHT, DriveStraight(now, _distance(action, goal), seconds)


def ignored_fields(action: Action, goal: Any) -> str:
    """What of an accepted goal does not count, in words; empty where all of it does."""
    if action.kind not in MOTIONS:
        return ""
    words = []
    if getattr(goal, "speed", 0.0):
        words.append(
            f"its speed of {goal.speed:.2g} m/s does not count: the robot drives at local_ctrl.manoeuvres.back_up_speed"
        )
    allowed = goal.time_allowance.sec + goal.time_allowance.nanosec / NS_PER_S
    if allowed > MAX_TIME_S:
        words.append(f"it may take {MAX_TIME_S:.0f} s, not {allowed:.0f} s")
    elif allowed <= 0:
        words.append("without a time_allowance it may take 30 s")
    return "; ".join(words)


def amount_of(request: Message) -> float:
    """rad or m of a single motion, without its sign; 0 of other requests."""
    if isinstance(request, Spin):
        return abs(request.angle)
    return abs(request.distance) if isinstance(request, DriveStraight) else 0.0


def _distance(action: Action, goal: Any) -> float:
    """m ahead, negative: back. BackUp drives back whatever the signs are, as in Nav2."""
    x = float(goal.target.x)
    if goal.target.y or goal.target.z:
        raise ValueError("a straight drive has target.x alone")
    if action.kind == "BackUp":
        return -abs(x)
    if x * goal.speed < 0:
        raise ValueError("speed and target.x have different signs")
    return x


def route_of(action: Action, goal: Any) -> tuple[tuple[Any, ...], int]:
    """The poses of a goal, geometry_msgs/PoseStamped, and the number of the first one to drive to."""
    if action.kind in MOTIONS:
        return (), 0
    if action.kind == "NavigateToPose":
        return (goal.pose,), 0
    if not hasattr(goal.poses, "goals"):
        return tuple(goal.poses), int(getattr(goal, "goal_index", 0))
    for pose in goal.poses.goals:  # nav_msgs/Goals: its frame is that of poses without one
        pose.header.frame_id = pose.header.frame_id or goal.poses.header.frame_id
    return tuple(goal.poses.goals), 0


def navigate_request(now: int, action: Action, goal: Any, frame: str) -> Navigate:
    """The request of a goal. now: ns.  frame: of the map.  Raises ValueError where it is no goal."""
    if getattr(goal, "behavior_tree", ""):
        raise ValueError(f"behavior_tree {goal.behavior_tree!r}: there are no behavior trees here, leave it empty")
    stamped, first = route_of(action, goal)
    poses = tuple(pose_in_map(pose.header, pose.pose, frame) for pose in stamped)
    rounds = int(getattr(goal, "number_of_loops", 0)) + 1
    if rounds > MAX_ROUNDS:
        raise ValueError(f"{rounds - 1} loops, where {MAX_ROUNDS - 1} are the limit")
    if first:  # as in Nav2, the rounds after the first one have all poses
        n_poses = rounds * len(poses) - first
        if first >= len(poses) or n_poses > MAX_ROUTE_POSES:
            raise ValueError(f"goal_index {first} of {len(poses)} poses, {rounds} times")
        poses, rounds = poses[first:] + (rounds - 1) * poses, 1
    passes = action.kind == "NavigateThroughPoses"
    request = Navigate(now, poses, dwell=0.0, loops=rounds, any_heading=False, pass_through=passes)
    if (problem := request.problem()) is not None:
        raise ValueError(problem)
    return request


def feedback(
    make: RosMessages, distro: Distro, goal: ActionGoal, status: NavStatus, estimate: PoseEstimate | None, now: int
) -> Any:
    """The feedback of a goal. now: ns."""
    action = goal.action
    type_ = f"{action.type}_Feedback"
    if action.kind in MOTIONS:
        field = "angular_distance_traveled" if action.kind == "Spin" else "distance_traveled"
        return make.new(type_, **{field: max(goal.amount - status.distance_left, 0.0)})
    if action.kind == "FollowWaypoints":
        return make.new(type_, current_waypoint=goal.waypoint)
    pose = estimate.map_from_base if estimate is not None else Pose2()
    stamp = estimate.stamp if estimate is not None else now
    fields = {
        "current_pose": make.posed(stamp, pose, make.frames.map),
        "navigation_time": _duration(make, now - goal.begun),
        "estimated_time_remaining": _duration(make, round(status.time_left * NS_PER_S)),
        "number_of_recoveries": min(status.n_recoveries, MAX_NUMBER),
        "distance_remaining": status.distance_left,
    }
    if action.kind == "NavigateThroughPoses":
        fields["number_of_poses_remaining"] = min(len(goal.poses) - goal.waypoint, MAX_NUMBER)
        fields |= _waypoint_statuses(make, distro, goal, MAX_STATUSES)
    return make.new(type_, **fields)


def result(make: RosMessages, distro: Distro, goal: ActionGoal) -> Any:
    """The result of a goal that ended, or of one that is not known."""
    action = goal.action
    fields: dict[str, Any] = {}
    if action.kind in MOTIONS:
        fields["total_elapsed_time"] = _duration(make, goal.ended - goal.begun)
    elif action.kind == "FollowWaypoints":
        fields["missed_waypoints"] = _missed_waypoints(make, distro, goal)
    elif distro is Distro.HUMBLE:
        fields["result"] = make.new("std_msgs/msg/Empty")
    if distro is not Distro.HUMBLE:
        code = action_error(action.kind, distro, goal.reason) if goal.error else 0
        fields |= {"error_code": code, "error_msg": goal.error}
    if action.kind == "NavigateThroughPoses":
        fields |= _waypoint_statuses(make, distro, goal, MAX_ROUTE_POSES)
    return make.new(f"{action.type}_Result", **fields)


def _waypoint_statuses(make: RosMessages, distro: Distro, goal: ActionGoal, limit: int) -> dict[str, Any]:
    """The state of each pose, of at most `limit` poses; before Kilted there is no such field."""
    if distro is not Distro.KILTED:
        return {}
    n_completed = len(goal.poses) if goal.state is GoalState.SUCCEEDED else goal.waypoint
    states = [COMPLETED if i < n_completed else PENDING for i in range(len(goal.poses))]
    if goal.missed is not None:
        states[goal.missed] = MISSED
    rows = [_waypoint(make, goal, i, state) for i, state in enumerate(states)] if len(states) <= limit else []
    return {"waypoint_statuses": rows}


def _missed_waypoints(make: RosMessages, distro: Distro, goal: ActionGoal) -> Any:
    """The waypoint at which a route failed: the stack does not leave it out and go on."""
    missed = [] if goal.missed is None else [goal.missed]
    if distro is Distro.HUMBLE:
        return np.array(missed, np.int32)
    if distro is Distro.KILTED:
        return [_waypoint(make, goal, i, MISSED) for i in missed]
    code = navigation_error(goal.action.kind, goal.reason)
    type_ = "nav2_msgs/msg/MissedWaypoint"
    return [make.new(type_, index=i, goal=goal.poses[i], error_code=code) for i in missed]


def _waypoint(make: RosMessages, goal: ActionGoal, number: int, status: int) -> Any:
    """nav2_msgs/WaypointStatus."""
    is_missed = status == MISSED
    return make.new(
        "nav2_msgs/msg/WaypointStatus", waypoint_status=status, waypoint_index=number,
        waypoint_pose=goal.poses[number], error_msg=goal.error if is_missed else "",
        error_code=navigation_error(goal.action.kind, goal.reason) if is_missed else 0,
    )  # fmt: skip


def _duration(make: RosMessages, ns: int) -> Any:
    ns = min(max(ns, 0), (2**31 - 1) * NS_PER_S)
    return make.new("builtin_interfaces/msg/Duration", sec=ns // NS_PER_S, nanosec=ns % NS_PER_S)
