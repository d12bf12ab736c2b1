# SPDX-License-Identifier: Apache-2.0
"""When is a plan replaced: the robot's progress on the present plan, and the rules by which a new plan replaces it.

The rules are our own. To wait before a longer plan is taken is derived from PathLongerOnApproach of Nav2's behavior
trees, which waits near the goal only.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from pydantic import Field

from services.planner.costmap import UNIT_COST, GlobalCostmap
from services.planner.planning import GlobalPlan
from services.planner.ray_cost import path_cost
from shared.config import Drive, Section
from shared.geometry import Pose2
from shared.types import Bools, Float64s

SEARCH_AHEAD_M = 3.0  # along the plan from the last pose: not on the other side of a wall
_SEARCH_BEHIND_M = 0.5


class PlanMonitorConfig(Section):
    """When a new plan replaces the present one."""

    RENAMED: ClassVar[dict[str, str]] = {
        "switch_least": "min_switch_gain",
        "same_way": "same_route_distance",
        "patience": "max_wait_time",
        "far_ahead": "min_wait_distance",
    }

    off_plan: float = Field(0.5, ge=0.05, le=5, description="m from the plan at which the robot gets a new one")
    refine_gain: float = Field(
        0.05, ge=0, le=1, description="share of the remaining cost that a new plan along the same route must save"
    )
    switch_gain: float = Field(
        0.2, ge=0, le=1, description="share of the remaining cost that a plan along another route must save"
    )
    min_switch_gain: float = Field(
        0.5, ge=0, le=20, description="m (weighted) that a plan along another route must save as well"
    )
    same_route_distance: float = Field(0.6, ge=0, le=5, description="maximum m between two plans along the same route")
    max_wait_time: float = Field(
        2.5,
        ge=0,
        le=60,
        description=("s that a blocked plan is kept where space was known to be free: the obstacle may be a person"),
    )
    min_wait_distance: float = Field(
        2.5,
        ge=0,
        le=50,
        description=("m to the obstacle; when it is nearer, a new plan at little more cost is taken without waiting"),
    )


@dataclass(frozen=True, slots=True)
class PlanProgress:
    """The robot's place on a plan.

    `index`: of the nearest pose. `off`: m to it. `cost`: m, weighted, of the rest. `i_blocked`: index of the first
    blocked pose, -1 without one. `to_blocked`: m along the plan to it.
    """

    index: int
    off: float
    cost: float
    i_blocked: int = -1
    to_blocked: float = 0.0


class PlanMonitor:
    """The present plan, the robot's progress on it, and the rules by which a new plan replaces it."""

    def __init__(self, config: PlanMonitorConfig, search_ahead: float) -> None:
        """search_ahead: m along the plan from the last place within which the robot is searched for."""
        self.config, self.search_ahead = config, search_ahead
        self.plan: GlobalPlan | None = None
        self.index = 0  # of the plan's pose nearest to the robot
        self.cost_left = 0.0  # m, weighted, from there
        self._was_known_free: Bools | None = None  # (n,) poses in known free space when the plan was last free
        self._blocked_since: int | None = None  # ns

    def clear(self) -> None:
        """Drops the plan: the next one is taken in any case."""
        self.plan = None

    @property
    def drivable_plan(self) -> GlobalPlan | None:
        """The present plan where it has a path."""
        return self.plan if self.plan is not None and self.plan.reason is None else None

    def replace(self, plan: GlobalPlan, costmap: GlobalCostmap | None = None) -> None:
        """Makes `plan` the present one, with the robot at its beginning."""
        self.plan, self.index, self.cost_left = plan, 0, plan.cost
        self._blocked_since = None
        self._was_known_free = costmap.is_known_free(plan.points) if costmap else None

    def update(self, new: GlobalPlan, costmap: GlobalCostmap, pose: Pose2, now: int) -> None:
        """Updates the progress to a pose in `map`, and takes the new plan where the present one should be replaced.

        That is: without a plan, off it, where `new` saves enough, or where the present one is blocked and waiting is
        not worth while. now: ns.
        """
        old = self.drivable_plan
        if old is None:
            self.replace(new, costmap)
            return
        progress = plan_progress(costmap, old, self.index, pose.x, pose.y, self.search_ahead)
        self.index = progress.index
        rest = remaining_plan(old, progress.index)
        if progress.off > self.config.off_plan:
            self.replace(new, costmap)
        elif progress.i_blocked < 0:
            self._blocked_since, self.cost_left = None, progress.cost
            self._was_known_free = costmap.is_known_free(old.points)
            if is_worth_switching(rest, progress.cost, new, self.config):
                self.replace(new, costmap)
        elif not self._waits(progress, now) or not is_worth_waiting(
            rest, self.cost_left, progress.to_blocked, new, self.config
        ):
            self.replace(new, costmap)

    def _waits(self, progress: PlanProgress, now: int) -> bool:
        """Whether an obstacle on the plan may go away: it stands where space was known to be free, for a short time.

        A wall that was just mapped stays.
        """
        self._blocked_since = now if self._blocked_since is None else self._blocked_since
        was_free = self._was_known_free is not None and bool(self._was_known_free[progress.i_blocked])
        return was_free and 0 <= now - self._blocked_since <= self.config.max_wait_time * 1e9

    def is_off_plan(self, pose: Pose2) -> bool:
        """Whether a pose in `map` is farther than `off_plan` from every pose of the present plan."""
        if self.drivable_plan is None:
            return False
        distances = np.hypot(self.drivable_plan.points[:, 0] - pose.x, self.drivable_plan.points[:, 1] - pose.y)
        return bool(distances.min() > self.config.off_plan)


def plan_progress(
    costmap: GlobalCostmap, plan: GlobalPlan, index: int, x: float, y: float, within: float = SEARCH_AHEAD_M
) -> PlanProgress:
    """The robot at (x, y) m in `map` on a plan, with the plan's cost on the present costmap.

    index: of the last call. within: m along the plan from there within which the robot is searched for.
    """
    points = plan.points
    along = distance_along(points)
    low = int(np.searchsorted(along, along[index] - _SEARCH_BEHIND_M))
    high = int(np.searchsorted(along, along[index] + within, side="right"))
    away = np.hypot(points[low:high, 0] - x, points[low:high, 1] - y)
    nearest = low + int(np.argmin(away))
    ahead = (points[nearest:] - costmap.origin) / costmap.resolution
    cost = path_cost(costmap.costs, ahead)
    if cost >= 0:
        return PlanProgress(nearest, float(away.min()), cost * costmap.resolution / UNIT_COST)
    cells = np.clip(ahead.astype(np.int64), 0, np.array(costmap.costs.shape[::-1]) - 1)
    hits = np.flatnonzero(costmap.costs[cells[:, 1], cells[:, 0]] == 0)
    first = nearest + (int(hits[0]) if len(hits) else 0)
    return PlanProgress(nearest, float(away.min()), 0.0, first, float(along[first] - along[nearest]))


def is_worth_switching(old: GlobalPlan, old_cost: float, new: GlobalPlan, config: PlanMonitorConfig) -> bool:
    """Whether a new plan saves enough of `old_cost`, the cost of the rest of the old one. Both are free."""
    if new.reason is not None:
        return False
    saved = old_cost - new.cost
    if follows_same_route(old, new, config.same_route_distance):
        return saved > config.refine_gain * old_cost
    return saved > config.switch_gain * old_cost and saved > config.min_switch_gain


def is_worth_waiting(
    old: GlobalPlan, old_cost: float, ahead: float, new: GlobalPlan, config: PlanMonitorConfig
) -> bool:
    """Whether waiting until the old plan is free again is better than the new plan. ahead: m to the obstacle."""
    if new.reason is not None:
        return True
    if follows_same_route(old, new, config.same_route_distance):
        return False
    return ahead > config.min_wait_distance or new.cost > (1 + config.switch_gain) * old_cost + config.min_switch_gain


def remaining_plan(plan: GlobalPlan, index: int) -> GlobalPlan:
    """The plan from the pose `index` on."""
    return GlobalPlan(plan.points[index:], plan.yaws[index:], plan.cost)


def path_length(points: Float64s) -> float:
    """Length in m of the polyline through points (n, 2)."""
    return float(distance_along(points)[-1]) if len(points) else 0.0


def follows_same_route(old: GlobalPlan, new: GlobalPlan, within: float) -> bool:
    """Whether every point of the new plan lies within `within` m of the old one."""
    some = new.points[:: max(len(new.points) // 50, 1)]
    away = np.hypot(some[:, None, 0] - old.points[:, 0], some[:, None, 1] - old.points[:, 1])
    return bool(away.min(axis=1).max() <= within)


def distance_along(points: Float64s) -> Float64s:
    """(n,) m along the polyline to each of its points (n, 2) m, n > 0."""
    legs = np.diff(points, axis=0)
    return np.concatenate(([0.0], np.cumsum(np.hypot(legs[:, 0], legs[:, 1]))))


def search_ahead(drive: Drive, period: float) -> float:
    """m along the plan within which the robot is searched for: less than a loop of its tightest arc.

    period: s between two searches.
    """
    if not drive.min_turning_radius:
        return SEARCH_AHEAD_M
    travelled = 2 * period * drive.max_speed
    return min(SEARCH_AHEAD_M, max(2 * drive.min_turning_radius, travelled))
