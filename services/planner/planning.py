# SPDX-License-Identifier: Apache-2.0
"""From a pose to a goal: free start and end cells, the search between them, smoothing, or the reason without a path.

A goal without room is moved within a tolerance, as by Nav2's NavFn planner. The path out of inflated space, and the
second try with a smaller margin, are our own.
"""

import heapq
from dataclasses import dataclass
from math import ceil, cos, hypot, sin
from typing import NamedTuple

import numpy as np
from pydantic import Field

from services.planner.costmap import UNIT_COST, GlobalCostmap
from services.planner.hierarchical_search import HierarchicalSearch
from services.planner.hybrid_astar import MAX_CHORD_CELLS, hybrid_astar_path
from services.planner.ray_cost import line_cost, path_cost
from services.planner.smoothing import resampled_path, smooth_path_in_map
from shared import reasons
from shared.config import Drive, Section
from shared.geometry import Pose2, wrapped, wrapped_all
from shared.reasons import Reason
from shared.types import Float64s

Cell = tuple[int, int]

NO_POINTS = np.empty((0, 2))
EDGE_MARGIN_CELLS = 1e-6  # of the path's ends to the edges of their cells
RADIUS_FACTOR = 1.2
"""Radius of a planned arc over the tightest one, where there is room: the rest lets the robot return to the path."""
STRAIGHT_APPROACH_RADII = 0.8
"""Length in radii of the straight line before a goal with a heading, where there is room."""
RETRY_REASONS = reasons.UNREACHABLE, reasons.NO_ROOM_TO_TURN, reasons.START_BLOCKED, reasons.GOAL_BLOCKED
"""Reasons after which planning is repeated with the smaller margin."""
SPIN_THRESHOLD_RAD = 1.0
"""Angle to the path (rad) at which a standing robot turns in place first, as local control's `turn_from`."""


class PlanningConfig(Section):
    """From a search to a path."""

    spacing: float = Field(0.05, ge=0.01, le=1, description="maximum m between the poses of a path")
    goal_reach: float = Field(
        0.25,
        ge=0,
        le=5,
        description="m that a goal without room for the robot may be moved, where its tolerance is less",
    )
    escape_radius: float = Field(
        0.6, ge=0, le=5, description="m that the robot may drive through inflated space to leave it"
    )


@dataclass(frozen=True, slots=True, eq=False)
class GlobalPlan:
    """A path in `map`: points (n, 2) m, yaws (n,) rad, cost m (weighted). Without one n is 0 and `reason` is set."""

    points: Float64s
    yaws: Float64s
    cost: float
    reason: Reason | None = None


def no_plan(reason: Reason) -> GlobalPlan:
    """The plan without a path, for this reason."""
    return GlobalPlan(np.empty((0, 2)), np.empty(0), 0.0, reason)


class TurningLimits(NamedTuple):
    """Limits of a robot with a turning radius.

    `radius`: m, of its tightest arc. `spins`: it may turn in place, before it starts and at the goal. `any_heading`:
    the goal's heading does not count.
    """

    radius: float
    spins: bool
    any_heading: bool


def turning_limits(drive: Drive, any_heading: bool) -> TurningLimits | None:
    """The limits of a drive; None where it has no turning radius."""
    if not drive.min_turning_radius:
        return None
    return TurningLimits(drive.min_turning_radius, drive.turns_in_place, any_heading)


def plan_path(
    costmap: GlobalCostmap,
    search: HierarchicalSearch,
    start: Pose2,
    goal: Pose2,
    tolerance: float,
    config: PlanningConfig,
    turning: TurningLimits | None = None,
) -> GlobalPlan:
    """The path from start to goal, poses in `map`, or to the nearest free place within `tolerance` and `goal_reach` m.

    turning: None for a robot without a turning radius. Otherwise the path consists of arcs; a robot that spins gets a
    path without arcs where none has them.

    Planning keeps `margin`. Where that gives no path, it is repeated with `min_margin`: a gap that became a cell
    narrower must not trap the robot.
    """
    ends = start, goal, tolerance
    plan = _with_margin(costmap, search, *ends, config, turning)
    if plan.reason not in RETRY_REASONS or (reduced := costmap.with_min_margin()) is costmap:
        return plan
    if plan.reason is reasons.GOAL_BLOCKED and not reduced.costs[reduced.cell(goal.x, goal.y)]:
        return plan  # in an obstacle, or too near to one for any margin
    return _with_margin(reduced, search, *ends, config, turning)


def _with_margin(
    costmap: GlobalCostmap,
    search: HierarchicalSearch,
    start: Pose2,
    goal: Pose2,
    tolerance: float,
    config: PlanningConfig,
    turning: TurningLimits | None,
) -> GlobalPlan:
    start_cell, goal_cell = costmap.cell(start.x, start.y), costmap.cell(goal.x, goal.y)
    if not costmap.contains(*start_cell):
        return no_plan(reasons.START_OUTSIDE)
    if not costmap.contains(*goal_cell):
        return no_plan(reasons.GOAL_OUTSIDE)
    escapes = _escape_paths(costmap, start, start_cell, config.escape_radius)
    if not escapes:
        return no_plan(reasons.START_BLOCKED)
    end_cell = _nearest_reachable_goal(costmap, goal, goal_cell, set(escapes), max(tolerance, config.goal_reach))
    if end_cell is None:
        if costmap.costs[goal_cell]:
            return no_plan(reasons.UNREACHABLE)
        return no_plan(reasons.GOAL_BLOCKED if costmap.is_too_close(*goal_cell) else reasons.GOAL_UNKNOWN)
    escape = escapes[costmap.components.at(*end_cell)]
    end = (
        _cell_coordinates(costmap, goal, goal_cell) if end_cell == goal_cell else (end_cell[1] + 0.5, end_cell[0] + 0.5)
    )
    spacing = config.spacing / costmap.resolution
    if turning is not None and not turning.spins:
        x, y = _cell_coordinates(costmap, start, start_cell)
        escape_radius_m = config.escape_radius if len(escape) > 1 else 0.0
        return _plan_arcs(costmap, (x, y, start.yaw), (end[0], end[1], goal.yaw), turning, spacing, escape_radius_m)
    points = search.rough_path(
        costmap.costs, costmap.graph, costmap.components, escape[-1], end_cell, UNIT_COST, costmap.max_cost
    )
    here = _cell_coordinates(costmap, start, start_cell)
    way_out = NO_POINTS if len(escape) == 1 else np.array([(column + 0.5, row + 0.5) for row, column in escape])
    frame = costmap.origin, costmap.resolution
    path, yaws, cost = smooth_path_in_map(costmap.costs, here, way_out, points, end, spacing, wrapped(goal.yaw), *frame)
    if turning is not None and len(escape) == 1:
        heading_error = abs(wrapped(yaws[0] - start.yaw)) > SPIN_THRESHOLD_RAD
        begin = here[0], here[1], float(yaws[0]) if heading_error else start.yaw
        arcs = _plan_arcs(costmap, begin, (end[0], end[1], 0.0), turning._replace(any_heading=True), spacing, 0.0)
        if arcs.reason is None:
            arcs.yaws[-1] = wrapped(goal.yaw)
            return arcs
    return GlobalPlan(path, yaws, cost * costmap.resolution / UNIT_COST)


def _plan_arcs(
    costmap: GlobalCostmap,
    start: tuple[float, float, float],
    goal: tuple[float, float, float],
    turning: TurningLimits,
    spacing: float,
    escape_radius_m: float,
) -> GlobalPlan:
    """The path of arcs and lines between poses (x, y in cells, yaw), or the reason without one.

    escape_radius_m: distance within which a robot in inflated space may cross it, no nearer to obstacles than it
    stands.
    """
    costs, radius = costmap.costs, turning.radius / costmap.resolution
    if escape_radius_m:
        costs = costmap.with_escape_area(int(start[1]), int(start[0]), ceil(escape_radius_m / costmap.resolution))
    poses, cost, spacing = np.empty((0, 3)), -1.0, min(spacing, MAX_CHORD_CELLS)
    for wider, straight in ((RADIUS_FACTOR, STRAIGHT_APPROACH_RADII * radius), (1.0, 0.0)):
        run = 0.0 if turning.any_heading else straight
        x, y, yaw = goal
        before = x - run * cos(yaw), y - run * sin(yaw), yaw
        if line_cost(costs, before[0], before[1], x, y, np.inf) < 0:
            continue
        poses = hybrid_astar_path(
            costs, np.array(start), np.array(before), wider * radius, turning.any_heading, UNIT_COST, spacing
        )  # fmt: skip
        if len(poses):
            rest = resampled_path(np.array([before[:2], (x, y)]), spacing)[1:] if run else np.empty((0, 2))
            poses = np.concatenate((poses, np.column_stack((rest, np.full(len(rest), yaw)))))
            cost = path_cost(costs, np.ascontiguousarray(poses[:, :2]))
        if cost >= 0:
            break
    if cost < 0:
        return no_plan(reasons.NO_ROOM_TO_TURN)
    points = costmap.origin + poses[:, :2] * costmap.resolution
    return GlobalPlan(points, wrapped_all(poses[:, 2]), cost * costmap.resolution / UNIT_COST)


def _escape_paths(costmap: GlobalCostmap, start: Pose2, start_cell: Cell, radius: float) -> dict[int, list[Cell]]:
    """Component that the robot can enter: cells from its own to the nearest one of the component, both included.

    In free space that is its own cell. In inflated space the robot may cross it, but no obstacle. Occupied cells under
    the robot do not count.
    """
    if costmap.costs[start_cell]:
        return {costmap.components.at(*start_cell): [start_cell]}
    paths: dict[int, list[Cell]] = {}
    parents: dict[Cell, Cell] = {start_cell: start_cell}
    settled: set[Cell] = set()
    queue: list[tuple[float, Cell]] = [(0.0, start_cell)]
    while queue:
        travelled, cell = heapq.heappop(queue)
        if cell in settled:
            continue
        settled.add(cell)
        region = costmap.components.at(*cell)
        if region:
            paths.setdefault(region, _trace_back(parents, cell))
            continue
        for dr, dc in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            there = cell[0] + dr, cell[1] + dc
            x, y = costmap.centre(*there)
            away = hypot(x - start.x, y - start.y)
            if there in settled or not costmap.contains(*there) or away > radius:
                continue
            if costmap.is_occupied(*there) and away > costmap.min_clearance:
                continue
            heapq.heappush(queue, (travelled + 1 + away, there))  # prefers straight lines
            parents.setdefault(there, cell)
    return paths


def _trace_back(parents: dict[Cell, Cell], cell: Cell) -> list[Cell]:
    cells = [cell]
    while parents[cells[-1]] != cells[-1]:
        cells.append(parents[cells[-1]])
    return cells[::-1]


def _nearest_reachable_goal(
    costmap: GlobalCostmap, goal: Pose2, goal_cell: Cell, regions: set[int], radius: float
) -> Cell | None:
    """The goal's cell if it lies in one of the components, else the nearest such cell within `radius` m; None without
    one.
    """
    if costmap.components.at(*goal_cell) in regions:
        return goal_cell
    n = ceil(radius / costmap.resolution) + 1
    (row, column), (h, w) = goal_cell, costmap.costs.shape
    r0, c0 = max(row - n, 0), max(column - n, 0)
    window = np.isin(costmap.components.labels_in(r0, c0, min(row + n + 1, h), min(column + n + 1, w)), sorted(regions))
    rows, columns = np.nonzero(window)
    if not len(rows):
        return None
    rows, columns = rows + r0, columns + c0
    x, y = _cell_coordinates(costmap, goal, goal_cell)
    away = np.hypot(columns + 0.5 - x, rows + 0.5 - y) * costmap.resolution
    nearest = int(np.argmin(away))
    return (int(rows[nearest]), int(columns[nearest])) if away[nearest] <= radius else None


def _cell_coordinates(costmap: GlobalCostmap, pose: Pose2, cell: Cell) -> tuple[float, float]:
    """The pose's (x, y) in cells, kept inside its cell against rounding."""
    x0, y0 = costmap.origin
    row, column = cell
    return (
        min(max((pose.x - x0) / costmap.resolution, column + EDGE_MARGIN_CELLS), column + 1 - EDGE_MARGIN_CELLS),
        min(max((pose.y - y0) / costmap.resolution, row + EDGE_MARGIN_CELLS), row + 1 - EDGE_MARGIN_CELLS),
    )
