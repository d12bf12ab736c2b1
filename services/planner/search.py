# SPDX-License-Identifier: Apache-2.0
"""The cheapest way over an 8-connected cost grid: A* with a circular bucket queue and buffers that are never cleared.

Costs are integers, so a queue of buckets replaces the heap (Dial 1969; Denardo & Fox 1979). A bucket is wider than the
smallest step; what was expanded too early is expanded again, so the result is exact.
"""

from typing import Generic, TypeVar

import numpy as np
from numba import njit
from numpy.typing import NDArray

UInt16s = NDArray[np.uint16]
Int8s = NDArray[np.int8]
Int32s = NDArray[np.int32]
Int64s = NDArray[np.int64]
Origin = TypeVar("Origin", np.int8, np.int32)

STRAIGHT, DIAGONAL = 2378, 3363
"""Half a step's length, in integers; 3363 / 2378 is sqrt(2) to 6e-8 (a convergent of its continued fraction)."""

COST_BITS = 42
"""Of a key: the cost so far. The bits above number the search, downwards, so that keys of older ones are larger."""

_SEARCHES = 2**21 - 1  # so many stamps there are
_ROW = np.array([0, 1, 0, -1, 1, 1, -1, -1], np.int64)
_COLUMN = np.array([1, 0, -1, 0, 1, -1, 1, -1], np.int64)


class Marks(Generic[Origin]):
    """What searches know of the cells or nodes of a grid: `keys`, stamp and cost so far; `origins`, whence.

    Never cleared: a new search has a lower stamp than all before, and so finds every key too high.
    """

    def __init__(self, origins: type[Origin]) -> None:
        self._begun = 0
        self.keys: Int64s = np.zeros(0, np.int64)
        self.origins: NDArray[Origin] = np.zeros(0, origins)

    def begin(self, n: int, size: int) -> int:
        """The base of the keys of the first of n searches over size cells; each next one lies 1 << COST_BITS lower."""
        size = max(size, len(self.keys))
        if size > len(self.keys) or self._begun + n > _SEARCHES:
            self._begun = 0
            # zero is more than any key, and memory that nobody has written to costs nothing
            self.keys, self.origins = np.zeros(size, np.int64), np.zeros(size, self.origins.dtype)
        first = self._begun + 1
        self._begun += n
        return -first << COST_BITS


class Search:
    """Finds ways; holds the buffers of the largest grid so far."""

    def __init__(self) -> None:
        self.cells = Marks(np.int8)
        self.room(1 << 12)

    def room(self, n: int) -> None:
        """Makes room for n entries of the queue: their cells, their keys, the next entry of their bucket."""
        self.entries = np.empty(n, np.int32), np.empty(n, np.int64), np.empty(n, np.int32)

    def way(self, costs: UInt16s, start: tuple[int, int], goal: tuple[int, int], lowest: int, highest: int) -> Int32s:
        """The cheapest way from start to goal, both included: (n, 2) int32 rows and columns, n = 0 without one.

        costs: (h, w) uint16, C-contiguous, 0 blocked, its outermost ring blocked. lowest, highest: bounds of its
        other values. A step costs its length times the mean of its two cells; a diagonal one needs both of its
        straight neighbours free.
        """
        w, marks = costs.shape[1], self.cells
        flat = costs.reshape(-1)
        start_cell, goal_cell = start[0] * w + start[1], goal[0] * w + goal[1]
        if not (flat[start_cell] and flat[goal_cell]):
            return np.empty((0, 2), np.int32)
        shift, heads = buckets(lowest, highest)
        while True:
            base = marks.begin(1, flat.size)
            if expand(
                flat, w, start_cell, goal_cell, lowest, shift, base, marks.keys, marks.origins, heads, *self.entries
            ):
                break
            self.room(2 * len(self.entries[0]))
        if marks.keys[goal_cell] >> COST_BITS != base >> COST_BITS:
            return np.empty((0, 2), np.int32)
        return traced(marks.origins, w, start_cell, goal_cell)


def buckets(lowest: int, highest: int) -> tuple[int, Int32s]:
    """Bits of a cost that lie within a bucket, and the buckets' first entries, for steps between cells."""
    shift = (2 * lowest * STRAIGHT).bit_length() - 1
    return shift, np.empty(1 << ((4 * highest * DIAGONAL >> shift) + 4).bit_length(), np.int32)


@njit(cache=True, nogil=True)
def expand(
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
def traced(parents: Int8s, width: int, start: int, goal: int) -> Int32s:
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
