# SPDX-License-Identifier: Apache-2.0
"""From a way over cells to a path that a robot follows: string pulling, relaxed corners, even spacing, round bends.

Points are (x, y) in cells of the cost grid: the centre of cell (row, column) is (column + 0.5, row + 0.5). Costs are
those of `traversal_cost`; a path's cost is the integral of the costs along it, which for a way over cells is exactly
what the search minimises. A shortcut is taken where it costs no more, so clearance is never sold for length.
"""

from math import hypot

import numpy as np
from numba import njit
from numpy.typing import NDArray

UInt16s = NDArray[np.uint16]
Float64s = NDArray[np.float64]

BLOCKED = -1.0
"""The cost of a line that touches a blocked cell."""

_RELAX_STEPS = (4.0, 2.0, 1.0, 0.5)  # cells that a corner is moved, coarse to fine
_RELAX_SWEEPS = 4
_ROUND_SWEEPS = 12
_ROUND_COST = 1.25  # how much dearer than before a moved point may lie
_ROUND_SHARE = 0.02  # of the path's cost: what rounding may add to it


def smoothed(costs: UInt16s, points: Float64s, spacing: float) -> Float64s:
    """A path from the first to the last of points (n, 2), n >= 2, that touches no blocked cell: (m, 2).

    Adjacent points must see each other; spacing, cells, bounds the distance between adjacent points of the result.
    """
    corners = points[_pulled(costs, points)]
    _relax(costs, corners)
    corners = corners[_pulled(costs, corners)]
    path = resampled(corners, spacing)
    _round(costs, path)
    return path


def resampled(corners: Float64s, spacing: float) -> Float64s:
    """Points on the polyline, its corners among them, at most `spacing` apart: (m, 2)."""
    legs = np.diff(corners, axis=0)
    lengths = np.sqrt(legs[:, 0] ** 2 + legs[:, 1] ** 2)
    parts = [corners[:1]]
    for corner, leg, length in zip(corners, legs, lengths):
        n = max(int(np.ceil(length / spacing)), 1)
        parts.append(corner + leg * (np.arange(1, n + 1) / n)[:, None])
    path = np.concatenate(parts)
    path[-1] = corners[-1]
    return path


@njit(cache=True, nogil=True)
def path_cost(costs: UInt16s, points: Float64s) -> float:
    """The cost of the polyline through points (n, 2), BLOCKED where it touches a blocked cell."""
    total = 0.0
    for i in range(len(points) - 1):
        cost = line_cost(costs, points[i, 0], points[i, 1], points[i + 1, 0], points[i + 1, 1])
        if cost < 0:
            return BLOCKED
        total += cost
    return total


@njit(cache=True, nogil=True)
def line_cost(costs: UInt16s, x0: float, y0: float, x1: float, y1: float) -> float:
    """The integral of the costs along a line, or BLOCKED. Amanatides & Woo 1987, where a line through a corner of four
    cells touches all of them."""
    column, row = int(np.floor(x0)), int(np.floor(y0))
    last_column, last_row = int(np.floor(x1)), int(np.floor(y1))
    h, w = costs.shape
    if min(row, last_row, column, last_column) < 0 or max(row, last_row) >= h or max(column, last_column) >= w:
        return BLOCKED
    dx, dy = x1 - x0, y1 - y0
    length = hypot(dx, dy)
    across, up = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
    # shares of the line at which it leaves the present column, the present row
    t_column = ((column + (dx > 0)) - x0) / dx if dx != 0 else np.inf
    t_row = ((row + (dy > 0)) - y0) / dy if dy != 0 else np.inf
    per_column = abs(1 / dx) if dx != 0 else np.inf
    per_row = abs(1 / dy) if dy != 0 else np.inf
    here, total = 0.0, 0.0
    n_steps = abs(last_column - column) + abs(last_row - row)
    while n_steps > 0:
        if costs[row, column] == 0:
            return BLOCKED
        there = max(min(t_column, t_row, 1.0), here)
        total += (there - here) * costs[row, column]
        here = there
        corner = abs(t_column - t_row) < 1e-9 and column != last_column and row != last_row
        if corner and (costs[row + up, column] == 0 or costs[row, column + across] == 0):
            return BLOCKED
        by_column = corner or row == last_row or (t_column < t_row and column != last_column)
        if by_column:
            column += across
            t_column += per_column
            n_steps -= 1
        if corner or not by_column:
            row += up
            t_row += per_row
            n_steps -= 1
    if costs[last_row, last_column] == 0:
        return BLOCKED
    return float((total + (1.0 - here) * costs[last_row, last_column]) * length)


@njit(cache=True, nogil=True)
def _pulled(costs: UInt16s, points: Float64s) -> NDArray[np.int64]:
    """Indices of the points that remain when each is joined to the farthest one that a line reaches at no more cost."""
    n = len(points)
    so_far = np.zeros(n)
    for i in range(1, n):
        so_far[i] = so_far[i - 1] + line_cost(costs, points[i - 1, 0], points[i - 1, 1], points[i, 0], points[i, 1])
    kept = np.zeros(n, np.int64)
    n_kept, i = 1, 0
    while i < n - 1:
        good, bad, step = i + 1, n, 2
        while i + step < n:
            if not _cheaper(costs, points, so_far, i, i + step):
                bad = i + step
                break
            good = i + step
            step *= 2
        while bad - good > 1:
            middle = (good + bad) // 2
            if _cheaper(costs, points, so_far, i, middle):
                good = middle
            else:
                bad = middle
        i = good
        kept[n_kept] = i
        n_kept += 1
    return kept[:n_kept]


@njit(cache=True, nogil=True)
def _cheaper(costs: UInt16s, points: Float64s, so_far: Float64s, i: int, k: int) -> bool:
    cost = line_cost(costs, points[i, 0], points[i, 1], points[k, 0], points[k, 1])
    return cost >= 0 and cost <= (so_far[k] - so_far[i]) * (1 + 1e-9) + 1e-9


@njit(cache=True, nogil=True)
def _relax(costs: UInt16s, corners: Float64s) -> None:
    """Moves inner corners where that makes the path cheaper, in place."""
    for step in _RELAX_STEPS:
        for _ in range(_RELAX_SWEEPS):
            moved = False
            for i in range(1, len(corners) - 1):
                x, y = corners[i, 0], corners[i, 1]
                least = _two_lines(costs, corners, i, x, y)
                for direction in range(8):
                    across = (1, 1, 0, -1, -1, -1, 0, 1)[direction] * step
                    up = (0, 1, 1, 1, 0, -1, -1, -1)[direction] * step
                    cost = _two_lines(costs, corners, i, x + across, y + up)
                    if 0 <= cost < least - 1e-6:
                        least, moved = cost, True
                        corners[i, 0], corners[i, 1] = x + across, y + up
            if not moved:
                break


@njit(cache=True, nogil=True)
def _two_lines(costs: UInt16s, points: Float64s, i: int, x: float, y: float) -> float:
    """The cost from point i - 1 by (x, y) to point i + 1, or BLOCKED."""
    before = line_cost(costs, points[i - 1, 0], points[i - 1, 1], x, y)
    if before < 0:
        return BLOCKED
    after = line_cost(costs, x, y, points[i + 1, 0], points[i + 1, 1])
    return before + after if after >= 0 else BLOCKED


@njit(cache=True, nogil=True)
def _round(costs: UInt16s, path: Float64s) -> None:
    """Moves inner points towards the middle of their neighbours, in place, where that is free and not much dearer.

    A point in a cell of no great cost says little about the lines to it, so the path as a whole has its limit too.
    """
    spare = _ROUND_SHARE * path_cost(costs, path)
    for _ in range(_ROUND_SWEEPS):
        for i in range(1, len(path) - 1):
            x = (path[i - 1, 0] + 2 * path[i, 0] + path[i + 1, 0]) / 4
            y = (path[i - 1, 1] + 2 * path[i, 1] + path[i + 1, 1]) / 4
            limit = _ROUND_COST * costs[int(path[i, 1]), int(path[i, 0])]
            if costs[int(y), int(x)] > limit:
                continue
            cost = _two_lines(costs, path, i, x, y)
            added = cost - _two_lines(costs, path, i, path[i, 0], path[i, 1])
            if cost >= 0 and added <= spare:
                path[i, 0], path[i, 1] = x, y
                spare -= added
