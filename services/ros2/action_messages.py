# SPDX-License-Identifier: Apache-2.0
"""Goals, feedback and results of the actions, from ROS's messages to the stack's and back."""

from typing import Any

import numpy as np

from services.ros2.action_topics import Action
from services.ros2.incoming_topics import pose_in_map
from services.ros2.ros_types import Distro
from shared.geometry import Pose2
from shared.messages import NavStatus, PoseEstimate
from shared.requests import Navigate
from shared.ros_messages import RosMessages
from shared.types import NS_PER_S

UNKNOWN_ERROR = 9000
"""nav2_msgs/NavigateToPose: UNKNOWN. The stack's reason is in the text."""


def navigate_request(now: int, action: Action, goal: Any, frame: str) -> Navigate:
    """The request of a goal. now: ns.  frame: of the map.  Raises ValueError where it is no goal."""
    loops = 1
    if action.type.endswith("NavigateToPose"):
        stamped = [goal.pose]
    elif action.type.endswith("FollowWaypoints"):
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
    make: RosMessages, action: Action, status: NavStatus, estimate: PoseEstimate | None, begun: int, now: int
) -> Any:
    """The feedback of a goal that began at `begun` (ns)."""
    type_ = f"{action.type}_Feedback"
    if action.type.endswith("FollowWaypoints"):
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
    if action.type.endswith("NavigateThroughPoses"):
        fields["number_of_poses_remaining"] = min(max(status.n_waypoints - status.waypoint, 0), 2**15 - 1)
    return make.new(type_, **fields)


def result(make: RosMessages, action: Action, distro: Distro, error: str) -> Any:
    """The result of a goal. error: the reason of a failure in words; empty where it was reached."""
    type_ = f"{action.type}_Result"
    fields: dict[str, Any] = {}
    if action.type.endswith("FollowWaypoints"):
        fields["missed_waypoints"] = np.empty(0, np.int32) if distro is Distro.HUMBLE else []
    elif distro is Distro.HUMBLE:
        fields["result"] = make.new("std_msgs/msg/Empty")
    if distro is not Distro.HUMBLE:
        fields |= {"error_code": UNKNOWN_ERROR if error else 0, "error_msg": error}
    return make.new(type_, **fields)


def _duration(make: RosMessages, ns: int) -> Any:
    ns = min(max(ns, 0), (2**31 - 1) * NS_PER_S)
    return make.new("builtin_interfaces/msg/Duration", sec=ns // NS_PER_S, nanosec=ns % NS_PER_S)
