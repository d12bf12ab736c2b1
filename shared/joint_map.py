# SPDX-License-Identifier: Apache-2.0
"""The map on which a robot plans: its own, and where that is unknown the map of the robots that it explores with."""

from copy import copy

import numpy as np

from shared.grid import UNKNOWN, OccupancyGrid
from shared.messages import MAX_SPAN, TILE_CELLS, MapUpdate
from shared.types import Bools


class JointMap:
    """The own map and that of the others, on tiles of one raster. `grid` is both in one; without others the own one."""

    def __init__(self) -> None:
        self.own, self.others = OccupancyGrid(), OccupancyGrid()
        self.grid = self.own

    def apply(self, update: MapUpdate) -> Bools:
        """Takes tiles of the own map. Returns (h, w) bool: the cells of the new `grid` that changed."""
        changed = self.own.apply(update)
        return changed if self.grid is self.own and self.others.empty else self._join()

    def apply_others(self, update: MapUpdate) -> Bools:
        """Takes tiles of what the others know, in the own `map`. Returns the same."""
        self.others.apply(update)
        return self._join()

    def _join(self) -> Bools:
        before, self.grid = self.grid, joined(self.own, self.others)
        here, there = ((g.first_row, g.first_column, g.cells.shape) for g in (before, self.grid))
        return self.grid.cells != before.cells if here == there else np.ones(self.grid.cells.shape, bool)


def joined(own: OccupancyGrid, others: OccupancyGrid) -> OccupancyGrid:
    """The own map, with the cells of the other one where it is not sure. The own one itself, where they do not fit.

    Both have one resolution, and span no more than MAX_SPAN tiles together.
    """
    if own.empty or others.empty or own.resolution != others.resolution:
        return own
    grids = own, others
    first_row, first_column = min(g.first_row for g in grids), min(g.first_column for g in grids)
    end_row = max(g.first_row + g.cells.shape[0] // TILE_CELLS for g in grids)
    end_column = max(g.first_column + g.cells.shape[1] // TILE_CELLS for g in grids)
    if max(end_row - first_row, end_column - first_column) > MAX_SPAN:
        return own
    both = copy(own)
    both.first_row, both.first_column = first_row, first_column
    both.cells = np.full(
        ((end_row - first_row) * TILE_CELLS, (end_column - first_column) * TILE_CELLS), UNKNOWN, np.int8
    )
    for grid, sure in ((own, own.cells != UNKNOWN), (others, others.cells != UNKNOWN), (own, ~own.unknown)):
        row, column = (grid.first_row - first_row) * TILE_CELLS, (grid.first_column - first_column) * TILE_CELLS
        part = both.cells[row : row + grid.cells.shape[0], column : column + grid.cells.shape[1]]
        np.copyto(part, grid.cells, where=sure)
    return both
