# SPDX-License-Identifier: Apache-2.0
"""NavFn, the planner of move_base and Nav2, by its published method (Konolige's `navfn`, 2008), for comparison only.

A potential spreads from the goal over the four neighbours of a cell, in blocks of rising priority. A quadratic
interpolates between the two lowest neighbours. The path descends the interpolated gradient by half cells.
`A*` adds the straight distance to the start to a cell's priority, and stops when the start has its potential.
"""

from math import hypot

import numpy as np
from numba import njit

from shared.types import Bools, Float32s, Float64s, Int64s, UInt16s

NEUTRAL = 50.0  # NavFn's COST_NEUTRAL
_HIGH = np.float32(1e10)  # POT_HIGH
_STEP = 0.5  # cells
_ROOT_HALF = 0.707


class NavFn:
    """Plans on costs (h, w) uint16, 0 blocked, NEUTRAL where nothing is near, the outermost ring blocked."""

    def __init__(self, costs: UInt16s) -> None:
        n = costs.size
        self._costs, self._potential, self._pending = costs, np.empty(n, np.float32), np.zeros(n, np.bool_)
        self._queues = np.zeros(n, np.int64), np.zeros(n, np.int64), np.zeros(n, np.int64)

    def path(self, start: tuple[int, int], goal: tuple[int, int], astar: bool) -> Float64s:
        """From start to goal, (row, column): (n, 2) points (x, y) in cells, n = 0 where it finds none."""
        w = self._costs.shape[1]
        start_cell, goal_cell = start[0] * w + start[1], goal[0] * w + goal[1]
        _propagate(
            self._costs.reshape(-1), w, start_cell, goal_cell, astar, self._potential, self._pending, *self._queues
        )
        if self._potential[start_cell] >= _HIGH:
            return np.empty((0, 2))
        return _descend(self._potential, w, start_cell, goal_cell, 4 * sum(self._costs.shape))


@njit(cache=True, nogil=True)
def _propagate(
    costs: UInt16s,
    w: int,
    start: int,
    goal: int,
    astar: bool,
    potential: Float32s,
    pending: Bools,
    now: Int64s,
    later: Int64s,
    over: Int64s,
) -> None:
    potential[:] = _HIGH
    pending[:] = False
    n_now, n_over = 0, 0
    sx, sy = start % w, start // w
    limit = np.float32(254.0)  # COST_OBS: the first block
    if astar:
        limit += np.float32(hypot(goal % w - sx, goal // w - sy) * NEUTRAL)
    potential[goal] = 0
    for step in (1, -1, w, -w):
        if costs[goal + step]:
            now[n_now] = goal + step
            pending[goal + step] = True
            n_now += 1
    while n_now or n_over:
        n_later = 0
        for k in range(n_now):
            pending[now[k]] = False
        for k in range(n_now):
            cell = now[k]
            left, right, up, down = potential[cell - 1], potential[cell + 1], potential[cell - w], potential[cell + w]
            a, b = min(left, right), min(up, down)
            low, high = min(a, b), max(a, b)
            hf = np.float32(costs[cell])
            apart = high - low
            if apart >= hf:
                value = low + hf
            else:
                d = apart / hf
                value = low + hf * (np.float32(-0.2301) * d * d + np.float32(0.5307) * d + np.float32(0.7040))
            if value >= potential[cell]:
                continue
            potential[cell] = value
            far = value
            if astar:
                far += np.float32(hypot(cell % w - sx, cell // w - sy) * NEUTRAL)
            for step in (-1, 1, -w, w):
                there = cell + step
                cost = costs[there]
                if cost == 0 or pending[there] or potential[there] <= value + np.float32(_ROOT_HALF * cost):
                    continue
                pending[there] = True
                if far < limit:
                    later[n_later] = there
                    n_later += 1
                else:
                    over[n_over] = there
                    n_over += 1
        now, later, n_now = later, now, n_later
        if n_now == 0:
            limit += np.float32(2 * NEUTRAL)
            now, over, n_now, n_over = over, now, n_over, 0
        if astar and potential[start] < _HIGH:
            break


@njit(cache=True, nogil=True)
def _descend(potential: Float32s, w: int, start: int, goal: int, max_points: int) -> Float64s:
    path = np.empty((max_points, 2))
    cell, dx, dy, n = start, 0.0, 0.0, 0
    while n < max_points - 1:
        x, y = cell % w + dx, cell // w + dy
        path[n, 0], path[n, 1] = x + 0.5, y + 0.5
        n += 1
        if hypot(x - goal % w, y - goal // w) < _STEP:
            path[n, 0], path[n, 1] = goal % w + 0.5, goal // w + 0.5
            return path[: n + 1]
        circling = n > 2 and path[n - 1, 0] == path[n - 3, 0] and path[n - 1, 1] == path[n - 3, 1]
        walled = circling
        for r in (-w, 0, w):
            for c in (-1, 0, 1):
                walled = walled or potential[cell + r + c] >= _HIGH
        if walled:  # to the lowest of the eight neighbours, on the cells
            lowest = cell
            for r in (-w, 0, w):
                for c in (-1, 0, 1):
                    if potential[cell + r + c] < potential[lowest]:
                        lowest = cell + r + c
            if lowest == cell:
                return path[:0]
            cell, dx, dy = lowest, 0.0, 0.0
            continue
        gx, gy = _gradient(potential, w, cell)
        gx1, gy1 = _gradient(potential, w, cell + 1)
        gx2, gy2 = _gradient(potential, w, cell + w)
        gx3, gy3 = _gradient(potential, w, cell + w + 1)
        across = (1 - dy) * ((1 - dx) * gx + dx * gx1) + dy * ((1 - dx) * gx2 + dx * gx3)
        up = (1 - dy) * ((1 - dx) * gy + dx * gy1) + dy * ((1 - dx) * gy2 + dx * gy3)
        size = hypot(across, up)
        if size < 1e-12:
            return path[:0]
        dx, dy = dx + _STEP * across / size, dy + _STEP * up / size
        if dx > 1:
            cell, dx = cell + 1, dx - 1
        if dx < -1:
            cell, dx = cell - 1, dx + 1
        if dy > 1:
            cell, dy = cell + w, dy - 1
        if dy < -1:
            cell, dy = cell - w, dy + 1
    return path[:0]


@njit(cache=True, nogil=True)
def _gradient(potential: Float32s, w: int, cell: int) -> tuple[float, float]:
    """The normed gradient, as NavFn's gradCell."""
    here = potential[cell]
    dx, dy = 0.0, 0.0
    if here >= _HIGH:
        if potential[cell - 1] < _HIGH:
            dx = -254.0
        elif potential[cell + 1] < _HIGH:
            dx = 254.0
        if potential[cell - w] < _HIGH:
            dy = -254.0
        elif potential[cell + w] < _HIGH:
            dy = 254.0
    else:
        if potential[cell - 1] < _HIGH:
            dx += potential[cell - 1] - here
        if potential[cell + 1] < _HIGH:
            dx += here - potential[cell + 1]
        if potential[cell - w] < _HIGH:
            dy += potential[cell - w] - here
        if potential[cell + w] < _HIGH:
            dy += here - potential[cell + w]
    norm = hypot(dx, dy)
    return (dx / norm, dy / norm) if norm > 0 else (0.0, 0.0)
