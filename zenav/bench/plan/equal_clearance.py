# SPDX-License-Identifier: Apache-2.0
"""The length of the shortest path with the same least clearance and the same mean clearance as a given path.

A path with clearance d along it has the mean clearance m where the integral of m - d is 0. Take any k >= 0, and the
minimum of the integral of 1 + k (m - d) over all paths with the least clearance. By Lagrangian duality, this minimum is
no more than the length of any such path with the mean m or more. So the largest minimum over k is a lower bound of
these lengths.
"""

import heapq
from math import gcd, hypot

import numpy as np
from numba import njit

from services.planner.costmap import GlobalCostmap
from services.planner.ray_cost import path_cost
from shared.types import Bools, Float32s, Float64s, Int64s
from zenav.bench.plan.shortest import corners_of, shortest_length

SHARES = (0.05, 0.1, 0.2, 0.3, 0.45, 0.6, 0.75, 0.9)
"""Of the k at which the farthest cell costs nothing. The least is concave in k: once it falls, it goes on falling."""

MAX_STEP = 4  # cells along which one step goes, at most
MAX_STEP_SURPLUS = 1 / float(
    np.cos(0.5 * np.arctan(1 / MAX_STEP))
)  # by how much a way of such steps is longer than a line, at most
N_SAMPLES = 4  # of a step, per cell
_HAIR = 1e-6  # cells


def least_clearance(terrain: GlobalCostmap, path: Float64s, sampled: float) -> float:
    """Cells from the nearest obstacle to the nearest cell that the path touches; sampled: a bound, found by looking."""
    distances = np.unique(terrain.distance[terrain.distance <= sampled + _HAIR])
    for clearance in distances[::-1]:
        if path_cost(_cells_with_clearance(terrain, float(clearance)).astype(np.uint16), path - terrain.pad) >= 0:
            return float(clearance)
    return 0.0


def ratio_to_least_clearance(
    terrain: GlobalCostmap, path: Float64s, length: float, min_clearance: float
) -> float | None:
    """The length (cells) over that of the shortest path with at least `min_clearance` (cells) to obstacles.

    None if that search is too large.
    """
    free = _cells_with_clearance(terrain, min_clearance)
    best = shortest_length(free, corners_of(free), path[[0, -1]] - terrain.pad, length)
    return None if best is None else length / best


def ratio_to_equal_clearance(
    terrain: GlobalCostmap, path: Float64s, length: float, min_clearance: float, mean: float, shorter: float
) -> float:
    """Upper bound of the length over that of the shortest path with this least and this mean clearance.

    length, min_clearance, mean: cells.   shorter: the result of `ratio_to_least_clearance`, the bound for k = 0.
    Steps between cells are longer than lines: their largest surplus, MAX_STEP_SURPLUS, is divided out.
    """
    free, max_distance = _cells_with_clearance(terrain, min_clearance), float(terrain.distance.max())
    best = length / shorter
    offsets = np.array(
        [(r, c) for r in range(-MAX_STEP, MAX_STEP + 1) for c in range(-MAX_STEP, MAX_STEP + 1) if gcd(r, c) == 1],
        np.int64,
    )
    ends = np.floor(path[[0, -1]] - terrain.pad).astype(np.int64)
    before = 0.0
    for share in SHARES if max_distance - mean > _HAIR else ():
        k = share / (max_distance - mean)
        bound = min(
            _min_integral(free, terrain.distance, mean, k, 1 - share, offsets, ends, length * MAX_STEP_SURPLUS)
            / MAX_STEP_SURPLUS,
            length,
        )
        best = max(best, bound)
        if bound < before:
            break
        before = bound
    return length / best


def _cells_with_clearance(terrain: GlobalCostmap, min_clearance: float) -> Bools:
    """The map's cells that the robot may be in and that are no nearer to obstacles."""
    inside = slice(terrain.pad, -terrain.pad)
    return np.asarray((terrain.distance >= min_clearance - _HAIR) & (terrain.costs[inside, inside] > 0))


@njit(cache=True, nogil=True)
def _min_integral(
    free: Bools, distance: Float32s, mean: float, k: float, low: float, offsets: Int64s, ends: Int64s, limit: float
) -> float:
    """The least integral of 1 + k (mean - distance) by steps of `offsets` from cell to cell, (x, y); inf above `limit`.

    low: the integrand's lowest value.
    """
    h, w = free.shape
    (x0, y0), (x1, y1) = ends
    best = np.full(h * w, np.inf, np.float32)
    settled = np.zeros(h * w, np.bool_)
    goal = y1 * w + x1
    best[y0 * w + x0] = 0.0
    queue = [(low * hypot(x1 - x0, y1 - y0), y0 * w + x0)]
    while queue:
        _, cell = heapq.heappop(queue)
        if cell == goal:
            return float(best[cell])
        if settled[cell]:
            continue
        settled[cell] = True
        row, column = cell // w, cell % w
        for dr, dc in offsets:
            r, c = row + dr, column + dc
            if r < 0 or c < 0 or r >= h or c >= w or settled[r * w + c] or not free[r, c]:
                continue
            rest = low * hypot(x1 - c, y1 - r)
            if best[cell] + low * hypot(dr, dc) + rest > min(limit, best[r * w + c] + rest):
                continue
            n, total, blocked = N_SAMPLES * max(abs(dr), abs(dc)), 0.0, False
            for i in range(n):
                share = (i + 0.5) / n
                at = int(row + 0.5 + share * dr), int(column + 0.5 + share * dc)
                if not free[at]:
                    blocked = True
                    break
                total += 1 + k * (mean - distance[at])
            total = best[cell] + total / n * hypot(dr, dc)
            if not blocked and total < best[r * w + c] and total + rest <= limit:
                best[r * w + c] = total
                heapq.heappush(queue, (total + rest, r * w + c))
    return np.inf
