# SPDX-License-Identifier: Apache-2.0
"""From a path over cells to a smooth one: string pulling, relaxed corners, round bends, even spacing.

Points are (x, y) in cells of the costmap: the centre of cell (row, column) is (column + 0.5, row + 0.5). A path's cost
is the integral of the costs along it (`ray_cost`). A shortcut must not cost more, so smoothing never gives up
clearance.

String pulling joins points by free lines, as the path smoothing of HPA* (Botea, Mueller and Schaeffer 2004). A corner
moves across the line between its neighbours where that lowers the cost. This is the relaxation of Thorpe, "Path
relaxation: path planning for a mobile robot", AAAI 1984. Bends are quadratic Bezier curves. That no shortcut may cost
more is our own.
"""

from math import atan2, hypot

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.planner.costmap import UNIT_COST
from services.planner.ray_cost import BLOCKED, line_cost
from shared.types import Float64s, UInt16s

_RELAX_STEPS = ((3.0, 4), (1.0, 2), (0.4, 2))  # cells that a corner is moved, coarse to fine; number of directions
_MAX_BEND_CELLS = 10.0  # of the path before and after a corner
_MIN_BEND_CELLS = 0.5
_MIN_GAIN = 1e-6  # of cost, for which a corner is moved
_SAME_POINT_CELLS = 1e-6  # distance of points that count as one
_MAX_BEND_COST_RATIO = 1.02  # of a bend to its corner


@njit(cache=True, nogil=True)
def smooth_path_in_map(
    costs: UInt16s,
    here: tuple[float, float],
    escape: Float64s,
    points: Float64s,
    end: tuple[float, float],
    spacing: float,
    last: float,
    origin: tuple[float, float],
    resolution: float,
) -> tuple[Float64s, Float64s, float]:
    """The smooth path from the robot to the goal: (m, 2) m, its headings (m,) rad, and its cost from `points` on.

    All arguments are in cells of the costs, with their lower left corner at `origin`, m. escape: (k, 2), from `here` to
    the first of `points`; empty where the robot stands in that cell. It is not smoothed. end: a point in the last cell.
    spacing: maximum distance between points of the result. last: rad, heading at the end. resolution: m a cell.
    """
    n_lead = 1 if len(escape) == 0 else 0
    whole = np.empty((n_lead + len(points) + 1, 2))
    whole[0, 0], whole[0, 1] = here
    whole[n_lead:-1] = points
    whole[-1, 0], whole[-1, 1] = end
    path, cost = _smooth(costs, whole, spacing)
    if n_lead == 0:
        lead = np.empty((len(escape) + 1, 2))
        lead[0, 0], lead[0, 1] = here
        lead[1:] = escape
        path = np.concatenate((resampled_path(lead, spacing), path[1:]))
    yaws = headings(path, last)
    for i in range(len(path)):
        path[i, 0] = origin[0] + path[i, 0] * resolution
        path[i, 1] = origin[1] + path[i, 1] * resolution
    return path, yaws, cost


@njit(cache=True, nogil=True)
def smooth_path(costs: UInt16s, points: Float64s, spacing: float) -> Float64s:
    """A path (m, 2) from the first to the last of points (n, 2), n >= 2, without blocked cells.

    Adjacent points must be visible from each other. spacing: maximum distance between points of the result, cells.
    """
    return _smooth(costs, points, spacing)[0]


@njit(cache=True, nogil=True)
def _smooth(costs: UInt16s, points: Float64s, spacing: float) -> tuple[Float64s, float]:
    """The path and its cost."""
    corners = points[_string_pulled(costs, points)]
    if len(corners) > 2:
        _relax(costs, corners)
        corners = corners[_string_pulled(costs, corners)]
    return _round_corners(costs, corners, spacing)


@njit(cache=True, nogil=True)
def resampled_path(corners: Float64s, spacing: float) -> Float64s:
    """Points on the polyline, with its corners, at most `spacing` apart: (m, 2)."""
    n = 1
    for i in range(len(corners) - 1):
        n += _n_pieces(corners[i], corners[i + 1], spacing)
    path = np.empty((n, 2))
    path[0] = corners[0]
    n = int(np.int64(1))  # a literal would compile what it is given to once more
    for i in range(1, len(corners)):
        n = _append_line(path, n, corners[i], spacing)
    return path[:n]


@njit(cache=True, nogil=True)
def headings(path: Float64s, last: float) -> Float64s:
    """(n,) rad: directions along the path (n, 2), n >= 1, and `last` at its end."""
    yaws = np.empty(len(path))
    for i in range(len(path) - 1):
        yaws[i] = atan2(path[i + 1, 1] - path[i, 1], path[i + 1, 0] - path[i, 0])
    yaws[-1] = last
    return yaws


@njit(cache=True, nogil=True)
def _n_pieces(start: Float64s, end: Float64s, spacing: float) -> int:
    return max(int(np.ceil(hypot(end[0] - start[0], end[1] - start[1]) / spacing)), 1)


@njit(cache=True, nogil=True)
def _string_pulled(costs: UInt16s, points: Float64s) -> NDArray[np.int64]:
    """Indices of the points that remain when each is joined to the farthest one by a line at no higher cost."""
    n = len(points)
    so_far = np.zeros(n)
    for i in range(1, n):
        so_far[i] = so_far[i - 1] + line_cost(
            costs, points[i - 1, 0], points[i - 1, 1], points[i, 0], points[i, 1], np.inf
        )
    indices = np.zeros(n, np.int64)
    n_kept = 1
    i = int(np.int64(0))
    while i < n - 1:
        good, bad, step = i + 1, n, 2
        while i + step < n:
            if not _is_cheaper(costs, points, so_far, i, i + step):
                bad = i + step
                break
            good = i + step
            step *= 2
        while bad - good > 1:
            middle = (good + bad) // 2
            if _is_cheaper(costs, points, so_far, i, middle):
                good = middle
            else:
                bad = middle
        i = good
        indices[n_kept] = i
        n_kept += 1
    return indices[:n_kept]


@njit(cache=True, nogil=True)
def _is_cheaper(costs: UInt16s, points: Float64s, so_far: Float64s, i: int, k: int) -> bool:
    max_cost = (so_far[k] - so_far[i]) * (1 + 1e-9) + 1e-9
    cost = line_cost(costs, points[i, 0], points[i, 1], points[k, 0], points[k, 1], max_cost)
    return bool(0 <= cost <= max_cost)


@njit(cache=True, nogil=True)
def _relax(costs: UInt16s, corners: Float64s) -> None:
    """Moves inner corners in place where that lowers the cost: once by each step, from the first corner on.

    The moves go across the line between the neighbours; the longest step goes along it, too.
    """
    legs = np.empty(len(corners) - 1)
    for i in range(len(legs)):
        legs[i] = _leg_cost(costs, corners[i], corners[i + 1])
    for step, n_ways in _RELAX_STEPS:
        for i in range(1, len(corners) - 1):
            _slide(costs, corners, legs, i, step, n_ways)


@njit(cache=True, nogil=True)
def _slide(costs: UInt16s, corners: Float64s, legs: Float64s, i: int, step: float, n_ways: int) -> None:
    """Moves corner i by a step in the first of n_ways directions that lowers the cost: across, back, along, back."""
    ax, ay, bx, by = corners[i - 1, 0], corners[i - 1, 1], corners[i + 1, 0], corners[i + 1, 1]
    dx, dy = bx - ax, by - ay
    chord = hypot(dx, dy)
    if chord < _SAME_POINT_CELLS:
        return
    dx, dy = dx / chord * step, dy / chord * step
    max_cost = legs[i - 1] + legs[i] - _MIN_GAIN
    for k in range(n_ways):
        move_x, move_y = (-dy, dx) if k < 2 else (dx, dy)
        sign = 1 if k % 2 == 0 else -1
        x, y = corners[i, 0] + sign * move_x, corners[i, 1] + sign * move_y
        rest = UNIT_COST * hypot(bx - x, by - y)  # lower bound of the second leg's cost
        if UNIT_COST * hypot(x - ax, y - ay) + rest > max_cost:
            continue
        before = line_cost(costs, ax, ay, x, y, max_cost - rest)
        if before < 0 or before + rest > max_cost:
            continue
        after = line_cost(costs, x, y, bx, by, max_cost - before)
        if 0 <= after <= max_cost - before:
            corners[i, 0], corners[i, 1], legs[i - 1], legs[i] = x, y, before, after
            return


@njit(cache=True, nogil=True)
def _round_corners(costs: UInt16s, corners: Float64s, spacing: float) -> tuple[Float64s, float]:
    """The polyline with a bend in place of each corner, as wide as its legs and the costs allow; and its cost."""
    max_cost = int(2 * _MAX_BEND_CELLS / spacing) + 2  # points of a bend
    n = len(corners) * max_cost + 2
    for i in range(len(corners) - 1):
        n += _n_pieces(corners[i], corners[i + 1], spacing)
    path, bend = np.empty((n, 2)), np.empty((max_cost, 2))
    path[0] = corners[0]
    n = int(np.int64(1))
    total = 0.0
    for i in range(1, len(corners) - 1):
        bx, by = corners[i - 1, 0] - corners[i, 0], corners[i - 1, 1] - corners[i, 1]
        ax, ay = corners[i + 1, 0] - corners[i, 0], corners[i + 1, 1] - corners[i, 1]
        before, after = hypot(bx, by), hypot(ax, ay)
        # a leg between two corners is shared by their bends
        reach = min(before * (0.5 if i > 1 else 1.0), after * (0.5 if i < len(corners) - 2 else 1.0), _MAX_BEND_CELLS)
        cost, n_bend = BLOCKED, 0
        while reach >= _MIN_BEND_CELLS and cost < 0:
            sx, sy = bx / before * reach, by / before * reach
            ex, ey = ax / after * reach, ay / after * reach
            n_bend = max(int(np.ceil(2 * reach / spacing)), 2) + 1
            for k in range(n_bend):
                t = k / (n_bend - 1)
                s, e = (1 - t) * (1 - t), t * t
                bend[k, 0], bend[k, 1] = corners[i, 0] + s * sx + e * ex, corners[i, 1] + s * sy + e * ey
            cost = _bend_cost(costs, bend[:n_bend], corners[i])
            reach /= 2
        if cost < 0:
            bend[0], n_bend, cost = corners[i], 1, 0.0
        total += cost + _leg_cost(costs, path[n - 1], bend[0])
        n = _append_line(path, n, bend[0], spacing)
        path[n : n + n_bend - 1] = bend[1:n_bend]
        n += n_bend - 1
    total += _leg_cost(costs, path[n - 1], corners[-1])
    n = max(_append_line(path, n, corners[-1], spacing), 2)
    path[n - 1] = corners[-1]
    return path[:n], total


@njit(cache=True, nogil=True)
def _append_line(path: Float64s, n: int, end: Float64s, spacing: float) -> int:
    """Continues the path from its n-th point straight to `end`. Returns the new number of points.

    Nothing is added where both are the same point: where two bends meet, or a bend begins at the start.
    """
    x, y = path[n - 1]
    dx, dy = end[0] - x, end[1] - y
    if abs(dx) + abs(dy) < _SAME_POINT_CELLS:
        return n
    k = _n_pieces(path[n - 1], end, spacing)
    for j in range(1, k):
        path[n, 0], path[n, 1] = x + dx * (j / k), y + dy * (j / k)
        n += 1
    path[n] = end
    return n + 1


@njit(cache=True, nogil=True)
def _leg_cost(costs: UInt16s, start: Float64s, end: Float64s) -> float:
    return line_cost(costs, start[0], start[1], end[0], end[1], np.inf)


@njit(cache=True, nogil=True)
def _bend_cost(costs: UInt16s, bend: Float64s, corner: Float64s) -> float:
    """The cost of a bend; BLOCKED where it touches a blocked cell or costs much more than its corner."""
    limit, total = _MAX_BEND_COST_RATIO * (_leg_cost(costs, bend[0], corner) + _leg_cost(costs, corner, bend[-1])), 0.0
    for k in range(len(bend) - 1):
        cost = line_cost(costs, bend[k, 0], bend[k, 1], bend[k + 1, 0], bend[k + 1, 1], np.inf)
        total += cost
        if cost < 0 or total > limit:
            return BLOCKED
    return total
