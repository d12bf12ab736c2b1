# SPDX-License-Identifier: Apache-2.0
"""The cheapest way over an 8-connected cost grid: A* with a circular bucket queue and buffers that are never cleared.

Costs are integers, so a queue of buckets replaces the heap (Dial 1969; Denardo & Fox 1979). A bucket is wider than the
smallest step; what was expanded too early is expanded again, so the result is exact.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

UInt16s = NDArray[np.uint16]
Int8s = NDArray[np.int8]
Int32s = NDArray[np.int32]
Int64s = NDArray[np.int64]

STRAIGHT, DIAGONAL = 2378, 3363
"""Half a step's length, in integers; 3363 / 2378 is sqrt(2) to 6e-8 (a convergent of its continued fraction)."""

_COST_BITS = 42  # of a key; the bits above number the search, downwards, so that older keys are always larger
_SEARCHES = 2**20
_ROW = np.array([0, 1, 0, -1, 1, 1, -1, -1], np.int64)
_COLUMN = np.array([1, 0, -1, 0, 1, -1, 1, -1], np.int64)


class Search:
    """Finds ways; holds the buffers of the largest grid so far."""

    def __init__(self) -> None:
        self._left = 0
        self._keys: Int64s = np.empty(0, np.int64)
        self._parents: Int8s = np.empty(0, np.int8)
        self._room(1 << 12)

    def way(self, costs: UInt16s, start: tuple[int, int], goal: tuple[int, int], lowest: int, highest: int) -> Int32s:
        """The cheapest way from start to goal, both included: (n, 2) int32 rows and columns, n = 0 without one.

        costs: (h, w) uint16, C-contiguous, 0 blocked, its outermost ring blocked. lowest, highest: bounds of its
        other values. A step costs its length times the mean of its two cells; a diagonal one needs both of its
        straight neighbours free.
        """
        w = costs.shape[1]
        flat = costs.reshape(-1)
        start_cell, goal_cell = start[0] * w + start[1], goal[0] * w + goal[1]
        if not (flat[start_cell] and flat[goal_cell]):
            return np.empty((0, 2), np.int32)
        shift = (2 * lowest * STRAIGHT).bit_length() - 1
        n_buckets = 1 << ((4 * highest * DIAGONAL >> shift) + 4).bit_length()
        heads = np.empty(n_buckets, np.int32)
        while True:
            base = self._begin(flat.size)
            if _expand(
                flat, w, start_cell, goal_cell, lowest, shift, base, self._keys, self._parents, heads, *self._entries
            ):
                break
            self._room(2 * len(self._entries[0]))
        if self._keys[goal_cell] >> _COST_BITS != base >> _COST_BITS:
            return np.empty((0, 2), np.int32)
        return _traced(self._parents, w, start_cell, goal_cell)

    def _begin(self, size: int) -> int:
        """The base of a new search's keys, lower than all that the buffers hold."""
        if size > len(self._keys):
            self._keys, self._parents, self._left = np.empty(size, np.int64), np.empty(size, np.int8), 0
        if self._left == 0:
            self._keys[:] = _SEARCHES << _COST_BITS
            self._left = _SEARCHES
        self._left -= 1
        return self._left << _COST_BITS

    def _room(self, n: int) -> None:
        """Room for n entries of the queue: their cells, their keys, the next entry of their bucket."""
        self._entries = np.empty(n, np.int32), np.empty(n, np.int64), np.empty(n, np.int32)


@njit(cache=True, nogil=True)
def _expand(
    costs: UInt16s,
    width: int,
    start: int,
    goal: int,
    lowest: int,
    shift: int,
    base: int,
    keys: Int64s,
    parents: Int8s,
    heads: Int32s,
    cells: Int32s,
    entry_keys: Int64s,
    links: Int32s,
) -> bool:
    """Fills keys (base + cost so far) and parents (direction of arrival) until the goal is settled or nothing is left.

    False: the entries did not suffice.
    """
    offsets = _ROW * width + _COLUMN
    goal_row, goal_column = goal // width, goal % width
    straight_least, diagonal_least = 2 * lowest * STRAIGHT, 2 * lowest * DIAGONAL
    slower = diagonal_least - straight_least
    mask = len(heads) - 1
    heads[:] = -1
    free, n_used, n_open = -1, 1, 1
    keys[start] = base
    dr, dc = abs(goal_row - start // width), abs(goal_column - start % width)
    bucket = (straight_least * max(dr, dc) + slower * min(dr, dc)) >> shift
    heads[bucket & mask] = 0
    cells[0], entry_keys[0], links[0] = start, base, -1
    open_way = np.zeros(4, np.bool_)
    while n_open:
        while heads[bucket & mask] < 0:
            bucket += 1
        if base + (bucket << shift) >= keys[goal]:
            return True
        entry = heads[bucket & mask]
        heads[bucket & mask] = links[entry]
        cell, key = cells[entry], entry_keys[entry]
        links[entry] = free
        free = entry
        n_open -= 1
        if key != keys[cell]:
            continue
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
            if free >= 0:
                entry = free
                free = links[entry]
            elif n_used < len(cells):
                entry = n_used
                n_used += 1
            else:
                return False
            slot = (total >> shift) & mask
            cells[entry], entry_keys[entry], links[entry] = there, key + step, heads[slot]
            heads[slot] = entry
            n_open += 1
    return True


@njit(cache=True, nogil=True)
def _traced(parents: Int8s, width: int, start: int, goal: int) -> Int32s:
    offsets = _ROW * width + _COLUMN
    n = 1
    cell = goal
    while cell != start:
        cell -= offsets[parents[cell]]
        n += 1
    way = np.empty((n, 2), np.int32)
    cell = goal
    for i in range(n - 1, -1, -1):
        way[i, 0], way[i, 1] = cell // width, cell % width
        if i:
            cell -= offsets[parents[cell]]
    return way
