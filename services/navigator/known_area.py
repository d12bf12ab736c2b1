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
    h, w = (n // BLOCK_CELLS for n in cells.shape)
    blocks = (cells[: h * BLOCK_CELLS, : w * BLOCK_CELLS] >= 0).reshape(h, BLOCK_CELLS, w, BLOCK_CELLS)
    known = np.asarray(blocks.mean(axis=(1, 3)) >= MIN_KNOWN_RATIO, np.int8)
    for step in ((0, 1), (1, 0), (0, -1), (-1, 0)):
        rows, columns = (border + step).T
        inside = (rows >= 0) & (rows < h * BLOCK_CELLS) & (columns >= 0) & (columns < w * BLOCK_CELLS)
        rows, columns = rows[inside], columns[inside]
        beyond = (cells[rows, columns] < 0) | (cells[rows, columns] > FREE_UP_TO)
        known[rows[beyond] // BLOCK_CELLS, columns[beyond] // BLOCK_CELLS] = 0
    return known


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
