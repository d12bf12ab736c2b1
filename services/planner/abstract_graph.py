# SPDX-License-Identifier: Apache-2.0
"""Abstract graph: connected components per 8x8 block, their crossing cost, and the edges between blocks.

Its nodes are searched by `hierarchical_search` (HPA*: Botea, Mueller and Schaeffer 2004). It follows changed cells.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from shared.types import Int32s, Int64s, UInt8s, UInt16s, UInt32s

BLOCK_CELLS = 8
"""Cells along a block's side."""

MAX_PARTS = 4
"""Maximum of nodes in a block; further parts share the last one."""

SIDE_BITS = 4
"""Bits of `edges` for the parts in one direction, by `ROW_STEP` and `COLUMN_STEP`."""

ROW_STEP = (0, 1, 0, -1, 1, 1, -1, -1)
COLUMN_STEP = (1, 0, -1, 0, 1, -1, 1, -1)
"""Step to the neighbouring block, by direction."""

PART_MASK = (1 << SIDE_BITS) - 1
_SIDES = (1 << 4 * SIDE_BITS) - 1

COLUMN_BITS = 16
"""Bits of a packed cell for its column; its row is in the bits above."""


@dataclass(slots=True, eq=False)
class AbstractGraph:
    """The nodes of a costmap. parts: (h, w) uint8, the part of its block that a cell belongs to, 1 to MAX_PARTS, 0
    blocked.

    Node `(part - 1) * n + block` has, with n = n_rows * n_columns: `representatives`, its cheapest cell, packed, 0
    without cells. `crossing` is the cost of that cell. `edges`, uint32, are bits: the parts that it meets across each
    side, and across each corner over both of its sides.
    """

    n_rows: int
    n_columns: int
    parts: UInt8s
    representatives: Int32s
    crossing: UInt16s
    edges: UInt32s

    @staticmethod
    def of(costs: UInt16s) -> "AbstractGraph":
        """The graph of costs (h, w) uint16, 0 blocked."""
        n_rows, n_columns = -(-costs.shape[0] // BLOCK_CELLS), -(-costs.shape[1] // BLOCK_CELLS)
        n = MAX_PARTS * n_rows * n_columns
        parts, representatives = np.zeros(costs.shape, np.uint8), np.zeros(n, np.int32)
        graph = AbstractGraph(
            n_rows=n_rows,
            n_columns=n_columns,
            parts=parts,
            representatives=representatives,
            crossing=np.zeros(n, np.uint16),
            edges=np.zeros(n, np.uint32),
        )
        graph.update(costs, 0, 0, *costs.shape)
        return graph

    def update(self, costs: UInt16s, r0: int, c0: int, r1: int, c1: int) -> None:
        """Follows costs that changed in rows r0 to r1 - 1 and columns c0 to c1 - 1."""
        low_row, low_column, end_row, end_column = (
            r0 // BLOCK_CELLS,
            c0 // BLOCK_CELLS,
            -(-r1 // BLOCK_CELLS),
            -(-c1 // BLOCK_CELLS),
        )
        _label_blocks(
            costs, (low_row, low_column, end_row, end_column), self.n_rows * self.n_columns, self.n_columns,
            self.parts, self.representatives, self.crossing,
        )  # fmt: skip
        for reach, join in ((1, _connect_sides), (2, _connect_corners)):
            around = (
                max(low_row - reach, 0), max(low_column - reach, 0),
                min(end_row + reach, self.n_rows), min(end_column + reach, self.n_columns),
            )  # fmt: skip
            join(self.parts, around, self.n_rows * self.n_columns, self.n_columns, self.edges)

    def node(self, row: int, column: int) -> int:
        """The node that holds a free cell."""
        part = int(self.parts[row, column])
        return (part - 1) * self.n_rows * self.n_columns + row // BLOCK_CELLS * self.n_columns + column // BLOCK_CELLS


@njit(cache=True, nogil=True)
def packed_cell(row: int, column: int) -> int:
    """A cell as one number: row in the high bits, column in the low ones. 32 bits suffice below 2^15 rows."""
    return (row << COLUMN_BITS) | column


@njit(cache=True, nogil=True)
def _label_blocks(
    costs: UInt16s, window: tuple[int, int, int, int], n: int, n_columns: int,
    parts: UInt8s, representatives: Int32s, crossing: UInt16s,
) -> None:  # fmt: skip
    """Labels the connected parts of the blocks in the window, by straight steps, and finds their representatives."""
    h, w = costs.shape
    cells = np.empty(BLOCK_CELLS * BLOCK_CELLS, np.int64)
    for block_row in range(window[0], window[2]):
        for block_column in range(window[1], window[3]):
            block = block_row * n_columns + block_column
            r0, c0 = block_row * BLOCK_CELLS, block_column * BLOCK_CELLS
            r1, c1 = min(r0 + BLOCK_CELLS, h), min(c0 + BLOCK_CELLS, w)
            parts[r0:r1, c0:c1] = 0
            for i in range(MAX_PARTS):
                representatives[i * n + block] = crossing[i * n + block] = 0
            n_parts = 0
            for row in range(r0, r1):
                for column in range(c0, c1):
                    if costs[row, column] == 0 or parts[row, column]:
                        continue
                    n_parts = min(n_parts + 1, MAX_PARTS)
                    parts[row, column] = n_parts
                    cells[0], done, n_cells = row * w + column, 0, 1
                    while done < n_cells:
                        r, c = cells[done] // w, cells[done] % w
                        done += 1
                        for direction in range(4):
                            nr = r + (0, 1, 0, -1)[direction]
                            nc = c + (1, 0, -1, 0)[direction]
                            if r0 <= nr < r1 and c0 <= nc < c1 and costs[nr, nc] and parts[nr, nc] == 0:
                                parts[nr, nc] = n_parts
                                cells[n_cells] = nr * w + nc
                                n_cells += 1
                    node = (n_parts - 1) * n + block
                    if representatives[node] == 0:
                        best = _representative_cell(costs, cells[:n_cells])
                        representatives[node] = packed_cell(best // w, best % w)
                        crossing[node] = costs[best // w, best % w]


@njit(cache=True, nogil=True)
def _representative_cell(costs: UInt16s, cells: Int64s) -> int:
    """The cheapest of cells (row * w + column); of equal ones the nearest to their mean."""
    w = costs.shape[1]
    row, column = np.mean(cells // w), np.mean(cells % w)
    best, min_cost, min_offset = 0, 1 << 16, np.inf
    for i in range(len(cells)):
        cell = int(cells[i])
        r, c = cell // w, cell % w
        cost = int(np.int64(costs[r, c]))
        away = (r - row) ** 2 + (c - column) ** 2
        if cost < min_cost or (cost == min_cost and away < min_offset):
            best, min_cost, min_offset = cell, cost, away
    return best


@njit(cache=True, nogil=True)
def _connect_sides(parts: UInt8s, window: tuple[int, int, int, int], n: int, n_columns: int, edges: UInt32s) -> None:
    """Connects the parts that meet across the sides of the blocks in the window. Clears the corners."""
    h, w = parts.shape
    for block_row in range(window[0], window[2]):
        for block_column in range(window[1], window[3]):
            block = block_row * n_columns + block_column
            r0, c0 = block_row * BLOCK_CELLS, block_column * BLOCK_CELLS
            r1, c1 = min(r0 + BLOCK_CELLS, h), min(c0 + BLOCK_CELLS, w)
            for i in range(MAX_PARTS):
                edges[i * n + block] = 0
            for row in range(r0, r1):
                if c1 < w:
                    _connect(parts[row, c1 - 1], parts[row, c1], 0, block, n, edges)
                if c0 > 0:
                    _connect(parts[row, c0], parts[row, c0 - 1], 2, block, n, edges)
            for column in range(c0, c1):
                if r1 < h:
                    _connect(parts[r1 - 1, column], parts[r1, column], 1, block, n, edges)
                if r0 > 0:
                    _connect(parts[r0, column], parts[r0 - 1, column], 3, block, n, edges)


@njit(cache=True, nogil=True)
def _connect(here: int, there: int, side: int, block: int, n: int, edges: UInt32s) -> None:
    if here and there:
        edges[(here - 1) * n + block] |= np.uint32(1 << (side * SIDE_BITS + there - 1))


@njit(cache=True, nogil=True)
def _connect_corners(parts: UInt8s, window: tuple[int, int, int, int], n: int, n_columns: int, edges: UInt32s) -> None:
    """Adds the connections across corners for the blocks in the window, from those across the sides."""
    for block_row in range(window[0], window[2]):
        for block_column in range(window[1], window[3]):
            block = block_row * n_columns + block_column
            for i in range(MAX_PARTS):
                edge_bits = int(np.int64(edges[i * n + block]) & _SIDES)
                for direction in range(4, 8):
                    across, along = 2 * (direction & 1), (1 if direction < 6 else 3)
                    bits = _parts_across(edge_bits, edges, n, block, n_columns, across, along)
                    if bits:
                        bits &= _parts_across(edge_bits, edges, n, block, n_columns, along, across)
                    edge_bits |= bits << SIDE_BITS * direction
                edges[i * n + block] = edge_bits


@njit(cache=True, nogil=True)
def _parts_across(edge_bits: int, edges: UInt32s, n: int, block: int, n_columns: int, first: int, then: int) -> int:
    """Parts across the side `then` of the parts that a node meets across the side `first`, as bits."""
    bits = (edge_bits >> SIDE_BITS * first) & PART_MASK
    node = block + ROW_STEP[first] * n_columns + COLUMN_STEP[first]
    across = 0
    while bits:
        if bits & 1:
            across |= int((np.int64(edges[node]) >> SIDE_BITS * then) & PART_MASK)
        bits >>= 1
        node += n
    return across
