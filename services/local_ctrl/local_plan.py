# SPDX-License-Identifier: Apache-2.0
"""The part of the plan ahead of the robot, in `odom`: resampled, tracked as the robot advances, cut at the window.

After Nav2's path handler: the nearest point is searched for within a bounded path length (its
`max_robot_pose_search_dist`), and the path is cut at the costmap. The cut at a turn is our own.
"""

from typing import NamedTuple

import numpy as np

from shared.geometry import Pose2
from shared.types import Float64s

SPACING = 0.05  # m between the resampled points
MAX_ADVANCE_M = 3.0  # along the path within which the robot is searched for, so that no loop of the path is skipped
SAME_PLACE_M = 0.2  # m
HEADING_STRIDE = 2  # points between the two that give a heading


class PathAhead(NamedTuple):
    """The path from the robot to the window's end, and the distance beyond."""

    points: Float64s  # (n, 2) m in `odom`, SPACING apart, at least one
    left: float  # m from the first point to the path's end
    ends: bool  # whether the path's end is the last point
    end: Pose2  # where the path ends, in `odom`


class LocalPlan:
    """A plan and the robot's place on it."""

    def __init__(self, xs: Float64s, ys: Float64s, yaw: float) -> None:
        """xs, ys: (n,) m in `map`, n > 0. yaw: rad, heading at the end."""
        self.points = resampled_polyline(np.column_stack((xs, ys)))
        self.end = Pose2(float(xs[-1]), float(ys[-1]), yaw)
        self.i_nearest: int | None = None

    def same_as(self, other: "LocalPlan") -> bool:
        """Whether both plans have the same points and end."""
        return self.end == other.end and np.array_equal(self.points, other.points)

    def ahead(self, odom_from_map: Pose2, here: Pose2, reach: float, leap: float = MAX_ADVANCE_M) -> PathAhead:
        """The path from the point nearest to `here`, in `odom`, until it leaves a square of +-`reach` m about it.

        leap: m along the path from the last nearest point within which the next is searched for.
        """
        at = odom_from_map.inverse() @ here
        if self.i_nearest is None:
            # the plan may begin behind the robot; of several sections near it the first counts
            away = np.hypot(self.points[:, 0] - at.x, self.points[:, 1] - at.y)
            self.i_nearest = int(np.argmax(away <= away.min() + SAME_PLACE_M))
        near = self.points[self.i_nearest : self.i_nearest + max(2, int(leap / SPACING))]
        self.i_nearest += int(np.argmin((near[:, 0] - at.x) ** 2 + (near[:, 1] - at.y) ** 2))
        rest = odom_from_map @ self.points[self.i_nearest :]
        outside = np.abs(rest - (here.x, here.y)).max(axis=1) > reach
        n = int(np.argmax(outside)) if outside.any() else len(rest)
        return PathAhead(rest[: max(1, n)], (len(rest) - 1) * SPACING, n == len(rest), odom_from_map @ self.end)


def cut_at_turn(ahead: PathAhead, most: float) -> PathAhead:
    """The path until it has turned by over `most` rad: a robot that drives arcs must follow them, not cross them."""
    legs = np.diff(ahead.points[::HEADING_STRIDE], axis=0)
    turned = np.unwrap(np.arctan2(legs[:, 1], legs[:, 0]))
    beyond = np.flatnonzero(np.abs(turned - turned[0]) > most) if len(turned) else turned
    if not len(beyond):
        return ahead
    return ahead._replace(points=ahead.points[: HEADING_STRIDE * int(beyond[0]) + 1], ends=False)


def resampled_polyline(points: Float64s, spacing: float = SPACING) -> Float64s:
    """The polyline (n, 2) as points (k, 2) about `spacing` m apart, from its first to its last."""
    lengths = np.hypot(*np.diff(points, axis=0).T)
    at = np.concatenate(([0.0], np.cumsum(lengths)))
    n = max(2, round(float(at[-1]) / spacing) + 1) if at[-1] > 0 else 1
    wanted = np.linspace(0.0, at[-1], n)
    return np.column_stack((np.interp(wanted, at, points[:, 0]), np.interp(wanted, at, points[:, 1])))
