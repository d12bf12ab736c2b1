# SPDX-License-Identifier: Apache-2.0
"""The area that a robot's map knows, in coarse cells: how it is sent, and which cells of another map it covers."""

from dataclasses import dataclass

import numpy as np

from shared.geometry import Pose2
from shared.grid import FREE_UP_TO
from shared.messages import TILE_CELLS
from shared.types import Bools, Int8s, Int64s

BLOCK_CELLS = 8  # cells along a side of a coarse one: 0.4 m at 0.05 m a cell; a tile holds whole ones
MIN_KNOWN_RATIO = 0.5  # of its cells, for a coarse one to be known: behind a wall half of them stay unknown
MAX_BLOCKS = 250_000  # of a message


@dataclass(frozen=True, slots=True, eq=False)
class KnownArea:
    """Coarse cells in the map of another robot.

    area_from_map: the own `map` in that robot's map.  cell: m.  known: (h, w) int8, 1 where it knows; its lower left
    cell is (first_row, first_column).
    """

    area_from_map: Pose2
    cell: float
    first_row: int
    first_column: int
    known: Int8s


def known_blocks(cells: Int8s, border: Int64s) -> Int8s:
    """Returns (h / 8, w / 8) int8: 1 where a map knows at least half of the cells, and has no frontier of its own.

    With its frontier it would hide that of a robot that knows no more, and each would leave it to the other.  cells:
    (h, w) percent, -1 unknown, of whole tiles.  border: (n, 2) int64 rows and columns of the frontiers' free cells.
    """
    rows, columns = border.T
    inside = (rows >= 0) & (rows < cells.shape[0]) & (columns >= 0) & (columns < cells.shape[1])
    free_side = np.zeros(cells.shape, np.bool_)
    free_side[rows[inside], columns[inside]] = True
    beyond = dilated(free_side) & ~((cells >= 0) & (cells <= FREE_UP_TO))
    known = _block_sums(cells >= 0) >= MIN_KNOWN_RATIO * BLOCK_CELLS**2
    return np.asarray(known & (_block_sums(beyond) == 0), np.int8)


def _block_sums(cells: Bools) -> Int64s:
    """Returns (h / 8, w / 8) how many cells of each coarse one are true."""
    h, w = (n // BLOCK_CELLS for n in cells.shape)
    whole = cells[: h * BLOCK_CELLS, : w * BLOCK_CELLS]
    return np.asarray(whole.reshape(h, BLOCK_CELLS, w, BLOCK_CELLS).sum(axis=(1, 3)))


def dilated(cells: Bools) -> Bools:
    """The cells, (h, w) bool, and their four neighbours: scipy.ndimage.binary_dilation without scipy's 12 MB."""
    grown = cells.copy()
    grown[1:] |= cells[:-1]
    grown[:-1] |= cells[1:]
    grown[:, 1:] |= cells[:, :-1]
    grown[:, :-1] |= cells[:, 1:]
    return grown


def blocks_per_tile() -> int:
    """Returns the coarse cells along a side of a tile."""
    return TILE_CELLS // BLOCK_CELLS


def known_elsewhere(
    wanted: Bools, first_row: int, first_column: int, resolution: float, areas: tuple[KnownArea, ...]
) -> Bools:
    """Returns (h, w) bool: which of the wanted cells (h, w) lie in the known area of another robot.

    first_row, first_column: of the lower left cell in `map`.  resolution: m a cell.
    """
    elsewhere = np.zeros(wanted.shape, np.bool_)
    rows, columns = np.nonzero(wanted)
    points = np.column_stack(((columns + first_column + 0.5) * resolution, (rows + first_row + 0.5) * resolution))
    for area in areas if len(rows) else ():
        x, y = (area.area_from_map @ points).T
        block_rows = np.floor(y / area.cell).astype(np.int64) - area.first_row
        block_columns = np.floor(x / area.cell).astype(np.int64) - area.first_column
        h, w = area.known.shape
        inside = (block_rows >= 0) & (block_rows < h) & (block_columns >= 0) & (block_columns < w)
        known = np.zeros(len(rows), np.bool_)
        known[inside] = area.known[block_rows[inside], block_columns[inside]] > 0
        elsewhere[rows, columns] |= known
    return elsewhere
