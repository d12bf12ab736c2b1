# SPDX-License-Identifier: Apache-2.0
"""A rough way over the map's blocks, and that way over cells: what the planner smooths into a path.

A* over nodes of `blocks` (Botea, Mueller & Schaeffer 2004), whose places are joined by straight lines where they see
each other, and by a search over cells where not. It is not the cheapest way, but close to it in all that smoothing
does not mend, and it looks at a sixty-fourth of the cells.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.planner.blocks import BLOCK, PARTS, SIDE_BITS, Blocks
from services.planner.lines import line_cost
from services.planner.regions import Arrays, Regions, region_at
from services.planner.search import COST_BITS, STRAIGHT, Marks, Search, buckets, expand, traced

UInt16s = NDArray[np.uint16]
Int8s = NDArray[np.int8]
Int32s = NDArray[np.int32]
Int64s = NDArray[np.int64]
Float64s = NDArray[np.float64]

_DIAGONAL_MORE = 2**0.5 - 1  # by which a diagonal step is longer than a straight one
_PART_MASK = (1 << SIDE_BITS) - 1
_NO_ROOM = -1  # the queue's entries did not suffice


class Outline(Search):
    """Finds rough ways; holds the buffers for nodes too."""

    def __init__(self) -> None:
        super().__init__()
        self.nodes = Marks(np.int32)

    def points(
        self,
        costs: UInt16s,
        blocks: Blocks,
        regions: Regions,
        start: tuple[int, int],
        goal: tuple[int, int],
        lowest: int,
        highest: int,
    ) -> Float64s:
        """A way from start to goal, cells that hang together: (n, 2) points (x, y) in cells, each in sight of the next.

        As `Search.way`, with the blocks and regions of the costs. A middle is (column + 0.5, row + 0.5).
        """
        w, n_nodes = costs.shape[1], len(blocks.places)
        ends = blocks.node(*start), blocks.node(*goal), start[0] * w + start[1], goal[0] * w + goal[1]
        shift, heads = buckets(BLOCK * lowest, 2 * BLOCK * highest)
        while True:
            base = self.nodes.begin(1, n_nodes)
            n_steps = _expand_nodes(
                w, blocks.n_columns, blocks.places, blocks.crossing, blocks.joins, *ends, lowest, shift, base,
                self.nodes.keys, self.nodes.origins, heads, *self.entries,
            )  # fmt: skip
            if n_steps != _NO_ROOM:
                break
            self.room(2 * len(self.entries[0]))
        shift, heads = buckets(lowest, highest)
        while True:
            base = self.cells.begin(n_steps + 1, costs.size)
            points = _over_cells(
                costs, regions.arrays, blocks.places, self.nodes.origins, *ends, lowest, shift, base,
                self.cells.keys, self.cells.origins, heads, *self.entries,
            )  # fmt: skip
            if len(points):
                return points
            self.room(2 * len(self.entries[0]))


@njit(cache=True, nogil=True)
def _expand_nodes(
    width: int,
    n_columns: int,
    places: Int32s,
    crossing: UInt16s,
    joins: UInt16s,
    start_node: int,
    goal_node: int,
    start: int,
    goal: int,
    lowest: int,
    shift: int,
    base: int,
    keys: Int64s,
    nexts: Int32s,
    heads: Int32s,
    cells: Int32s,
    entry_keys: Int64s,
    links: Int32s,
) -> int:
    """Searches from the goal's node until the start's is settled; `nexts` leads from node to node to the goal.

    Returns how many steps that are, or _NO_ROOM. The arrays are those of `Blocks` and of `search.expand`.
    """
    n = len(places) // PARTS
    start_x, start_y = start % width, start // width
    least = 2 * lowest * STRAIGHT
    mask = len(heads) - 1
    heads[:] = -1
    free, n_used, n_open = -1, 1, 1
    keys[goal_node], nexts[goal_node] = base, goal_node
    bucket = _octile(start_x - goal % width, start_y - goal // width, least) >> shift
    heads[bucket & mask] = 0
    cells[0], entry_keys[0], links[0] = goal_node, base, -1
    while n_open:
        while heads[bucket & mask] < 0:
            bucket += 1
        if base + (bucket << shift) >= keys[start_node]:
            break
        entry = heads[bucket & mask]
        heads[bucket & mask] = links[entry]
        node, key = int(cells[entry]), int(entry_keys[entry])
        links[entry] = free
        free = entry
        n_open -= 1
        if key != keys[node]:
            continue
        place = goal if node == goal_node else int(places[node])
        x, y, here = place % width, place // width, np.int64(crossing[node])
        block, joined = node % n, int(np.int64(joins[node]))
        for direction in range(8):
            if direction < 4:
                bits = (joined >> SIDE_BITS * direction) & _PART_MASK
                there_block = block + _next(direction, n_columns)
            else:  # by both sides of the corner, as a step between cells
                across, along = 2 * (direction & 1), (1 if direction < 6 else 3)
                bits = _beyond(joined, joins, n, block, n_columns, across, along)
                if bits:
                    bits &= _beyond(joined, joins, n, block, n_columns, along, across)
                there_block = block + _next(across, n_columns) + _next(along, n_columns)
            there = there_block
            while bits:
                if bits & 1:
                    place = start if there == start_node else int(places[there])
                    tx, ty = place % width, place // width
                    far = np.sqrt(np.float64((tx - x) * (tx - x) + (ty - y) * (ty - y)))
                    so_far = key + np.int64((here + crossing[there]) * STRAIGHT * far)
                    if so_far < keys[there]:
                        keys[there], nexts[there] = so_far, node
                        total = so_far - base + _octile(tx - start_x, ty - start_y, least)
                        if free >= 0:
                            entry = free
                            free = links[entry]
                        elif n_used < len(cells):
                            entry = n_used
                            n_used += 1
                        else:
                            return _NO_ROOM
                        # places lie unevenly, so the estimate may fall; and no jump is longer than the ring
                        due = max(int(total >> shift), bucket)
                        slot = int(min(due, bucket + mask)) & mask
                        cells[entry], entry_keys[entry], links[entry] = there, so_far, heads[slot]
                        heads[slot] = entry
                        n_open += 1
                bits >>= 1
                there += n
    n_steps = 0
    node = start_node
    while node != goal_node:
        node = int(nexts[node])
        n_steps += 1
    return n_steps


@njit(cache=True, nogil=True)
def _octile(dx: int, dy: int, least: int) -> int:
    dx, dy = abs(dx), abs(dy)
    return int(least * (max(dx, dy) + _DIAGONAL_MORE * min(dx, dy)))


@njit(cache=True, nogil=True)
def _next(side: int, n_columns: int) -> int:
    return (1, n_columns, -1, -n_columns)[side]


@njit(cache=True, nogil=True)
def _beyond(joined: int, joins: UInt16s, n: int, block: int, n_columns: int, first: int, then: int) -> int:
    """Which parts lie across the side `then` of those that a node meets across the side `first`, as bits."""
    bits = (joined >> SIDE_BITS * first) & _PART_MASK
    node = block + _next(first, n_columns)
    found = 0
    while bits:
        if bits & 1:
            found |= (int(np.int64(joins[node])) >> SIDE_BITS * then) & _PART_MASK
        bits >>= 1
        node += n
    return found


@njit(cache=True, nogil=True)
def _over_cells(
    costs: UInt16s,
    regions: Arrays,
    places: Int32s,
    nexts: Int32s,
    start_node: int,
    goal_node: int,
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
) -> Float64s:
    """Points (n, 2), (x, y) in cells, each in sight of the next, along the nodes; n = 0: the entries did not suffice.

    A search over cells takes the next lower `base`.
    """
    width = costs.shape[1]
    flat = costs.reshape(-1)
    points = np.empty((64, 2))
    points[0, 0], points[0, 1] = start % width + 0.5, start // width + 0.5
    n_points = 1
    here, node = start, start_node
    region = region_at(regions, start // width, start % width)
    while here != goal:
        node = int(nexts[node])
        there = goal if node == goal_node else int(places[node])
        # parts that share a node need not hang together: what lies elsewhere is passed over
        if there == here or region_at(regions, there // width, there % width) != region:
            continue
        x, y = there % width + 0.5, there // width + 0.5
        if line_cost(costs, points[n_points - 1, 0], points[n_points - 1, 1], x, y) >= 0:
            if n_points == len(points):
                points = _longer(points, 2 * n_points)
            points[n_points, 0], points[n_points, 1] = x, y
            n_points += 1
        else:
            if not expand(
                flat, width, here, there, lowest, shift, base, keys, parents, heads, cells, entry_keys, links
            ):
                return points[:0]
            base -= 1 << COST_BITS
            way = traced(parents, width, here, there)
            if n_points + len(way) > len(points):
                points = _longer(points, 2 * (n_points + len(way)))
            for i in range(1, len(way)):
                points[n_points, 0], points[n_points, 1] = way[i, 1] + 0.5, way[i, 0] + 0.5
                n_points += 1
        here = there
    return points[:n_points]


@njit(cache=True, nogil=True)
def _longer(points: Float64s, n: int) -> Float64s:
    longer = np.empty((n, 2))
    longer[: len(points)] = points
    return longer
