# SPDX-License-Identifier: Apache-2.0
"""Maps for tests: from text or arrays to grids and to the message that the mapper would send."""

import os
from pathlib import Path

import numpy as np
import pytest

from shared.grid import OccupancyGrid
from shared.messages import TILE_CELLS, MapUpdate
from shared.types import Int8s

LETTERS = {".": 0, "#": 100, "?": -1}


def drawn(text: str, cells_per_letter: int = 1) -> Int8s:
    """(h, w) int8 from lines of `.` free, `#` occupied, `?` unknown; the last line is row 0."""
    rows = [line.strip() for line in text.strip().splitlines()][::-1]
    cells = np.array([[LETTERS[letter] for letter in row] for row in rows], np.int8)
    return np.kron(cells, np.ones((cells_per_letter, cells_per_letter), np.int8))


def room(height: float, width: float, resolution: float = 0.05) -> Int8s:
    """A free rectangle (m) inside a wall of two cells, its lower left inner corner at (2, 2) cells."""
    cells = np.zeros((round(height / resolution) + 4, round(width / resolution) + 4), np.int8)
    cells[:2] = cells[-2:] = 100
    cells[:, :2] = cells[:, -2:] = 100
    return cells


def boxes(rng: np.random.Generator, n: int) -> Int8s:
    """A room of 4 x 6 m with n boxes of 20 cm anywhere in it."""
    cells = room(4, 6)
    for row, column in rng.integers(4, (76, 116), (n, 2)):
        cells[row : row + 4, column : column + 4] = 100
    return cells


def message(
    cells: Int8s, resolution: float = 0.05, version: int = 1, map_id: int = 1, since: Int8s | None = None
) -> MapUpdate:
    """The update that carries cells, lower left cell at the origin of `map`; since: only tiles that differ from it."""
    h, w = -(-cells.shape[0] // TILE_CELLS), -(-cells.shape[1] // TILE_CELLS)
    padded, before = np.full((2, h * TILE_CELLS, w * TILE_CELLS), -1, np.int8)
    padded[: cells.shape[0], : cells.shape[1]] = cells
    tiles = _tiles(padded, h, w)
    chosen = np.arange(h * w)
    if since is not None:
        before[: since.shape[0], : since.shape[1]] = since
        chosen = np.flatnonzero((tiles != _tiles(before, h, w)).any(axis=1))
    rows, columns = np.divmod(chosen, w)
    update = MapUpdate(
        0, map_id, version, resolution, rows.astype(np.int32), columns.astype(np.int32), tiles[chosen].copy()
    )
    for array in (update.rows, update.columns, update.cells):
        array.setflags(write=False)
    return update


def grid_of(cells: Int8s, resolution: float = 0.05) -> OccupancyGrid:
    """The grid that holds cells."""
    grid = OccupancyGrid()
    grid.apply(message(cells, resolution))
    return grid


def planning_data() -> Path:
    """The folder of benchmark maps; skips the test where there is none."""
    root = os.environ.get("ZENAV_DATA")  # noqa: TID251  # tests find data by it
    if not root or not (Path(root) / "planning").is_dir():
        pytest.skip("ZENAV_DATA does not name a folder with planning/")
    return Path(root) / "planning"


def _tiles(cells: Int8s, h: int, w: int) -> Int8s:
    return cells.reshape(h, TILE_CELLS, w, TILE_CELLS).swapaxes(1, 2).reshape(h * w, TILE_CELLS * TILE_CELLS)
