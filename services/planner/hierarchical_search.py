# SPDX-License-Identifier: Apache-2.0
"""Path search in two levels: A* over the abstract graph, then over the cells between its nodes.

HPA* (Botea, Mueller and Schaeffer 2004). Cells of successive nodes are joined by a straight line where it is free, else
by a search over cells. The path costs slightly more than the cheapest one; smoothing removes most of that. The search
looks at a 64th of the cells.
"""

import numpy as np
from numba import njit

from services.planner.abstract_graph import (
    BLOCK_CELLS,
    COLUMN_BITS,
    COLUMN_STEP,
    MAX_PARTS,
    PART_MASK,
    ROW_STEP,
    SIDE_BITS,
    AbstractGraph,
    packed_cell,
)
from services.planner.bucket_queue import empty_ring, pop_entry, push_entry
from services.planner.connected_components import ComponentArrays, ConnectedComponents, component_at
from services.planner.ray_cost import line_cost
from services.planner.search import (
    DIAGONAL,
    STRAIGHT,
    GridSearch,
    SearchBuffers,
    expand,
    next_base_key,
    traced_path,
    width_bits,
)
from shared.types import Float64s, Int8s, Int32s, Int64s, UInt16s, UInt32s

_DETOUR_WEIGHT = (
    0.4  # extra cost of a step, in the lowest cost, at an offset from the straight line equal to the line's length
)
_MAX_DETOUR_SHARE = 0.15  # offset in lengths of the line beyond which the extra cost stays constant
_COLUMN_MASK = (1 << COLUMN_BITS) - 1


class HierarchicalSearch(GridSearch):
    """Finds rough paths. Holds the buffers for nodes and cells."""

    def __init__(self) -> None:
        super().__init__()
        self.nodes = SearchBuffers(np.int32)

    def rough_path(
        self,
        costs: UInt16s,
        graph: AbstractGraph,
        components: ConnectedComponents,
        start: tuple[int, int],
        goal: tuple[int, int],
        min_cost: int,
        max_cost: int,
    ) -> Float64s:
        """A path between connected cells start and goal: (n, 2) points (x, y) in cells, each visible from the next.

        costs, min_cost, max_cost: as for `GridSearch.cheapest_path`. graph, components: of these costs. The centre of a
        cell is (column + 0.5, row + 0.5).
        """
        nodes, cells = self.nodes, self.cells
        ends = graph.node(*start), graph.node(*goal), packed_cell(*start), packed_cell(*goal)
        while True:
            nodes.begin(len(graph.representatives))
            cells.begin(costs.size)
            points = _rough_path(
                costs, components.arrays, graph.n_columns, graph.representatives, graph.crossing, graph.edges, *ends,
                min_cost, max_cost, nodes.stamp, nodes.keys, nodes.origins, cells.stamp, cells.keys, cells.origins,
                *self.entries,
            )  # fmt: skip
            if len(points):
                return points
            self.reserve(2 * len(self.entries[0]))


@njit(cache=True, nogil=True)
def _rough_path(
    costs: UInt16s, components: ComponentArrays, n_columns: int,
    representatives: Int32s, crossing: UInt16s, edges: UInt32s,
    start_node: int, goal_node: int, start: int, goal: int, min_cost: int, max_cost: int,
    node_stamp: Int64s, node_keys: Int64s, nexts: Int32s, cell_stamp: Int64s, cell_keys: Int64s, parents: Int8s,
    entries: Int32s, entry_keys: Int64s, links: Int32s,
) -> Float64s:  # fmt: skip
    """The points; n = 0 where the queue was full."""
    if not _expand_nodes(
        n_columns, representatives, crossing, edges, start_node, goal_node, start, goal, min_cost, max_cost,
        node_stamp, node_keys, nexts, entries, entry_keys, links,
    ):  # fmt: skip
        return np.empty((0, 2))
    return _refine_over_cells(
        costs, components, representatives, nexts, start_node, goal_node, start, goal, min_cost, max_cost,
        cell_stamp, cell_keys, parents, entries, entry_keys, links,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _expand_nodes(
    n_columns: int,
    representatives: Int32s,
    crossing: UInt16s,
    edges: UInt32s,
    start_node: int,
    goal_node: int,
    start: int,
    goal: int,
    min_cost: int,
    max_cost: int,
    stamp: Int64s,
    keys: Int64s,
    nexts: Int32s,
    nodes: Int32s,
    entry_keys: Int64s,
    links: Int32s,
) -> bool:
    """Searches from the goal's node until the start's is settled; `nexts` leads from node to node to the goal.

    Returns False where the queue was full. The arrays are those of `AbstractGraph` and of `search.expand`.
    """
    base = next_base_key(stamp)
    n = len(representatives) // MAX_PARTS
    start_x, start_y = start & _COLUMN_MASK, start >> COLUMN_BITS
    min_cell_cost = 2 * min_cost * STRAIGHT
    # far less than a step to the next block, as many paths cost almost the same
    shift = width_bits(min_cost * STRAIGHT)
    heads = empty_ring((8 * BLOCK_CELLS * max_cost * DIAGONAL) >> shift)
    mask = len(heads) - 1
    line_x, line_y = start_x - (goal & _COLUMN_MASK), start_y - (goal >> COLUMN_BITS)
    per_offset = _DETOUR_WEIGHT * 2 * min_cost / max(line_x * line_x + line_y * line_y, 1)
    max_offset_cost = _DETOUR_WEIGHT * 2 * min_cost * _MAX_DETOUR_SHARE
    keys[goal_node], nexts[goal_node] = base, goal_node
    bucket = _min_line_cost(start_x - (goal & _COLUMN_MASK), start_y - (goal >> COLUMN_BITS), min_cell_cost) >> shift
    free, n_used = push_entry(bucket & mask, goal_node, base, -1, 0, heads, nodes, entry_keys, links)
    n_open = 1
    while n_open:
        while heads[bucket & mask] < 0:
            bucket += 1
        if base + (bucket << shift) >= keys[start_node]:
            break
        free = pop_entry(bucket & mask, free, heads, links)
        n_open -= 1
        node, key = int(nodes[free]), int(entry_keys[free])
        if key != keys[node]:
            continue
        if n_used + 8 * MAX_PARTS > len(nodes):
            return False
        place = goal if node == goal_node else int(representatives[node])
        x, y, here = place & _COLUMN_MASK, place >> COLUMN_BITS, np.int64(crossing[node])
        block, edge_bits = node % n, np.int64(edges[node])
        for direction in range(8):
            bits = (edge_bits >> SIDE_BITS * direction) & PART_MASK
            there = block + ROW_STEP[direction] * n_columns + COLUMN_STEP[direction]
            while bits:
                if bits & 1 and keys[there] > key:
                    place = start if there == start_node else int(representatives[there])
                    tx, ty = place & _COLUMN_MASK, place >> COLUMN_BITS
                    far = np.sqrt(np.float64((tx - x) * (tx - x) + (ty - y) * (ty - y)))
                    offset_cost = min(
                        abs((tx - start_x) * line_y - (ty - start_y) * line_x) * per_offset, max_offset_cost
                    )
                    so_far = key + np.int64((here + crossing[there] + offset_cost) * STRAIGHT * far)
                    if so_far < keys[there]:
                        keys[there], nexts[there] = so_far, node
                        total = so_far - base + _min_line_cost(tx - start_x, ty - start_y, min_cell_cost)
                        # the estimate may fall between uneven cells; the ring bounds how far ahead an entry lies
                        due = min(max(int(total >> shift), bucket), bucket + mask)
                        free, n_used = push_entry(
                            due & mask, there, int(so_far), free, n_used, heads, nodes, entry_keys, links
                        )
                        n_open += 1
                bits >>= 1
                there += n
    return True


@njit(cache=True, nogil=True)
def _min_line_cost(dx: int, dy: int, min_cell_cost: int) -> int:
    """Lower bound of the cost over (dx, dy) cells: the Euclidean one.

    Octile distance would exceed the cost between cells that lie unevenly. Then nodes of a large map would be opened
    many times.
    """
    return int(min_cell_cost * np.sqrt(np.float64(dx * dx + dy * dy)))


@njit(cache=True, nogil=True)
def _refine_over_cells(
    costs: UInt16s,
    components: ComponentArrays,
    representatives: Int32s,
    nexts: Int32s,
    start_node: int,
    goal_node: int,
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
) -> Float64s:
    """Points (n, 2), (x, y) in cells, each visible from the next, along the nodes; n = 0 where the queue was full."""
    width = costs.shape[1]
    flat = costs.reshape(-1)
    points = np.empty((64, 2))
    row, column = start >> COLUMN_BITS, start & _COLUMN_MASK
    points[0, 0], points[0, 1] = column + 0.5, row + 0.5
    n_points = 1
    here, node = start, start_node
    region = component_at(components, row, column)
    while here != goal:
        node = int(nexts[node])
        there = goal if node == goal_node else int(representatives[node])
        row, column = there >> COLUMN_BITS, there & _COLUMN_MASK
        # parts that share a node may belong to another component: these nodes are skipped
        if there == here or component_at(components, row, column) != region:
            continue
        x, y = column + 0.5, row + 0.5
        if line_cost(costs, points[n_points - 1, 0], points[n_points - 1, 1], x, y, np.inf) >= 0:
            if n_points == len(points):
                points = _grown(points, 2 * n_points)
            points[n_points, 0], points[n_points, 1] = x, y
            n_points += 1
        else:
            if there != goal:  # to the next node but one: fewer detours over representatives
                node = int(nexts[node])
                further = goal if node == goal_node else int(representatives[node])
                if component_at(components, further >> COLUMN_BITS, further & _COLUMN_MASK) == region:
                    there = further
            row, column = there >> COLUMN_BITS, there & _COLUMN_MASK
            first = (here >> COLUMN_BITS) * width + (here & _COLUMN_MASK)
            last = row * width + column
            min_end_cost = int(min(np.int64(flat[first]), np.int64(flat[last])))  # cells between are hardly cheaper
            if (
                expand(flat, width, first, last, min_end_cost, max_cost, stamp, keys, parents, cells, entry_keys, links)
                < 0
            ):
                return points[:0]
            cells_between = traced_path(parents, width, first, last)
            if n_points + len(cells_between) > len(points):
                points = _grown(points, 2 * (n_points + len(cells_between)))
            for i in range(1, len(cells_between)):
                points[n_points, 0], points[n_points, 1] = cells_between[i, 1] + 0.5, cells_between[i, 0] + 0.5
                n_points += 1
        here = there
    return points[:n_points]


@njit(cache=True, nogil=True)
def _grown(points: Float64s, n: int) -> Float64s:
    longer = np.empty((n, 2))
    longer[: len(points)] = points
    return longer
