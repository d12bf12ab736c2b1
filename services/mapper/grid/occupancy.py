# SPDX-License-Identifier: Apache-2.0
"""The occupancy grid: log odds in tiles. Beams lower the cells that they cross and raise the cell that they hit.

The inverse sensor model is that of Moravec and Elfes (ICRA 1985), in log odds (Thrun et al., "Probabilistic Robotics",
2005, table 4.2). The log odds are bounded, so that the grid follows changes.
"""

from math import floor, log
from typing import ClassVar

import numpy as np
from numba import njit
from pydantic import Field

from services.mapper.grid.edit_cells import ERASED, WALL, EditMasks, edited_cells, shown_masks
from services.mapper.grid.ray_casting import cast_rays, drawable_beams, pull_back_hits
from shared.config import Section
from shared.grid import FREE_UP_TO, OCCUPIED_FROM
from shared.messages import TILE_CELLS, MapUpdate
from shared.types import Bools, Float32s, Float64s, Int8s, Int32s, UInt8s

TILE_ARRAYS = ("log_odds", "observed", "modified", "cells", "unpublished")
"""The arrays of `Occupancy` with a row for each tile."""

MAX_UPDATE = 500  # tiles, 2 MB of cells: a message may have 4 MiB


class OccupancyConfig(Section):
    """The occupancy grid."""

    resolution: float = Field(0.05, ge=0.005, le=1, description="m a cell")
    hit: float = Field(0.64, gt=0.5, lt=1, description="probability of a cell in which a beam ended once")
    miss: float = Field(0.39, gt=0, lt=0.5, description="probability of a cell that a beam crossed once")
    hit_depth: float = Field(
        0.1, ge=0, le=1, description="m behind an occupied cell within which the end of a beam is a hit of that cell"
    )
    max_probability: float = Field(0.96, gt=0.5, lt=1, description="upper bound of the probability of a cell")
    min_probability: float = Field(0.06, gt=0, lt=0.5, description="lower bound of the probability of a cell")
    range_max: float = Field(40.0, gt=0, le=250, description="m; farther echoes are not drawn")
    no_echo_free: float = Field(
        0.0, ge=0, le=1, description="share of range_max that a beam without an echo clears; 0: none"
    )

    RENAMED: ClassVar[dict[str, str]] = {
        "behind": "hit_depth",
        "surest_occupied": "max_probability",
        "surest_free": "min_probability",
    }


class Occupancy:
    """Tiles of log odds, created where beams go. The frame is `map`, or `local` in a submap.

    `insert_scan` draws a scan; `next_update` gives the tiles that changed since the last one. A user's edits lie over
    that: `cells` contain them. Of the log odds, which scans are compared with, only erased cells are changed.
    """

    def __init__(self, config: OccupancyConfig, map_id: int) -> None:
        self.config = config
        self.resolution = config.resolution
        self.map_id = map_id
        self.version = 0
        self.tile_index: dict[tuple[int, int], int] = {}  # tile row, column -> index into the arrays below
        self.log_odds: Float32s = np.zeros((16, TILE_CELLS, TILE_CELLS), np.float32)
        self.observed: UInt8s = np.zeros((16, TILE_CELLS, TILE_CELLS), np.uint8)  # 1 in cells that a scan drew
        self.modified: Bools = np.zeros(16, np.bool_)  # tiles whose log odds are newer than their `cells`
        self.cells: Int8s = np.zeros((16, TILE_CELLS * TILE_CELLS), np.int8)  # percent plus 1: 0 is unknown
        self.unpublished: Bools = np.zeros(16, np.bool_)  # tiles whose `cells` changed since the last update
        self.edits: EditMasks = {}
        self._covered: dict[
            tuple[int, int], tuple[Bools, Float32s]
        ] = {}  # erased cells of a tile, their log odds before
        self._forget_window()

    def _forget_window(self) -> None:
        self._window: tuple[int, int, Int32s] = (0, 0, np.zeros((0, 0), np.int32))

    def insert_scan(self, origins: Float64s, ends: Float64s, silent: Float64s) -> None:
        """Draws a scan: beams from origins (n, 2) to ends (n, 2), m in the grid's frame; ends are NaN without an echo.

        silent: (n, 2) m, ends of the free part of beams without an echo, NaN elsewhere.  A scan changes each cell
        once, and a hit wins over a crossing. A beam that ends shortly behind a surface hits that surface.
        Raises RuntimeError for a grid that is read-only.
        """
        if len(self.observed) < len(self.log_odds):
            raise RuntimeError("a read-only grid takes no scan")
        c = self.config
        ends, low, high = drawable_beams(origins, ends, silent, c.range_max)
        if low[0] > high[0]:
            return
        row0, column0, directory = self._directory(low, high)
        self._grow(int((directory < 0).sum()))
        n_before = len(self.tile_index)
        limit = _logit(OCCUPIED_FROM / 100)
        pull_back_hits(origins, ends, c.hit_depth, self.resolution, directory, row0, column0, limit, self.log_odds)
        n = cast_rays(
            origins, ends, silent, self.resolution, directory, row0, column0, n_before,
            _logit(c.hit), _logit(c.miss), _logit(c.min_probability), _logit(c.max_probability),
            self.log_odds, self.observed, self.observed.view(np.uint64), self.modified,
        )  # fmt: skip
        if n > n_before:
            for i, j in np.argwhere(directory >= n_before):
                self.tile_index[int(i) + row0, int(j) + column0] = int(directory[i, j])

    def next_update(self, stamp: int) -> MapUpdate | None:
        """The first MAX_UPDATE changed tiles that no update had yet, by row and column; None without any. stamp: ns."""
        self.update_cells()
        changed = sorted(tile for tile, i in self.tile_index.items() if self.unpublished[i])[:MAX_UPDATE]
        if not changed:
            return None
        self.unpublished[[self.tile_index[tile] for tile in changed]] = False
        self.version += 1
        return self._message(stamp, changed)

    def update_cells(self) -> None:
        """Computes the percentages of modified tiles: most of the work of `next_update`."""
        masks = {self.tile_index[tile]: mask for tile, mask in self.edits.items() if tile in self.tile_index}
        for i in np.flatnonzero(self.modified).tolist():
            self.modified[i] = False
            percent = percentages(self.log_odds[i], self.observed[i])
            cells = (edited_cells(percent, masks[i]) if i in masks else percent).reshape(-1) + np.int8(1)
            if not np.array_equal(cells, self.cells[i]):
                self.cells[i] = cells
                self.unpublished[i] = True

    def all_tiles(self, stamp: int) -> MapUpdate:
        """All tiles as last published. stamp: ns."""
        return self._message(stamp, sorted(p for p, i in self.tile_index.items() if self.cells[i].any()))

    def load(self, update: MapUpdate) -> None:
        """Loads a saved map, before the first scan. Its tiles count as changed."""
        self.resolution = update.resolution
        for row, column, cells in zip(update.rows, update.columns, update.cells, strict=True):
            self._grow(1)
            i = self.tile_index.setdefault((int(row), int(column)), len(self.tile_index))
            self.log_odds[i], self.observed[i] = self._log_odds_of(cells)
            self.modified[i] = True

    def _log_odds_of(self, cells: Int8s) -> tuple[Float64s, Bools]:
        """(64, 64) log odds of a tile's cells (4096,) in percent, 0 where unknown; and which are known."""
        cells = cells.reshape(TILE_CELLS, TILE_CELLS)
        share = np.clip(cells / 100, self.config.min_probability, self.config.max_probability)
        return np.where(cells >= 0, np.log(share / (1 - share)), 0), cells >= 0

    def replace_with(self, other: "Occupancy") -> None:
        """Takes the tiles of another grid of the same area. The next update contains those that differ.

        The arrays are not copied: the other grid must not be used afterwards. Its cells should be up to date.
        """
        for tile in self.tile_index:
            other._grow(1)
            other.tile_index.setdefault(tile, len(other.tile_index))
        here = list(self.tile_index.values())
        there = [other.tile_index[tile] for tile in self.tile_index]
        before, unsent = np.zeros_like(other.cells), np.zeros_like(other.unpublished)
        before[there], unsent[there] = self.cells[here], self.unpublished[here]
        self.tile_index = other.tile_index
        self.log_odds, self.observed, self.modified, self.cells = (
            other.log_odds,
            other.observed,
            other.modified,
            other.cells,
        )
        self.unpublished = unsent | (self.cells != before).any(axis=1)
        self.edits, self._covered = {}, {}
        self._forget_window()

    def set_edits(self, masks: EditMasks) -> None:
        """Lays edits over the grid, instead of those before."""
        for tile, (erased, log_odds) in self._covered.items():
            self.log_odds[self.tile_index[tile]][erased] = log_odds
        self._covered, masks = {}, shown_masks(masks, self.tile_index)
        for tile in (tile for tile, mask in masks.items() if (mask == WALL).any()):
            if tile not in self.tile_index:
                self._grow(1)
                self.tile_index[tile] = len(self.tile_index)
        for tile in self.edits.keys() | masks.keys():
            if tile in self.tile_index:
                self.modified[self.tile_index[tile]] = True
        self.edits = masks
        for tile in masks.keys() & self.tile_index.keys():
            i = self.tile_index[tile]
            erased = (masks[tile] == ERASED) & (self.observed[i] > 0)
            self._covered[tile] = erased, self.log_odds[i][erased]
            self.log_odds[i][erased] = _logit(self.config.min_probability)
        self._forget_window()

    def tiles_without_edits(self, stamp: int) -> MapUpdate:
        """All tiles as last published, but without the edits."""
        tiles = self.all_tiles(stamp)
        for k, tile in enumerate(zip(tiles.rows.tolist(), tiles.columns.tolist())):
            if tile in self.edits:
                i = self.tile_index[tile]
                log_odds = self.log_odds[i].copy()
                erased, before = self._covered.get(tile, (np.zeros_like(log_odds, np.bool_), log_odds[:0, 0]))
                log_odds[erased] = before
                tiles.cells[k] = percentages(log_odds, self.observed[i]).reshape(-1)
        return tiles.only(np.asarray((tiles.cells >= 0).any(axis=1))) if self.edits else tiles

    def load_below_edits(self, update: MapUpdate) -> None:
        """Replaces what lies below the edits by the cells of tiles without edits."""
        edits = self.edits
        self.set_edits({})
        for row, column, cells in zip(update.rows.tolist(), update.columns.tolist(), update.cells):
            if (row, column) in edits and (row, column) in self.tile_index:
                i, edited = self.tile_index[row, column], edits[row, column] > 0
                log_odds, observed = self._log_odds_of(cells)
                self.log_odds[i][edited], self.observed[i][edited] = log_odds[edited], observed[edited]
        self.set_edits(edits)

    def is_free(self, points: Float64s, margin: int) -> Bools:
        """(n,) bool: which points (n, 2) m lie in free cells, with `margin` free cells to each side."""
        if not len(points):
            return np.zeros(0, np.bool_)
        row0, column0, directory = self._directory(points.min(axis=0), points.max(axis=0))
        free = _is_free(
            points, self.resolution, directory, row0, column0, _logit(FREE_UP_TO / 100), margin, self.log_odds
        )
        return np.asarray(free, bool)

    def is_near_occupied(self, points: Float64s) -> Bools:
        """(n,) bool: which points (n, 2) m lie in an occupied cell, or beside one."""
        if not len(points):
            return np.zeros(0, np.bool_)
        row0, column0, directory = self._directory(points.min(axis=0), points.max(axis=0))
        limit = _logit(OCCUPIED_FROM / 100)
        return np.asarray(
            _is_near_occupied(points, self.resolution, directory, row0, column0, limit, self.log_odds), bool
        )

    def contradicts(self, origins: Float64s, ends: Float64s) -> Bools:
        """(n,) bool: which beams from origins (n, 2) to ends (n, 2), m, contradict the grid.

        They end in a free cell among free cells, or over 0.3 m behind an occupied cell.
        """
        return np.asarray(self.is_free(ends, 1) | self.crosses_occupied(origins, ends), bool)

    def crosses_occupied(self, origins: Float64s, ends: Float64s) -> Bools:
        """(n,) bool: which beams from origins (n, 2) to ends (n, 2), m, end over 0.3 m behind an occupied cell."""
        if not len(ends):
            return np.zeros(0, np.bool_)
        row0, column0, directory = self._directory(
            np.minimum(origins, ends).min(axis=0), np.maximum(origins, ends).max(axis=0)
        )
        limit = _logit(OCCUPIED_FROM / 100)
        return np.asarray(
            _crosses_occupied(origins, ends, self.resolution, directory, row0, column0, limit, self.log_odds), bool
        )

    def make_read_only(self) -> None:
        """Frees the memory that only `insert_scan` and `next_update` need."""
        self.log_odds = self.log_odds[: max(len(self.tile_index), 1)].copy()
        for name in TILE_ARRAYS[1:]:
            setattr(self, name, getattr(self, name)[:0].copy())

    def _message(self, stamp: int, tiles: list[tuple[int, int]]) -> MapUpdate:
        return MapUpdate(
            stamp=stamp,
            map_id=self.map_id,
            version=self.version,
            resolution=self.resolution,
            rows=np.array([row for row, _ in tiles], np.int32),
            columns=np.array([column for _, column in tiles], np.int32),
            cells=(self.cells[[self.tile_index[tile] for tile in tiles]] - np.int8(1)).reshape(
                len(tiles), TILE_CELLS**2
            ),
        )

    def _directory(self, low: Float64s, high: Float64s) -> tuple[int, int, Int32s]:
        """First row, first column and (rows, columns) int32 indices (-1: none) of the tiles over low..high (2,), m."""
        side = TILE_CELLS * self.resolution
        column0, row0 = (floor(v / side - 0.1) for v in low.tolist())
        column1, row1 = (floor(v / side + 0.1) for v in high.tolist())
        first_row, first_column, directory = self._window
        last_row, last_column = first_row + directory.shape[0] - 1, first_column + directory.shape[1] - 1
        if first_row <= row0 and first_column <= column0 and row1 <= last_row and column1 <= last_column:
            return self._window
        # with a margin, so that it serves several scans
        row0, column0, row1, column1 = row0 - 3, column0 - 3, row1 + 3, column1 + 3
        directory = np.full((row1 - row0 + 1, column1 - column0 + 1), -1, np.int32)
        for (i, j), index in self.tile_index.items():
            if row0 <= i <= row1 and column0 <= j <= column1:
                directory[i - row0, j - column0] = index
        self._window = row0, column0, directory
        return self._window

    def _grow(self, room: int) -> None:
        """Makes room for `room` new tiles. Zeros take no memory until they are written, so a wide window is cheap."""
        n, capacity = len(self.tile_index), len(self.log_odds)
        while n + room > capacity:
            capacity *= 2
        if capacity > len(self.log_odds):
            for name in TILE_ARRAYS:
                old = getattr(self, name)
                new = np.zeros((capacity, *old.shape[1:]), old.dtype)
                new[:n] = old[:n]
                setattr(self, name, new)


def percentages(log_odds: Float32s, observed: UInt8s) -> Int8s:
    """(...) int8 occupancy 0..100 of log odds (...); -1 where no scan has drawn the cell."""
    share = 100 / (1 + np.exp(-log_odds.astype(np.float64)))
    return np.where(observed > 0, np.round(share), -1).astype(np.int8)


def _logit(probability: float) -> float:
    return log(probability / (1 - probability))


@njit(cache=True, nogil=True)
def _is_free(points, resolution, directory, row0, column0, limit, margin, log_odds):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    free = np.zeros(len(points), np.bool_)
    for k in range(len(points)):
        column, row = int(np.floor(points[k, 0] / resolution)), int(np.floor(points[k, 1] / resolution))
        all_free = True
        for r in range(row - margin, row + margin + 1):
            for c in range(column - margin, column + margin + 1):
                i, j = (r >> 6) - row0, (c >> 6) - column0
                inside = 0 <= i < directory.shape[0] and 0 <= j < directory.shape[1]
                tile = directory[i, j] if inside else -1
                if tile < 0 or log_odds[tile, r & 63, c & 63] > limit:
                    all_free = False
        free[k] = all_free
    return free


@njit(cache=True, nogil=True)
def _is_near_occupied(points, resolution, directory, row0, column0, limit, log_odds):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    near = np.zeros(len(points), np.bool_)
    for k in range(len(points)):
        column, row = int(np.floor(points[k, 0] / resolution)), int(np.floor(points[k, 1] / resolution))
        for r in range(row - 1, row + 2):
            for c in range(column - 1, column + 2):
                i, j = (r >> 6) - row0, (c >> 6) - column0
                inside = 0 <= i < directory.shape[0] and 0 <= j < directory.shape[1]
                tile = directory[i, j] if inside else -1
                if tile >= 0 and log_odds[tile, r & 63, c & 63] > limit:
                    near[k] = True
    return near


@njit(cache=True, nogil=True)
def _crosses_occupied(origins, ends, resolution, directory, row0, column0, limit, log_odds):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    crossing = np.zeros(len(ends), np.bool_)
    for k in range(len(ends)):
        dx, dy = ends[k, 0] - origins[k, 0], ends[k, 1] - origins[k, 1]
        length = np.hypot(dx, dy)
        n = int((length - 0.3) / (0.7 * resolution))
        for m in range(1, n):
            share = m * 0.7 * resolution / length
            column = int(np.floor((origins[k, 0] + share * dx) / resolution))
            row = int(np.floor((origins[k, 1] + share * dy) / resolution))
            i, j = (row >> 6) - row0, (column >> 6) - column0
            if 0 <= i < directory.shape[0] and 0 <= j < directory.shape[1]:
                tile = directory[i, j]
                if tile >= 0 and log_odds[tile, row & 63, column & 63] > limit:
                    crossing[k] = True
                    break
    return crossing
