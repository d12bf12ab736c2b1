# SPDX-License-Identifier: Apache-2.0
"""Whether a goal is refused in any case: in a keep-out zone, outside the map, or without room for the robot."""

from math import ceil

import numpy as np

from shared import reasons
from shared.clearance import required_clearance
from shared.distance_field import distance_field
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import GoalLimits, Zone
from shared.reasons import Reason
from shared.types import Bools
from shared.zones import forbidding

MAX_SINGLE_CHECKS = 20  # poses for which single checks are faster than one of the whole map


def refusal_reason(
    grid: OccupancyGrid, limits: GoalLimits, inscribed_radius: float, goal: Pose2, tolerance: float
) -> Reason | None:
    """The planner's refusal of a goal (services/planner/planning.py), or None where it depends on the path.

    inscribed_radius: m, of the footprint. tolerance: m to the goal at which it is reached. An empty map refuses
    nothing.
    """
    if grid.empty:
        return None
    (h, w), (row, column), resolution = grid.cells.shape, grid.cell(goal.x, goal.y), grid.resolution
    beyond = ceil(limits.beyond_map / resolution)
    if not (-beyond <= row < h + beyond and -beyond <= column < w + beyond):
        return reasons.GOAL_OUTSIDE
    reach = max(tolerance, limits.reach)
    clearance = inscribed_radius + required_clearance(limits.margin, resolution)
    n, around = ceil(reach / resolution) + 1, ceil(clearance / resolution) + 1
    distance = _distances(grid, row, column, n + around)[around:-around, around:-around] * resolution
    rows, columns = np.ogrid[row - n : row + n + 1, column - n : column + n + 1]
    inside = (rows >= 0) & (rows < h) & (columns >= 0) & (columns < w)
    within = (rows >= -beyond) & (rows < h + beyond) & (columns >= -beyond) & (columns < w + beyond)
    room = np.where(inside, distance >= clearance - 1e-6, within)
    x, y = (goal.x - grid.x0) / resolution, (goal.y - grid.y0) / resolution
    near = np.hypot(columns + 0.5 - x, rows + 0.5 - y) * resolution <= reach
    near[n, n] = True
    min_clearance = inscribed_radius + required_clearance(min(limits.least_margin, limits.margin), resolution)
    if (room & near).any() or distance[n, n] >= min_clearance - 1e-6:
        return None
    return reasons.GOAL_BLOCKED


def needs_check(grid: OccupancyGrid, limits: GoalLimits, inscribed_radius: float, poses: tuple[Pose2, ...]) -> Bools:
    """(n,) bool: which poses `refusal_reason` may refuse. The others are far enough from every occupied cell."""
    if len(poses) <= MAX_SINGLE_CHECKS or grid.empty:
        return np.ones(len(poses), bool)
    distance = distance_field(grid.occupied, 1.0) * grid.resolution
    rows, columns = grid.cells_of(np.array([(pose.x, pose.y) for pose in poses])).T
    h, w = grid.cells.shape
    inside = (rows >= 0) & (rows < h) & (columns >= 0) & (columns < w)
    clearance = inscribed_radius + required_clearance(limits.margin, grid.resolution)
    room = distance[np.clip(rows, 0, h - 1), np.clip(columns, 0, w - 1)] >= clearance
    return np.asarray(~(inside & room))


def _distances(grid: OccupancyGrid, row: int, column: int, n: int) -> np.ndarray[tuple[int, int], np.dtype[np.float32]]:
    """(2 n + 1, 2 n + 1) cells from each cell around (row, column) to the nearest obstacle among them; none outside."""
    occupied = np.zeros((2 * n + 1, 2 * n + 1), bool)
    h, w = grid.cells.shape
    r0, c0, r1, c1 = max(row - n, 0), max(column - n, 0), min(row + n + 1, h), min(column + n + 1, w)
    if r0 < r1 and c0 < c1:
        place = slice(r0 - row + n, r1 - row + n), slice(c0 - column + n, c1 - column + n)
        occupied[place] = grid.occupied[r0:r1, c0:c1]
    return distance_field(occupied, 1.0)


def refused_pose(
    poses: tuple[Pose2, ...],
    grid: OccupancyGrid,
    limits: GoalLimits | None,
    inscribed_radius: float,
    tolerance: float,
    zones: tuple[Zone, ...],
    map_grows: bool,
) -> tuple[Reason, str] | None:
    """Returns why the planner would refuse a pose of a route in any case, and which pose that is; None if it may not.

    inscribed_radius, tolerance: m.  map_grows: a later pose may lie outside of it, as the robot drives there over the
    poses before.
    """
    doubts = needs_check(grid, limits, inscribed_radius, poses) if limits is not None else np.zeros(len(poses), bool)
    for number, (pose, zone) in enumerate(zip(poses, forbidding(zones, poses), strict=True), 1):
        if zone is not None:
            return reasons.GOAL_KEEP_OUT, f"pose {number} of {len(poses)} is in {zone.name}"
        if limits is None or not doubts[number - 1]:
            continue
        refusal = refusal_reason(grid, limits, inscribed_radius, pose, tolerance)
        if refusal is not None and not (refusal is reasons.GOAL_OUTSIDE and number > 1 and map_grows):
            return refusal, f"pose {number} of {len(poses)}, at ({pose.x:.2f}, {pose.y:.2f}): {refusal.text}"
    return None
