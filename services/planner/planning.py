# SPDX-License-Identifier: Apache-2.0
"""From a pose to a goal: where to start, where to end, the way between, or the reason why there is none."""

import heapq
from dataclasses import dataclass
from math import ceil, cos, hypot, sin
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from services.planner.curved import CHORD, curved
from services.planner.lines import line_cost, path_cost
from services.planner.outline import Outline
from services.planner.smoothing import followed, resampled
from services.planner.traversal_cost import UNIT, Terrain
from shared import reasons
from shared.config import Section
from shared.geometry import Pose2, wrapped, wrapped_all
from shared.reasons import Reason

Float64s = NDArray[np.float64]
Cell = tuple[int, int]

NOWHERE = np.empty((0, 2))
EDGE = 1e-6  # cells that a path's ends keep off the edge of theirs
STEERING = 1.2
"""How much wider than the tightest a planned arc is where there is room: what is left is for getting back onto it."""
RUN_IN = 0.8
"""Radii straight ahead before a goal with a heading, where there is room."""
TOO_NARROW = reasons.UNREACHABLE, reasons.NO_ROOM_TO_TURN, reasons.START_BLOCKED, reasons.GOAL_BLOCKED
"""What a smaller margin may mend."""
SPINS_FROM = 1.0
"""rad off its way from which a standing robot turns on the spot before it starts, as local control's `turn_from`."""


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


class Turning(NamedTuple):
    """How a robot turns that does not turn just anywhere. radius: m, of its tightest arc; spins: it may turn on the
    spot, before it starts and at the goal; any_heading: it may end with any.
    """

    radius: float
    spins: bool
    any_heading: bool


def planned(
    terrain: Terrain,
    outline: Outline,
    start: Pose2,
    goal: Pose2,
    tolerance: float,
    config: PlanningConfig,
    turning: Turning | None = None,
) -> Plan:
    """The path from start to goal, or to the nearest place with room within the larger of tolerance and goal_reach.

    turning: None turns anywhere. Else the path keeps the arcs; who spins and finds none that does, has one without.

    It keeps the margin; where no way at all does, or there is no room for start or goal, the least margin: the robot
    must get out of a gap that has become a cell narrower since it drove in.
    """
    ends = start, goal, tolerance
    plan = _with_margin(terrain, outline, *ends, config, turning)
    if plan.reason not in TOO_NARROW or (eased := terrain.eased()) is terrain:
        return plan
    if plan.reason is reasons.GOAL_BLOCKED and not eased.costs[eased.cell(goal.x, goal.y)]:
        return plan  # in a wall, or so close to it that no margin helps
    return _with_margin(eased, outline, *ends, config, turning)


def _with_margin(
    terrain: Terrain,
    outline: Outline,
    start: Pose2,
    goal: Pose2,
    tolerance: float,
    config: PlanningConfig,
    turning: Turning | None,
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
    end = _in_cells(terrain, goal, goal_cell) if end_cell == goal_cell else (end_cell[1] + 0.5, end_cell[0] + 0.5)
    spacing = config.spacing / terrain.resolution
    if turning is not None and not turning.spins:
        x, y = _in_cells(terrain, start, start_cell)
        leaves = config.escape_radius if len(escape) > 1 else 0.0
        return _in_arcs(terrain, (x, y, start.yaw), (end[0], end[1], goal.yaw), turning, spacing, leaves)
    points = outline.points(terrain.costs, terrain.blocks, terrain.regions, escape[-1], end_cell, UNIT, terrain.highest)
    here = _in_cells(terrain, start, start_cell)
    way_out = NOWHERE if len(escape) == 1 else np.array([(column + 0.5, row + 0.5) for row, column in escape])
    frame = terrain.origin, terrain.resolution
    path, yaws, cost = followed(terrain.costs, here, way_out, points, end, spacing, wrapped(goal.yaw), *frame)
    if turning is not None and len(escape) == 1:
        off = abs(wrapped(yaws[0] - start.yaw)) > SPINS_FROM
        begin = here[0], here[1], float(yaws[0]) if off else start.yaw
        arcs = _in_arcs(terrain, begin, (end[0], end[1], 0.0), turning._replace(any_heading=True), spacing, 0.0)
        if arcs.reason is None:
            arcs.yaws[-1] = wrapped(goal.yaw)
            return arcs
    return Plan(path, yaws, cost * terrain.resolution / UNIT)


def _in_arcs(
    terrain: Terrain,
    start: tuple[float, float, float],
    goal: tuple[float, float, float],
    turning: Turning,
    spacing: float,
    leaves: float,
) -> Plan:
    """The path of arcs and lines between poses (x, y in cells, yaw), or the reason why there is none.

    leaves: m within which a robot in inflated space may cross that, where it comes no nearer to anything.
    """
    costs, radius = terrain.costs, turning.radius / terrain.resolution
    if leaves:
        costs = terrain.opened(int(start[1]), int(start[0]), ceil(leaves / terrain.resolution))
    poses, cost, spacing = np.empty((0, 3)), -1.0, min(spacing, CHORD)
    for wider, straight in ((STEERING, RUN_IN * radius), (1.0, 0.0)):
        run = 0.0 if turning.any_heading else straight
        x, y, yaw = goal
        before = x - run * cos(yaw), y - run * sin(yaw), yaw
        if line_cost(costs, before[0], before[1], x, y) < 0:
            continue
        poses = curved(
            costs, np.array(start), np.array(before), wider * radius, turning.any_heading, UNIT, spacing
        )  # fmt: skip
        if len(poses):
            rest = resampled(np.array([before[:2], (x, y)]), spacing)[1:] if run else np.empty((0, 2))
            poses = np.concatenate((poses, np.column_stack((rest, np.full(len(rest), yaw)))))
            cost = path_cost(costs, poses[:, :2])
        if cost >= 0:
            break
    if cost < 0:
        return no_plan(reasons.NO_ROOM_TO_TURN)
    points = terrain.origin + poses[:, :2] * terrain.resolution
    return Plan(points, wrapped_all(poses[:, 2]), cost * terrain.resolution / UNIT)


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
    """The pose's (x, y) in cells, inside its own cell also after the way to metres and back."""
    x0, y0 = terrain.origin
    row, column = cell
    return (
        min(max((pose.x - x0) / terrain.resolution, column + EDGE), column + 1 - EDGE),
        min(max((pose.y - y0) / terrain.resolution, row + EDGE), row + 1 - EDGE),
    )
