# SPDX-License-Identifier: Apache-2.0
"""From a pose to a goal: where to start, where to end, the way between, or the reason why there is none."""

import heapq
from dataclasses import dataclass
from math import ceil, hypot, nextafter

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from services.planner.outline import Outline
from services.planner.smoothing import followed
from services.planner.traversal_cost import UNIT, Terrain
from shared import reasons
from shared.config import Section
from shared.geometry import Pose2, wrapped
from shared.reasons import Reason

Float64s = NDArray[np.float64]
Cell = tuple[int, int]


class PlanningConfig(Section):
    """How a way is made into a path."""

    spacing: float = Field(0.05, ge=0.01, le=1, description="m between the poses of a path, at most")
    goal_reach: float = Field(
        0.25, ge=0, le=5, description="m that a goal without room for the robot may be moved, if its tolerance is less"
    )
    escape_radius: float = Field(
        0.6, ge=0, le=5, description="m that the robot may drive through inflated space to leave it"
    )


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """points: (n, 2) m in `map`; yaws: (n,) rad; cost: m, weighted. `reason` is set, and n = 0, where there is none."""

    points: Float64s
    yaws: Float64s
    cost: float
    reason: Reason | None = None


def no_plan(reason: Reason) -> Plan:
    """Nowhere to go, and why."""
    return Plan(np.empty((0, 2)), np.empty(0), 0.0, reason)


def planned(
    terrain: Terrain, outline: Outline, start: Pose2, goal: Pose2, tolerance: float, config: PlanningConfig
) -> Plan:
    """The path from start to goal, or to the nearest place with room within the larger of tolerance and goal_reach.

    It keeps the margin; where no way at all does, the least margin: the robot must get out of a gap that has become a
    cell narrower since it drove in.
    """
    plan = _with_margin(terrain, outline, start, goal, tolerance, config)
    if plan.reason is not reasons.UNREACHABLE or terrain.eased() is terrain:
        return plan
    return _with_margin(terrain.eased(), outline, start, goal, tolerance, config)


def _with_margin(
    terrain: Terrain, outline: Outline, start: Pose2, goal: Pose2, tolerance: float, config: PlanningConfig
) -> Plan:
    start_cell, goal_cell = terrain.cell(start.x, start.y), terrain.cell(goal.x, goal.y)
    if not terrain.holds(*start_cell):
        return no_plan(reasons.NO_MAP)
    if not terrain.holds(*goal_cell):
        return no_plan(reasons.GOAL_OUTSIDE)
    escapes = _escapes(terrain, start, start_cell, config.escape_radius)
    if not escapes:
        return no_plan(reasons.START_BLOCKED)
    end_cell = _with_room(terrain, goal, goal_cell, set(escapes), max(tolerance, config.goal_reach))
    if end_cell is None:
        if terrain.costs[goal_cell]:
            return no_plan(reasons.UNREACHABLE)
        return no_plan(reasons.GOAL_BLOCKED if terrain.crowded(*goal_cell) else reasons.GOAL_UNKNOWN)
    escape = escapes[terrain.regions.at(*end_cell)]
    points = outline.points(terrain.costs, terrain.blocks, terrain.regions, escape[-1], end_cell, UNIT, terrain.highest)
    here = _in_cells(terrain, start, start_cell)
    lead = np.array([here, *((column + 0.5, row + 0.5) for row, column in escape)])
    end = _in_cells(terrain, goal, goal_cell) if end_cell == goal_cell else (end_cell[1] + 0.5, end_cell[0] + 0.5)
    path, yaws, cost = followed(
        terrain.costs, lead, points, end, config.spacing / terrain.resolution, wrapped(goal.yaw)
    )
    return Plan(terrain.origin + path * terrain.resolution, yaws, cost * terrain.resolution / UNIT)


def _escapes(terrain: Terrain, start: Pose2, start_cell: Cell, radius: float) -> dict[int, list[Cell]]:
    """For each region that the robot can enter: the cells from its own to the region's nearest, both included.

    That is its own cell where the robot stands in free space. Where it stands in inflated space, it may cross that, but
    no obstacle; cells under the robot itself are no obstacles, whatever the map says.
    """
    if terrain.costs[start_cell]:
        return {terrain.regions.at(*start_cell): [start_cell]}
    found: dict[int, list[Cell]] = {}
    parents: dict[Cell, Cell] = {start_cell: start_cell}
    settled: set[Cell] = set()
    queue: list[tuple[float, Cell]] = [(0.0, start_cell)]
    while queue:
        travelled, cell = heapq.heappop(queue)
        if cell in settled:
            continue
        settled.add(cell)
        region = terrain.regions.at(*cell)
        if region:
            found.setdefault(region, _back(parents, cell))
            continue
        for dr, dc in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            there = cell[0] + dr, cell[1] + dc
            x, y = terrain.centre(*there)
            away = hypot(x - start.x, y - start.y)
            if there in settled or not terrain.holds(*there) or away > radius:
                continue
            if terrain.occupied(*there) and away > terrain.blocked_under:
                continue
            heapq.heappush(queue, (travelled + 1 + away, there))  # straight away rather than around
            parents.setdefault(there, cell)
    return found


def _back(parents: dict[Cell, Cell], cell: Cell) -> list[Cell]:
    cells = [cell]
    while parents[cells[-1]] != cells[-1]:
        cells.append(parents[cells[-1]])
    return cells[::-1]


def _with_room(terrain: Terrain, goal: Pose2, goal_cell: Cell, regions: set[int], radius: float) -> Cell | None:
    """The goal's cell if it lies in one of the regions, else the nearest that does with its centre within radius."""
    if terrain.regions.at(*goal_cell) in regions:
        return goal_cell
    n = ceil(radius / terrain.resolution) + 1
    (row, column), (h, w) = goal_cell, terrain.costs.shape
    r0, c0 = max(row - n, 0), max(column - n, 0)
    window = np.isin(terrain.regions.within(r0, c0, min(row + n + 1, h), min(column + n + 1, w)), sorted(regions))
    rows, columns = np.nonzero(window)
    if not len(rows):
        return None
    rows, columns = rows + r0, columns + c0
    x, y = _in_cells(terrain, goal, goal_cell)
    away = np.hypot(columns + 0.5 - x, rows + 0.5 - y) * terrain.resolution
    nearest = int(np.argmin(away))
    return (int(rows[nearest]), int(columns[nearest])) if away[nearest] <= radius else None


def _in_cells(terrain: Terrain, pose: Pose2, cell: Cell) -> tuple[float, float]:
    """The pose's (x, y) in cells, inside its own cell also where rounding puts it a hair beside the edge."""
    x0, y0 = terrain.origin
    row, column = cell
    return (
        min(max((pose.x - x0) / terrain.resolution, column), nextafter(column + 1, column)),
        min(max((pose.y - y0) / terrain.resolution, row), nextafter(row + 1, row)),
    )
