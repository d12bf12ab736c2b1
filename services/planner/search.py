# SPDX-License-Identifier: Apache-2.0
"""The cheapest path over an 8-connected cost grid: A* with a circular bucket queue.

A* is that of Hart, Nilsson and Raphael 1968, with the octile distance as heuristic. Costs are integers, so buckets
replace the heap (Dial 1969). A bucket holds different totals: cells that were expanded too early are expanded again, as
in delta-stepping (Meyer and Sanders 2003). So the result is exact. Buffers are never cleared.
"""

from typing import Generic, TypeVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.planner.bucket_queue import empty_ring, pop_entry, push_entry
from shared.types import Int8s, Int32s, Int64s, UInt16s

Origin = TypeVar("Origin", np.int8, np.int32)

STRAIGHT, DIAGONAL = 2378, 3363
"""Half a step's length, in integers; 3363 / 2378 is sqrt(2) to 6e-8 (a convergent of its continued fraction)."""

COST_BITS = 42
"""Bits of a key for the cost so far. The bits above number the searches downwards: keys of older ones are larger."""

QUEUE_FULL = -1
"""Result of a search that ran out of queue entries."""

_SEARCHES = 2**21 - 1  # number of stamps
_ROW = np.array([0, 1, 0, -1, 1, 1, -1, -1], np.int64)
_COLUMN = np.array([1, 0, -1, 0, 1, -1, 1, -1], np.int64)


class SearchBuffers(Generic[Origin]):
    """Buffers of searches, for each cell or node: `keys` (stamp and cost so far) and `origins` (its predecessor).

    They are never cleared: a new search has a lower stamp than all before it, so every old key is too high.
    """

    def __init__(self, origins: type[Origin]) -> None:
        self.stamp: Int64s = np.zeros(1, np.int64)  # of the latest search
        self.keys: Int64s = np.zeros(0, np.int64)
        self.origins: NDArray[Origin] = np.zeros(0, origins)

    def begin(self, size: int) -> None:
        """Makes room for `size` cells, and resets the stamps when half of them are used."""
        size = max(size, len(self.keys))
        if size > len(self.keys) or self.stamp[0] > _SEARCHES // 2:
            self.stamp[0] = 0
            # zero is above any key, and zeroed memory costs nothing until it is written
            self.keys, self.origins = np.zeros(size, np.int64), np.zeros(size, self.origins.dtype)


class GridSearch:
    """Finds the cheapest paths. Holds the buffers of the largest grid so far."""

    def __init__(self) -> None:
        self.cells = SearchBuffers(np.int8)
        self.reserve(1 << 12)

    def reserve(self, n: int) -> None:
        """Makes room for n entries of the queue: cells, keys, and next entries of their buckets."""
        self.entries = np.empty(n, np.int32), np.empty(n, np.int64), np.empty(n, np.int32)

    def cheapest_path(
        self, costs: UInt16s, start: tuple[int, int], goal: tuple[int, int], min_cost: int, max_cost: int
    ) -> Int32s:
        """The cheapest path from start to goal, both included: (n, 2) int32 rows and columns, n = 0 without one.

        costs: (h, w) uint16, C-contiguous, 0 blocked, its outermost ring blocked. min_cost, max_cost: bounds of its
        other values. A step costs its length times the mean of its two cells. A diagonal step needs both straight
        neighbours free.
        """
        w, marks = costs.shape[1], self.cells
        flat = costs.reshape(-1)
        start_cell, goal_cell = start[0] * w + start[1], goal[0] * w + goal[1]
        if not (flat[start_cell] and flat[goal_cell]):
            return np.empty((0, 2), np.int32)
        while True:
            marks.begin(flat.size)
            outcome = expand(
                flat,
                w,
                start_cell,
                goal_cell,
                min_cost,
                max_cost,
                marks.stamp,
                marks.keys,
                marks.origins,
                *self.entries,
            )
            if outcome != QUEUE_FULL:
                break
            self.reserve(2 * len(self.entries[0]))
        return traced_path(marks.origins, w, start_cell, goal_cell) if outcome else np.empty((0, 2), np.int32)


@njit(cache=True, nogil=True)
def next_base_key(stamp: Int64s) -> int:
    """The base of the keys of a new search: lower by 1 << COST_BITS than that of the one before.

    stamp: (1,) number of the latest search, which is counted up.
    """
    stamp[0] += 1
    return int(-stamp[0] << COST_BITS)


@njit(cache=True, nogil=True)
def expand(
    costs: UInt16s,
    width: int,
    start: int,
    goal: int,
    min_cost: int,
    max_cost: int,
    stamp: Int64s,
    keys: Int64s,
    parents: Int8s,
    cells: Int32s,
    entry_keys: Int64s,
    links: Int32s,
) -> int:
    """Fills keys (base + cost so far) and parents (direction of arrival) until the goal is settled or no cell is left.

    Returns 1 with a path, 0 without one, or QUEUE_FULL. Exact where no cost is under `min_cost`; a higher bound expands
    fewer cells and gives some path.
    costs: (h * width,) uint16, otherwise as for `GridSearch.cheapest_path`. start, goal: indices of it. stamp, keys,
    parents: of its `SearchBuffers`. cells, entry_keys, links: the entries of the queue, see `bucket_queue`.
    """
    base = next_base_key(stamp)
    offsets = _ROW * width + _COLUMN
    goal_row, goal_column = goal // width, goal % width
    straight_least, diagonal_least = 2 * min_cost * STRAIGHT, 2 * min_cost * DIAGONAL
    slower = diagonal_least - straight_least
    shift = width_bits(straight_least)
    heads = empty_ring((2 * (max_cost + min_cost) * DIAGONAL) >> shift)
    mask = len(heads) - 1
    keys[start] = base
    dr, dc = abs(goal_row - start // width), abs(goal_column - start % width)
    bucket = (straight_least * max(dr, dc) + slower * min(dr, dc)) >> shift
    free, n_used = push_entry(bucket & mask, start, base, -1, 0, heads, cells, entry_keys, links)
    n_open = 1
    open_way = np.zeros(4, np.bool_)
    while n_open:
        while heads[bucket & mask] < 0:
            bucket += 1
        if base + (bucket << shift) >= keys[goal]:
            return 1
        free = pop_entry(bucket & mask, free, heads, links)
        n_open -= 1
        cell, key = cells[free], entry_keys[free]
        if key != keys[cell]:
            continue
        if n_used + 8 > len(cells):
            return QUEUE_FULL
        here = np.int64(costs[cell])
        row, column = cell // width, cell % width
        for direction in range(8):
            there = cell + offsets[direction]
            cost = np.int64(costs[there])
            if direction < 4:
                open_way[direction] = cost != 0
                step = (here + cost) * STRAIGHT
            else:  # between the straight directions of its row step (1 or 3) and its column step (0 or 2)
                if not (open_way[1 if direction < 6 else 3] and open_way[2 * (direction & 1)]):
                    continue
                step = (here + cost) * DIAGONAL
            if cost == 0 or key + step >= keys[there]:
                continue
            keys[there] = key + step
            parents[there] = direction
            dr, dc = abs(goal_row - row - _ROW[direction]), abs(goal_column - column - _COLUMN[direction])
            total = key + step - base + straight_least * max(dr, dc) + slower * min(dr, dc)
            slot = max(total >> shift, bucket) & mask  # not before the present bucket, where `min_cost` is too high
            free, n_used = push_entry(slot, there, key + step, free, n_used, heads, cells, entry_keys, links)
            n_open += 1
    return 1 if keys[goal] >> COST_BITS == base >> COST_BITS else 0


@njit(cache=True, nogil=True)
def width_bits(min_cost: int) -> int:
    """Bits of a cost that lie within one bucket, for steps that cost at least `min_cost`."""
    shift = 0
    while min_cost >> shift > 1:
        shift += 1
    return shift


@njit(cache=True, nogil=True)
def traced_path(parents: Int8s, width: int, start: int, goal: int) -> Int32s:
    """(n, 2) int32 rows and columns of the path that `parents` lead along, from start to goal."""
    offsets = _ROW * width + _COLUMN
    n = 1
    cell = goal
    while cell != start:
        cell -= offsets[parents[cell]]
        n += 1
    path = np.empty((n, 2), np.int32)
    cell = goal
    for i in range(n - 1, -1, -1):
        path[i, 0], path[i, 1] = cell // width, cell % width
        if i:
            cell -= offsets[parents[cell]]
    return path
