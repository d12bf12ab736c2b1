# SPDX-License-Identifier: Apache-2.0
"""The other robots in local control: how far this one may drive before them, and where they will be.

Without a message of traffic nothing changes. After the first one with other robots in it, the robot does not drive on
when traffic falls silent. The rules are our own.
"""

from math import hypot, inf, sqrt

import numpy as np

from services.local_ctrl.controller import APPROACH_BRAKING_SHARE, NO_ROBOTS
from services.local_ctrl.local_plan import SPACING
from services.local_ctrl.rollout import DT, Limits
from shared import reasons
from shared.geometry import Pose2
from shared.messages import OtherRobots, RightOfWay
from shared.reasons import Reason
from shared.types import NS_PER_S, Float64s

MAX_AGE_NS = NS_PER_S
"""ns after which the right of way is too old to drive on."""
CLEARED_M = 0.25  # from a cleared point within which the path is cleared
STOP_SHORT_M = 0.1  # of the end of the cleared way at which the robot waits
STEPS = 80  # of DT that the places of robots reach ahead
MOVES_M = 0.1  # over that time; robots that stand are obstacles as the laser sees them
SAME_ROBOT_M = 0.2  # beyond its outline within which a tracked obstacle is that robot


class LocalTraffic:
    """The newest messages of traffic."""

    def __init__(self) -> None:
        self.right_of_way: RightOfWay | None = None
        self.others: OtherRobots | None = None

    def _active(self) -> RightOfWay | None:
        """The right of way, if there are other robots."""
        return self.right_of_way if self.right_of_way is not None and self.right_of_way.active else None

    def fault(self, now: int) -> Reason | None:
        """Why the robot must stand, or None. now: ns."""
        told = self._active()
        return reasons.TRAFFIC_OLD if told is not None and abs(now - told.stamp) > MAX_AGE_NS else None

    @property
    def gives_way(self) -> bool:
        """Whether the present plan leads to a refuge in place of the goal."""
        told = self._active()
        return told is not None and told.gives_way

    def cleared(self, path: Float64s, odom_from_map: Pose2) -> float:
        """m of a path (k, 2) in `odom`, at SPACING m, that the robot may drive; inf for the whole plan."""
        told = self._active()
        if told is None or told.whole:
            return inf
        if not len(told.xs):
            return 0.0
        points = odom_from_map @ _with_way_to_path(np.column_stack((told.xs, told.ys)).astype(float))
        apart = np.hypot(path[:, None, 0] - points[:, 0], path[:, None, 1] - points[:, 1]).min(axis=1)
        beyond = np.flatnonzero(apart > CLEARED_M)
        return max(SPACING * float(beyond[0]) - CLEARED_M, 0.0) if len(beyond) else inf

    def limits(self, limits: Limits, left: float) -> Limits:
        """The limits with a speed from which the robot stops gently at the end of the cleared way, `left` m ahead."""
        told = self._active()
        most = limits.v_max * (1.0 if told is None else told.speed_share)
        if left < inf:
            most = min(most, sqrt(2.0 * APPROACH_BRAKING_SHARE * limits.braking * max(left - 0.5 * STOP_SHORT_M, 0.0)))
        return limits if most >= limits.v_max else limits._replace(v_max=most, v_min=max(limits.v_min, -most))

    def reason(self) -> str:
        """Why the robot drives slowly or elsewhere, as a code of reasons.py; empty where it does not."""
        told = self._active()
        if told is None or (told.speed_share == 1.0 and not told.gives_way):
            return ""
        return reasons.GIVING_WAY.code if told.gives_way else reasons.ROBOT_SILENT.code

    def places(self, now: int, odom_from_map: Pose2) -> Float64s:
        """(STEPS, k, 3) x, y m in `odom`, radius m of the moving robots, after 1, 2, ... steps of DT from `now`, ns."""
        others = self.others
        if others is None or not len(others.names) or abs(now - others.stamp) > MAX_AGE_NS or self._active() is None:
            return NO_ROBOTS
        at = ((now - others.stamp) / NS_PER_S + DT * np.arange(1, STEPS + 1)) / others.period
        low = np.clip(at.astype(np.int64), 0, others.xs.shape[1] - 2)
        share = np.clip(at - low, 0.0, 1.0)[:, None]
        x = (1.0 - share) * others.xs.T[low] + share * others.xs.T[low + 1]
        y = (1.0 - share) * others.ys.T[low] + share * others.ys.T[low + 1]
        places = np.empty((STEPS, len(others.names), 3))
        places[:, :, :2] = (odom_from_map @ np.stack((x, y), axis=2).reshape(-1, 2)).reshape(STEPS, -1, 2)
        places[:, :, 2] = others.radii
        moves = np.hypot(*(places[-1, :, :2] - places[0, :, :2]).T) > MOVES_M
        return np.ascontiguousarray(places[:, moves])


def _with_way_to_path(points: Float64s) -> Float64s:
    """The cleared points (n, 2), and those between the robot, the first one, and its path.

    A robot that brakes for a new path stops up to half a metre beside its begin.
    """
    n = int(hypot(*(points[1] - points[0])) / CLEARED_M) if len(points) > 1 else 0
    shares = np.arange(1, n + 1)[:, None] / (n + 1)
    return np.concatenate((points[:1], points[:1] + shares * (points[1:2] - points[:1]), points[1:]))


def without_robots(discs: Float64s, robots: Float64s) -> Float64s:
    """The tracked obstacles (k, 6), see DynamicObstacles.discs, that are none of the robots (steps, n, 3)."""
    if not len(discs) or not robots.shape[1]:
        return discs
    kept = [
        all(hypot(x - disc[0], y - disc[1]) > radius + SAME_ROBOT_M for x, y, radius in robots[0].tolist())
        for disc in discs.tolist()
    ]
    return discs[kept]
