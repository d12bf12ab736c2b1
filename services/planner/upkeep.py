# SPDX-License-Identifier: Apache-2.0
"""Whether a plan still holds, how far along it the robot is, and whether a new one is worth the change."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from services.planner.lines import path_cost
from services.planner.planning import Plan
from services.planner.traversal_cost import UNIT, Terrain
from shared.config import Section

Float64s = NDArray[np.float64]

AHEAD, _BEHIND = 3.0, 0.5  # m along the plan in which the robot is looked for: not on the other side of a wall


class UpkeepConfig(Section):
    """When a plan is given up for another."""

    off_plan: float = Field(0.5, ge=0.05, le=5, description="m off the plan at which the robot gets a new one")
    refine_gain: float = Field(
        0.05, ge=0, le=1, description="share of its cost that a new plan along the same way must save"
    )
    switch_gain: float = Field(0.2, ge=0, le=1, description="share of its cost that a plan by another way must save")
    switch_least: float = Field(0.5, ge=0, le=20, description="m (weighted) that it must save as well")
    same_way: float = Field(0.6, ge=0, le=5, description="m between two plans that count as the same way, at most")
    patience: float = Field(
        2.5, ge=0, le=60, description="s that a plan is kept where something stands on it that was not there: people"
    )
    far_ahead: float = Field(
        2.5, ge=0, le=50, description="m ahead; nearer, a plan that costs little more is taken without patience"
    )


@dataclass(frozen=True, slots=True)
class Standing:
    """Where the robot stands on a plan.

    index: of the nearest pose; off: m to it; cost: m, weighted, from there. blocked: index of the first blocked pose,
    -1 where all are free; ahead: m to that along the plan.
    """

    index: int
    off: float
    cost: float
    blocked: int = -1
    ahead: float = 0.0


def standing(terrain: Terrain, plan: Plan, index: int, x: float, y: float, within: float = AHEAD) -> Standing:
    """How the plan looks from (x, y) m on today's map; index: that of the last look; within: m along it from there."""
    points = plan.points
    along = _along(points)
    low = int(np.searchsorted(along, along[index] - _BEHIND))
    high = int(np.searchsorted(along, along[index] + within, side="right"))
    away = np.hypot(points[low:high, 0] - x, points[low:high, 1] - y)
    nearest = low + int(np.argmin(away))
    ahead = (points[nearest:] - terrain.origin) / terrain.resolution
    cost = path_cost(terrain.costs, ahead)
    if cost >= 0:
        return Standing(nearest, float(away.min()), cost * terrain.resolution / UNIT)
    cells = np.clip(ahead.astype(np.int64), 0, np.array(terrain.costs.shape[::-1]) - 1)
    hits = np.flatnonzero(terrain.costs[cells[:, 1], cells[:, 0]] == 0)
    first = nearest + (int(hits[0]) if len(hits) else 0)
    return Standing(nearest, float(away.min()), 0.0, first, float(along[first] - along[nearest]))


def worth_switching(old: Plan, old_cost: float, new: Plan, config: UpkeepConfig) -> bool:
    """Whether the new plan saves enough against what is left of the old one, where both are free."""
    if new.reason is not None:
        return False
    saved = old_cost - new.cost
    if same_way(old, new, config.same_way):
        return saved > config.refine_gain * old_cost
    return saved > config.switch_gain * old_cost and saved > config.switch_least


def worth_waiting(old: Plan, old_cost: float, ahead: float, new: Plan, config: UpkeepConfig) -> bool:
    """Whether it is better to wait that the old plan gets free again, ahead m from the robot, than to take the new."""
    if new.reason is not None:
        return True
    if same_way(old, new, config.same_way):
        return False
    return ahead > config.far_ahead or new.cost > (1 + config.switch_gain) * old_cost + config.switch_least


def remaining(plan: Plan, index: int) -> Plan:
    """The plan from a pose on."""
    return Plan(plan.points[index:], plan.yaws[index:], plan.cost)


def length(points: Float64s) -> float:
    """m along points (n, 2)."""
    return float(_along(points)[-1]) if len(points) else 0.0


def same_way(old: Plan, new: Plan, within: float) -> bool:
    """Whether the new plan is nowhere farther than `within` m from the old one."""
    some = new.points[:: max(len(new.points) // 50, 1)]
    away = np.hypot(some[:, None, 0] - old.points[:, 0], some[:, None, 1] - old.points[:, 1])
    return bool(away.min(axis=1).max() <= within)


def _along(points: Float64s) -> Float64s:
    legs = np.diff(points, axis=0)
    return np.concatenate(([0.0], np.cumsum(np.hypot(legs[:, 0], legs[:, 1]))))
