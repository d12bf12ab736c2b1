# SPDX-License-Identifier: Apache-2.0
"""The shortest path of all on a grid of free and blocked cells: what any-angle lengths are divided by.

A* over the obstacles' convex corners that see each other, in which every shortest path bends (Lozano-Perez & Wesley
1979). Lines may touch blocked cells, but not pass between two that touch at a corner. So it is exact for a point, and
no planner that keeps off corners reaches it.
"""

import heapq
from math import hypot

import numpy as np
from numba import njit

from shared.types import Bools, Float64s, Int64s

MAX_PAIRS = 2 * 10**8
"""Pairs of corners that one search examines: about 4 s of CPU.

The maps of the benchmark need half of it, a maze of 512 x 512 cells with corridors of one cell ten times as many.
"""

_HAIR = 1e-7  # cells; coordinates are halves, and slopes ratios of at most 10^4, so what differs differs by more


def corners_of(free: Bools) -> Int64s:
    """(n, 4) int64: x and y of each convex corner of obstacles, and the signs of the direction to its blocked cell.

    free: (h, w) bool; outside is blocked. Cell (row, column) spans x from column to column + 1, y from row to row + 1.
    """
    blocked = np.pad(~free, 1, constant_values=True)
    corners = []
    for dy in (0, 1):
        for dx in (0, 1):
            only = np.ones((blocked.shape[0] - 1, blocked.shape[1] - 1), bool)
            for y in (0, 1):
                for x in (0, 1):
                    cell = blocked[y : y + only.shape[0], x : x + only.shape[1]]
                    only &= cell if (y, x) == (dy, dx) else ~cell
            rows, columns = np.nonzero(only)
            corners.append(
                np.column_stack((columns, rows, np.full(len(rows), 2 * dx - 1), np.full(len(rows), 2 * dy - 1)))
            )
    return np.concatenate(corners).astype(np.int64)


def shortest_length(free: Bools, corners: Int64s, ends: Float64s, upper_bound: float) -> float | None:
    """Length of the shortest path, cells; inf if there is none, None if the search would examine over MAX_PAIRS pairs.

    corners: result of `corners_of`.   ends: (2, 2) float64, (x, y) in cells.
    upper_bound: length of any path, cells. Corners outside of the ellipse with this sum of distances are left out.
    """
    (x0, y0), (x1, y1) = ends
    x, y = corners[:, 0], corners[:, 1]
    around = np.hypot(x - x0, y - y0) + np.hypot(x - x1, y - y1) <= upper_bound + _HAIR
    length = float(_shortest_length(free, corners[around], x0, y0, x1, y1, MAX_PAIRS))
    return None if np.isnan(length) else length


@njit(cache=True, nogil=True)
def _shortest_length(free: Bools, corners: Int64s, x0: float, y0: float, x1: float, y1: float, max_pairs: int) -> float:
    if sees(free, x0, y0, x1, y1):
        return hypot(x1 - x0, y1 - y0)
    n, pairs = len(corners), 0
    best = np.full(n + 2, np.inf)
    settled = np.zeros(n + 2, np.bool_)
    best[n] = 0.0
    queue = [(hypot(x1 - x0, y1 - y0), n)]
    while queue:
        _, i = heapq.heappop(queue)
        if i == n + 1:
            return float(best[i])
        if settled[i]:
            continue
        pairs += n
        if pairs > max_pairs:
            return np.nan
        settled[i] = True
        x, y = (x0, y0) if i == n else (float(corners[i, 0]), float(corners[i, 1]))
        for j in range(n + 1):
            if j == n:
                tx, ty, j = x1, y1, n + 1
            else:
                tx, ty = float(corners[j, 0]), float(corners[j, 1])
            length = best[i] + hypot(tx - x, ty - y)
            if settled[j] or length >= best[j]:
                continue
            # a shortest path bends around the corner at each of its points: it comes and goes beside the blocked cell
            if i < n and (tx - x) * corners[i, 2] * (ty - y) * corners[i, 3] > 0:
                continue
            if j < n and (tx - x) * corners[j, 2] * (ty - y) * corners[j, 3] > 0:
                continue
            if sees(free, x, y, tx, ty):
                best[j] = length
                heapq.heappush(queue, (length + hypot(x1 - tx, y1 - ty), j))
    return np.inf


@njit(cache=True, nogil=True)
def sees(free: Bools, x0: float, y0: float, x1: float, y1: float) -> bool:
    """Whether the line between two points runs through no blocked cell and between no two that touch."""
    if abs(x1 - x0) < abs(y1 - y0):
        return _sees(free.T, y0, x0, y1, x1)
    return _sees(free, x0, y0, x1, y1)


@njit(cache=True, nogil=True)
def _sees(free: Bools, x0: float, y0: float, x1: float, y1: float) -> bool:
    """For a line that is no steeper than a diagonal, column by column."""
    if x1 < x0:
        x0, y0, x1, y1 = x1, y1, x0, y0
    if x1 == x0:
        return True
    slope = (y1 - y0) / (x1 - x0)
    column = int(np.floor(x0))
    while column < x1 - _HAIR:
        left, right = max(float(column), x0), min(column + 1.0, x1)
        ya, yb = y0 + (left - x0) * slope, y0 + (right - x0) * slope
        low, high = int(np.floor(min(ya, yb) + _HAIR)), int(np.ceil(max(ya, yb) - _HAIR)) - 1
        if high < low:  # along the edge between two rows
            if not (_is_free(free, low, column) or _is_free(free, low - 1, column)):
                return False
        else:
            for row in range(low, high + 1):
                if not _is_free(free, row, column):
                    return False
        if left > x0 and abs(ya - round(ya)) < _HAIR:  # through a corner of four cells
            row = round(ya)
            here, across = _is_free(free, row, column), _is_free(free, row - 1, column - 1)
            other, opposite = _is_free(free, row - 1, column), _is_free(free, row, column - 1)
            if not (here or across) or not (other or opposite):
                return False
        column += 1
    return True


@njit(cache=True, nogil=True)
def _is_free(free: Bools, row: int, column: int) -> bool:
    return bool(0 <= row < free.shape[0] and 0 <= column < free.shape[1] and free[row, column])
