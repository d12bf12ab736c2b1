# SPDX-License-Identifier: Apache-2.0
"""Which cells can be reached from each other: connected components of tiles, joined across the edges by union-find.

After a change only its tiles are labelled again, and all edges are joined again. Parts are joined as equivalent labels
in Rosenfeld and Pfaltz, "Sequential operations in digital picture processing", 1966; union-find with path halving:
Tarjan and van Leeuwen 1984. The tiles, each with a flood fill of its own, are our own.
"""

import numpy as np
from numba import njit

from shared.types import Int32s, UInt16s

ComponentArrays = tuple[UInt16s, int, Int32s, Int32s]

TILE = 64
"""Cells along a tile's side; its parts then fit 16 bits."""


class ConnectedComponents:
    """Components of costs (h, w) uint16, 0 blocked, numbered from 1 in the order of their first tiles and cells.

    A diagonal step needs both straight neighbours free, so straight steps decide what is connected.
    """

    def __init__(self, costs: UInt16s) -> None:
        self._n_columns = -(-costs.shape[1] // TILE)
        n = -(-costs.shape[0] // TILE) * self._n_columns
        self._labels = np.zeros(costs.shape, np.uint16)  # of its tile, from 1; 0 blocked
        self._edges = np.zeros((2, self._n_columns, costs.shape[0]), np.uint16)  # first, last column of each tile's
        self._counts = np.zeros(n, np.int32)  # of a tile's parts
        self._firsts = np.zeros(n, np.int32)  # place of a tile's first part in `_components`
        self._components = np.zeros(0, np.int32)
        self.update(costs, 0, 0, *costs.shape)

    def update(self, costs: UInt16s, r0: int, c0: int, r1: int, c1: int) -> None:
        """Follows costs that changed in rows r0 to r1 - 1 and columns c0 to c1 - 1."""
        window = r0 // TILE, c0 // TILE, -(-r1 // TILE), -(-c1 // TILE)
        _label_tiles(costs, window, self._n_columns, self._labels, self._edges, self._counts)
        np.cumsum(self._counts[:-1], out=self._firsts[1:])
        self._components = _merge_tiles(
            self._labels, self._edges, self._n_columns, self._firsts, int(self._counts.sum())
        )

    @property
    def arrays(self) -> ComponentArrays:
        """The arrays that `component_at` reads."""
        return self._labels, self._n_columns, self._firsts, self._components

    def at(self, row: int, column: int) -> int:
        """Component of a cell, 0 where it is blocked."""
        part = int(self._labels[row, column])
        first = int(self._firsts[row // TILE * self._n_columns + column // TILE])
        return int(self._components[first + part - 1]) if part else 0

    def labels_in(self, r0: int, c0: int, r1: int, c1: int) -> Int32s:
        """(r1 - r0, c1 - c0) int32: components in a window, 0 blocked."""
        return _labels_in(self.arrays, r0, c0, r1, c1)


@njit(cache=True, nogil=True)
def component_at(arrays: ComponentArrays, row: int, column: int) -> int:
    """Component of a cell, 0 where it is blocked."""
    labels, n_columns, firsts, components = arrays
    part = labels[row, column]
    if part == 0:
        return 0
    return int(components[firsts[row // TILE * n_columns + column // TILE] + part - 1])


@njit(cache=True, nogil=True)
def _label_tiles(
    costs: UInt16s, window: tuple[int, int, int, int], n_columns: int, labels: UInt16s, edges: UInt16s, counts: Int32s
) -> None:
    """Labels the connected parts of each tile in the window, by straight steps."""
    h, w = costs.shape
    stack = np.empty(TILE * TILE, np.int64)
    for tile_row in range(window[0], window[2]):
        for tile_column in range(window[1], window[3]):
            r0, c0 = tile_row * TILE, tile_column * TILE
            r1, c1 = min(r0 + TILE, h), min(c0 + TILE, w)
            labels[r0:r1, c0:c1] = 0
            n_labels = 0
            for row in range(r0, r1):
                for column in range(c0, c1):
                    if costs[row, column] == 0 or labels[row, column]:
                        continue
                    n_labels += 1
                    labels[row, column] = n_labels
                    stack[0], depth = row * w + column, 1
                    while depth:
                        depth -= 1
                        r, c = stack[depth] // w, stack[depth] % w
                        for direction in range(4):
                            nr = r + (0, 1, 0, -1)[direction]
                            nc = c + (1, 0, -1, 0)[direction]
                            if r0 <= nr < r1 and c0 <= nc < c1 and costs[nr, nc] and labels[nr, nc] == 0:
                                labels[nr, nc] = n_labels
                                stack[depth] = nr * w + nc
                                depth += 1
            counts[tile_row * n_columns + tile_column] = n_labels
            edges[0, tile_column, r0:r1], edges[1, tile_column, r0:r1] = labels[r0:r1, c0], labels[r0:r1, c1 - 1]


@njit(cache=True, nogil=True)
def _merge_tiles(labels: UInt16s, edges: UInt16s, n_columns: int, firsts: Int32s, n: int) -> Int32s:
    """(n,) int32: component of each of the n parts of all tiles."""
    h, w = labels.shape
    roots = np.arange(n, dtype=np.int32)
    for row in range(TILE, h, TILE):
        for column in range(0, w, TILE):
            tile, end = row // TILE * n_columns + column // TILE, min(column + TILE, w)
            _union_edge(
                labels[row, column:end], labels[row - 1, column:end], firsts[tile], firsts[tile - n_columns], roots
            )
    for column in range(1, n_columns):
        for row in range(0, h, TILE):
            tile, end = row // TILE * n_columns + column, min(row + TILE, h)
            _union_edge(edges[0, column, row:end], edges[1, column - 1, row:end], firsts[tile], firsts[tile - 1], roots)
    components = np.zeros(n, np.int32)
    n_labels = 0
    for i in range(n):  # a root is the lowest of its kind, so it comes first
        root = _root(roots, i)
        if root == i:
            n_labels += 1
            components[i] = n_labels
        else:
            components[i] = components[root]
    return components


@njit(cache=True, nogil=True)
def _union_edge(here: UInt16s, there: UInt16s, first_here: int, first_there: int, roots: Int32s) -> None:
    """Unites the parts that meet across the edge of two tiles."""
    last_here, last_there = 0, 0
    for a, b in zip(here, there):
        if a and b and (a != last_here or b != last_there):
            last_here, last_there = a, b
            _union(roots, first_here + a - 1, first_there + b - 1)


@njit(cache=True, nogil=True)
def _root(roots: Int32s, i: int) -> int:
    while roots[i] != i:
        roots[i] = roots[roots[i]]
        i = roots[i]
    return i


@njit(cache=True, nogil=True)
def _union(roots: Int32s, a: int, b: int) -> None:
    a, b = _root(roots, a), _root(roots, b)
    if a < b:
        roots[b] = a
    else:
        roots[a] = b


@njit(cache=True, nogil=True)
def _labels_in(arrays: ComponentArrays, r0: int, c0: int, r1: int, c1: int) -> Int32s:
    out = np.zeros((max(r1 - r0, 0), max(c1 - c0, 0)), np.int32)
    for row in range(r0, r1):
        for column in range(c0, c1):
            out[row - r0, column - c0] = component_at(arrays, row, column)
    return out
