# SPDX-License-Identifier: Apache-2.0
"""Dense occupancy grid that grows by whole tiles. Row 0 has the lowest y."""

from math import floor

import numpy as np

from shared.messages import TILE_CELLS, MapUpdate, fitting
from shared.types import Bools, Float64s, Int8s, Int32s, Int64s

UNKNOWN = -1
OCCUPIED_FROM = 65  # percent: ROS map_server's occupied_thresh 0.65
UNCERTAIN = 50  # percent, of a coarse cell that is neither free nor occupied
FREE_UP_TO = 25  # percent: ROS map_server's free_thresh 0.25


class OccupancyGrid:
    """Cells in percent (int8, -1 unknown) over a rectangle of whole tiles that grows as tiles come.

    `cells[row, column]` is the square whose lower left corner is `(x0 + column * resolution, y0 + row * resolution)` in
    `map`, m. `cells` is replaced, never written in place, when an update comes: a reference is a snapshot.
    """

    def __init__(self, resolution: float = 0.05, map_id: int = 0) -> None:
        self.resolution = resolution
        self.map_id = map_id
        self.version = 0
        self.first_row = self.first_column = 0  # of the lower left tile, in tiles
        self.cells: Int8s = np.full((0, 0), UNKNOWN, np.int8)

    @property
    def x0(self) -> float:
        """m in `map`, lower left corner of the first cell."""
        return self.first_column * TILE_CELLS * self.resolution

    @property
    def y0(self) -> float:
        """m in `map`, lower left corner of the first cell."""
        return self.first_row * TILE_CELLS * self.resolution

    @property
    def empty(self) -> bool:
        return self.cells.size == 0

    def apply(self, update: MapUpdate) -> Bools:
        """Copies the update's tiles. Returns (h, w) bool: the cells of the new `cells` that changed.

        An update with another map_id or resolution starts a new map. Tiles that would make the map span more than
        MAX_SPAN tiles are left out.
        """
        if update.map_id != self.map_id or update.resolution != self.resolution:
            self.__init__(update.resolution, update.map_id)  # type: ignore[misc]  # a new map: nothing of the old one stays
        self.version = update.version
        fit = self._fitting(update)
        rows, columns = update.rows[fit], update.columns[fit]
        if not len(rows):
            return np.zeros(self.cells.shape, bool)
        before = self.cells
        cells = self._grown(rows, columns)
        if cells is before:
            cells = cells.copy()
        changed = np.zeros(cells.shape, bool)
        for row, column, tile in zip(rows, columns, update.cells[fit], strict=True):
            r, c = (row - self.first_row) * TILE_CELLS, (column - self.first_column) * TILE_CELLS
            place = slice(r, r + TILE_CELLS), slice(c, c + TILE_CELLS)
            changed[place] |= cells[place] != tile.reshape(TILE_CELLS, TILE_CELLS)
            cells[place] = tile.reshape(TILE_CELLS, TILE_CELLS)
        self.cells = cells
        return changed

    def _fitting(self, update: MapUpdate) -> Bools:
        """(k,) bool: the update's tiles within MAX_SPAN of this map."""
        if self.empty:
            return np.ones(len(update.rows), bool)
        h, w = self.cells.shape[0] // TILE_CELLS, self.cells.shape[1] // TILE_CELLS
        return fitting(update.rows, self.first_row, self.first_row + h - 1) & fitting(
            update.columns, self.first_column, self.first_column + w - 1
        )

    def _grown(self, rows: Int32s, columns: Int32s) -> Int8s:
        """The cells on a rectangle that holds the present tiles and those at rows, columns (k,), k >= 1."""
        h, w = self.cells.shape[0] // TILE_CELLS, self.cells.shape[1] // TILE_CELLS
        low_row, low_column = int(rows.min()), int(columns.min())
        high_row, high_column = int(rows.max()) + 1, int(columns.max()) + 1
        if h and w:
            low_row, low_column = min(low_row, self.first_row), min(low_column, self.first_column)
            high_row, high_column = max(high_row, self.first_row + h), max(high_column, self.first_column + w)
        shape = (high_row - low_row) * TILE_CELLS, (high_column - low_column) * TILE_CELLS
        if shape == self.cells.shape:
            return self.cells
        grown = np.full(shape, UNKNOWN, np.int8)
        if h and w:
            r, c = (self.first_row - low_row) * TILE_CELLS, (self.first_column - low_column) * TILE_CELLS
            grown[r : r + h * TILE_CELLS, c : c + w * TILE_CELLS] = self.cells
        self.first_row, self.first_column = low_row, low_column
        return grown

    def update_of(self, changed: Bools, stamp: int) -> MapUpdate:
        """Message with every tile that has a cell of `changed` (h, w) bool set. stamp: ns."""
        h, w = self.cells.shape[0] // TILE_CELLS, self.cells.shape[1] // TILE_CELLS
        blocks = changed.reshape(h, TILE_CELLS, w, TILE_CELLS).any(axis=(1, 3))
        rows, columns = np.nonzero(blocks)
        tiles = self.cells.reshape(h, TILE_CELLS, w, TILE_CELLS).swapaxes(1, 2)[rows, columns]
        return MapUpdate(
            stamp=stamp,
            map_id=self.map_id,
            version=self.version,
            resolution=self.resolution,
            rows=(rows + self.first_row).astype(np.int32),
            columns=(columns + self.first_column).astype(np.int32),
            cells=np.ascontiguousarray(tiles.reshape(len(rows), TILE_CELLS * TILE_CELLS)),
        )

    def cell(self, x: float, y: float) -> tuple[int, int]:
        """(row, column) of the cell that holds a point (x, y) m in `map`; may lie outside the grid."""
        return floor((y - self.y0) / self.resolution), floor((x - self.x0) / self.resolution)

    def cells_of(self, points: Float64s) -> Int64s:
        """(n, 2) int64 rows and columns of points (n, 2) m in `map`; may lie outside the grid."""
        indices = np.floor((points - (self.x0, self.y0)) / self.resolution).astype(np.int64)
        return indices[:, ::-1]

    def centre(self, row: int, column: int) -> tuple[float, float]:
        """(x, y) m in `map` of a cell's centre."""
        return self.x0 + (column + 0.5) * self.resolution, self.y0 + (row + 0.5) * self.resolution

    def holds(self, row: int, column: int) -> bool:
        return bool(0 <= row < self.cells.shape[0] and 0 <= column < self.cells.shape[1])

    @property
    def occupied(self) -> Bools:
        """(h, w) bool."""
        return np.asarray(self.cells >= OCCUPIED_FROM)

    @property
    def free(self) -> Bools:
        """(h, w) bool."""
        return np.asarray((self.cells >= 0) & (self.cells <= FREE_UP_TO))

    @property
    def unknown(self) -> Bools:
        """(h, w) bool: cells with too few observations."""
        return np.asarray(~(self.occupied | self.free))


def update_of_cells(cells: Int8s, resolution: float, x0: float, y0: float, stamp: int = 0) -> MapUpdate:
    """Message with cells (h, w) int8 percent, row 0 lowest, whose lower left corner lies at (x0, y0) m in `map`.

    resolution: m a cell. stamp: ns. The corner is moved by up to half a cell onto the tiles' cells.
    """
    row, column = round(y0 / resolution), round(x0 / resolution)
    first_row, first_column = row // TILE_CELLS, column // TILE_CELLS
    top, right = row - first_row * TILE_CELLS, column - first_column * TILE_CELLS
    h, w = -(-(top + cells.shape[0]) // TILE_CELLS), -(-(right + cells.shape[1]) // TILE_CELLS)
    whole = np.full((h * TILE_CELLS, w * TILE_CELLS), -1, np.int8)
    whole[top : top + cells.shape[0], right : right + cells.shape[1]] = cells
    tiles = whole.reshape(h, TILE_CELLS, w, TILE_CELLS).swapaxes(1, 2).reshape(h * w, TILE_CELLS * TILE_CELLS)
    rows, columns = np.divmod(np.arange(h * w, dtype=np.int32), np.int32(w))
    seen = (tiles >= 0).any(axis=1)
    return MapUpdate(
        stamp=stamp, map_id=0, version=1, resolution=resolution, rows=(rows + first_row)[seen].astype(np.int32),
        columns=(columns + first_column)[seen].astype(np.int32), cells=np.ascontiguousarray(tiles[seen]),
    )  # fmt: skip


def coarse_levels(cells: Int8s, factor: int) -> Int8s:
    """(h/factor, w/factor) int8 of cells (h, w): the most occupied of each square, as -1, 0, 50 or 100 percent.

    A square with an obstacle is occupied, however small that is.
    """
    h, w = cells.shape
    most = cells.reshape(h // factor, factor, w // factor, factor).max(axis=(1, 3))
    levels = np.full(most.shape, UNCERTAIN, np.int8)
    levels[most <= FREE_UP_TO] = 0
    levels[most < 0] = UNKNOWN
    levels[most >= OCCUPIED_FROM] = 100
    return levels
