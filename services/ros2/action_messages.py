# SPDX-License-Identifier: Apache-2.0
"""Goals, feedback and results of the actions, from ROS's messages to the stack's and back."""

from typing import Any

import numpy as np

from services.ros2.action_topics import Action
from services.ros2.incoming_topics import pose_in_map
from services.ros2.ros_types import Distro
from shared import reasons, requests
from shared.geometry import Pose2
from shared.messages import Message, NavStatus, PoseEstimate
from shared.requests import DriveStraight, Navigate, Request, Spin
from shared.ros_messages import RosMessages
from shared.types import NS_PER_S

UNKNOWN_ERROR = 9000
"""nav2_msgs/NavigateToPose: UNKNOWN. The stack's reason is in the text."""
MOTION_ERRORS = {"Spin": (700, 701, 703), "BackUp": (710, 711, 714), "DriveOnHeading": (720, 721, 723)}
"""UNKNOWN, TIMEOUT and COLLISION_AHEAD of the actions of single motions, in nav2_msgs."""
IN_THE_WAY = (reasons.MOTION_BLOCKED.code, reasons.OBSTACLE.code)
MAX_TIME_S = 300.0  # of Spin and DriveStraight


def stack_request(now: int, action: Action, goal: Any, frame: str) -> tuple[Request[Any, Any], Message]:
    """The request of a goal. now: ns.  frame: of the map.  Raises ValueError where it is no goal."""
    if action.kind not in MOTION_ERRORS:
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
    if action.kind not in MOTION_ERRORS:
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


def navigate_request(now: int, action: Action, goal: Any, frame: str) -> Navigate:
    """The request of a goal. now: ns.  frame: of the map.  Raises ValueError where it is no goal."""
    if getattr(goal, "behavior_tree", ""):
        raise ValueError(f"behavior_tree {goal.behavior_tree!r}: there are no behavior trees here, leave it empty")
    loops = 1
    if action.kind == "NavigateToPose":
        stamped = [goal.pose]
    elif action.kind == "FollowWaypoints":
        stamped = list(goal.poses)[getattr(goal, "goal_index", 0) :]
        loops = int(getattr(goal, "number_of_loops", 0)) + 1
    else:
        stamped = list(goal.poses)
    poses = tuple(pose_in_map(pose.header, pose.pose, frame) for pose in stamped)
    request = Navigate(now, poses, 0.0, loops, False)
    if (problem := request.problem()) is not None:
        raise ValueError(problem)
    return request


def feedback(
    make: RosMessages,
    action: Action,
    amount: float,
    status: NavStatus,
    estimate: PoseEstimate | None,
    begun: int,
    now: int,
) -> Any:
    """The feedback of a goal that began at `begun` (ns). amount: of a single motion, rad or m."""
    type_ = f"{action.type}_Feedback"
    if action.kind in MOTION_ERRORS:
        field = "angular_distance_traveled" if action.kind == "Spin" else "distance_traveled"
        return make.new(type_, **{field: max(amount - status.distance_left, 0.0)})
    if action.kind == "FollowWaypoints":
        return make.new(type_, current_waypoint=status.waypoint)
    pose = estimate.map_from_base if estimate is not None else Pose2()
    stamp = estimate.stamp if estimate is not None else now
    fields = {
        "current_pose": make.posed(stamp, pose, make.frames.map),
        "navigation_time": _duration(make, now - begun),
        "estimated_time_remaining": _duration(make, round(status.time_left * NS_PER_S)),
        "number_of_recoveries": min(status.n_recoveries, 2**15 - 1),
        "distance_remaining": status.distance_left,
    }
    if action.kind == "NavigateThroughPoses":
        fields["number_of_poses_remaining"] = min(max(status.n_waypoints - status.waypoint, 0), 2**15 - 1)
    return make.new(type_, **fields)


def result(make: RosMessages, action: Action, distro: Distro, error: str, reason: str, took: int) -> Any:
    """The result of a goal. error: the reason of a failure in words; empty where it was reached.

    reason: its code.  took: ns.
    """
    type_ = f"{action.type}_Result"
    fields: dict[str, Any] = {}
    if action.kind in MOTION_ERRORS:
        fields["total_elapsed_time"] = _duration(make, took)
    elif action.kind == "FollowWaypoints":
        fields["missed_waypoints"] = np.empty(0, np.int32) if distro is Distro.HUMBLE else []
    elif distro is Distro.HUMBLE:
        fields["result"] = make.new("std_msgs/msg/Empty")
    if distro is not Distro.HUMBLE:
        fields |= {"error_code": _error_code(action, reason) if error else 0, "error_msg": error}
    return make.new(type_, **fields)


def _error_code(action: Action, reason: str) -> int:
    if action.kind not in MOTION_ERRORS:
        return UNKNOWN_ERROR
    unknown, timeout, collision = MOTION_ERRORS[action.kind]
    if reason == reasons.MOTION_TOO_LONG.code:
        return timeout
    return collision if reason in IN_THE_WAY else unknown


def _duration(make: RosMessages, ns: int) -> Any:
    ns = min(max(ns, 0), (2**31 - 1) * NS_PER_S)
    return make.new("builtin_interfaces/msg/Duration", sec=ns // NS_PER_S, nanosec=ns % NS_PER_S)
