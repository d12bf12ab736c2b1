# SPDX-License-Identifier: Apache-2.0
"""The stack's reasons as Nav2's error codes.

Source: nav2_msgs of Jazzy and Kilted, ComputePathToPose, ComputePathThroughPoses, FollowPath, NavigateToPose,
NavigateThroughPoses, FollowWaypoints, Spin, BackUp, DriveOnHeading. As Nav2's bt_navigator does, the codes of planner
and controller pass through.
"""

from services.ros2.ros_types import Distro
from shared import reasons

START_OUTSIDE, GOAL_OUTSIDE, START_OCCUPIED, GOAL_OCCUPIED, TIMEOUT, NO_PATH = 3, 4, 5, 6, 7, 8
PLANNER_TF_ERROR = 2
PLANNER_BASES = {"NavigateToPose": 200, "NavigateThroughPoses": 300, "FollowWaypoints": 200}
"""Of the codes of ComputePathToPose and ComputePathThroughPoses, to which those above are added."""
PLANNER_ERRORS = {
    reasons.GOAL_OUTSIDE.code: GOAL_OUTSIDE,
    reasons.GOAL_BLOCKED.code: GOAL_OCCUPIED,
    reasons.GOAL_KEEP_OUT.code: GOAL_OCCUPIED,
    reasons.GOAL_UNKNOWN.code: NO_PATH,
    reasons.START_OUTSIDE.code: START_OUTSIDE,
    reasons.START_BLOCKED.code: START_OCCUPIED,
    reasons.UNREACHABLE.code: NO_PATH,
    reasons.NO_ROOM_TO_TURN.code: NO_PATH,
    reasons.NO_WAY_THROUGH.code: NO_PATH,
    reasons.NO_MAP.code: TIMEOUT,
    reasons.NO_PLAN.code: TIMEOUT,
    reasons.PLAN_OLD.code: TIMEOUT,
    reasons.POSE_LOST.code: PLANNER_TF_ERROR,
    reasons.POSE_OLD.code: PLANNER_TF_ERROR,
}
CONTROLLER_TF_ERROR, NO_PROGRESS, NO_CONTROL, CONTROLLER_TIMED_OUT = 102, 105, 106, 107
CONTROLLER_ERRORS = {
    reasons.ODOM_OLD.code: CONTROLLER_TF_ERROR,
    reasons.NO_PROGRESS.code: NO_PROGRESS,
    reasons.RECOVERIES_USED.code: NO_PROGRESS,
    **dict.fromkeys(
        (row.code for row in (reasons.BLOCKED, reasons.OBSTACLE, reasons.BUMPER, reasons.CLIFF)), NO_CONTROL
    ),
    **dict.fromkeys(
        (row.code for row in (reasons.SCAN_OLD, reasons.SCAN_UNLIKE, reasons.SCAN_FROZEN, reasons.SCAN_BLIND)),
        CONTROLLER_TIMED_OUT,
    ),
}
"""Codes of FollowPath. Without scans its costmap is not current."""
UNKNOWN = {
    "NavigateToPose": 9000,
    "NavigateThroughPoses": 9100,
    "FollowWaypoints": 600,
    "Spin": 700,
    "BackUp": 710,
    "DriveOnHeading": 720,
}
STOPPED_ON_MISSED_WAYPOINT = 603  # Kilted's
MOTION_TIMEOUT, MOTION_TF_ERROR = 1, 2  # added to UNKNOWN of a single motion
COLLISION_AHEAD = {"Spin": 703, "BackUp": 714, "DriveOnHeading": 723}
IN_THE_WAY = frozenset((reasons.MOTION_BLOCKED.code, reasons.OBSTACLE.code, reasons.BUMPER.code, reasons.CLIFF.code))


def navigation_error(kind: str, reason: str) -> int:
    """The code of a drive that failed. kind: of the action.  reason: code of shared/reasons.py."""
    if reason in PLANNER_ERRORS:
        return PLANNER_BASES[kind] + PLANNER_ERRORS[reason]
    return CONTROLLER_ERRORS.get(reason, UNKNOWN[kind])


def action_error(kind: str, distro: Distro, reason: str) -> int:
    """The code of an action that failed."""
    if kind == "FollowWaypoints":
        return STOPPED_ON_MISSED_WAYPOINT if distro is Distro.KILTED else UNKNOWN[kind]
    if kind not in COLLISION_AHEAD:
        return navigation_error(kind, reason)
    if reason in IN_THE_WAY:
        return COLLISION_AHEAD[kind]
    added = {reasons.MOTION_TOO_LONG.code: MOTION_TIMEOUT, reasons.ODOM_OLD.code: MOTION_TF_ERROR}
    return UNKNOWN[kind] + added.get(reason, 0)
