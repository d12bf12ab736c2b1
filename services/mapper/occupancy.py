# SPDX-License-Identifier: Apache-2.0
"""The occupancy grid: log-odds in tiles, carved free along the beams, clamped so that it forgets."""

from math import floor, log

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from services.mapper.carving import carve, drawable, explain
from shared.config import Section
from shared.grid import FREE_UP_TO, OCCUPIED_FROM
from shared.messages import TILE_CELLS, MapUpdate

Float32s = NDArray[np.float32]
Float64s = NDArray[np.float64]
Int8s = NDArray[np.int8]
Int32s = NDArray[np.int32]
UInt8s = NDArray[np.uint8]
Bools = NDArray[np.bool_]


TILE_ARRAYS = ("odds", "seen", "dirty", "known", "unsent")


class OccupancyConfig(Section):
    """The occupancy grid."""

    resolution: float = Field(0.05, ge=0.005, le=1, description="m a cell")
    hit: float = Field(0.64, gt=0.5, lt=1, description="probability of a cell in which a beam ended once")
    miss: float = Field(0.39, gt=0, lt=0.5, description="probability of a cell that a beam crossed once")
    behind: float = Field(
        0.1, ge=0, le=1, description="m that a beam may end behind an occupied cell and still count as a hit of it"
    )
    surest_occupied: float = Field(0.96, gt=0.5, lt=1, description="probability over which a cell never rises")
    surest_free: float = Field(0.06, gt=0, lt=0.5, description="probability under which a cell never falls")
    range_max: float = Field(40.0, gt=0, le=250, description="m; what lies farther is not drawn")
    no_echo_free: float = Field(
        0.0, ge=0, le=1, description="share of range_max that a beam without an echo carves; 0: it says nothing"
    )


class Occupancy:
    """Tiles of log-odds, made where beams go. `integrate` draws a scan; `update` gives the tiles that changed."""

    def __init__(self, config: OccupancyConfig, map_id: int) -> None:
        self.config = config
        self.resolution = config.resolution
        self.map_id = map_id
        self.version = 0
        self.places: dict[tuple[int, int], int] = {}  # tile row, column -> index into the arrays below
        self.odds: Float32s = np.zeros((16, TILE_CELLS, TILE_CELLS), np.float32)
        self.seen: UInt8s = np.zeros((16, TILE_CELLS, TILE_CELLS), np.uint8)  # 1 in cells that a scan drew
        self.dirty: Bools = np.zeros(16, np.bool_)  # drawn into since `known`
        self.known: Int8s = np.zeros((16, TILE_CELLS * TILE_CELLS), np.int8)  # percent plus 1: 0 is unknown
        self.unsent: Bools = np.zeros(16, np.bool_)  # tiles whose `known` is newer than what was published
        self._window: tuple[int, int, Int32s] = (0, 0, np.full((1, 1), -1, np.int32))

    def integrate(self, origins: Float64s, ends: Float64s, silent: Float64s) -> None:
        """Draws a scan: beams from origins (n, 2) to ends (n, 2), m in `map`, that hit (NaN: no measurement).

        silent: (n, 2) ends up to which a beam without an echo is free, NaN elsewhere.  Each cell is drawn once a
        scan, and a hit wins over free.  What ends shortly behind a surface has hit that surface.
        """
        if len(self.seen) < len(self.odds):
            raise RuntimeError("a trimmed grid is only asked, not drawn into")
        c = self.config
        ends, low, high = drawable(origins, ends, silent, c.range_max)
        if low[0] > high[0]:
            return
        row0, column0, directory = self._directory(low, high)
        self._grow(int((directory < 0).sum()))
        n_before = len(self.places)
        limit = _logit(OCCUPIED_FROM / 100)
        explain(origins, ends, c.behind, self.resolution, directory, row0, column0, limit, self.odds)
        n = carve(
            origins, ends, silent, self.resolution, directory, row0, column0, n_before,
            _logit(c.hit), _logit(c.miss), _logit(c.surest_free), _logit(c.surest_occupied),
            self.odds, self.seen, self.seen.view(np.uint64), self.dirty,
        )  # fmt: skip
        if n > n_before:
            for i, j in np.argwhere(directory >= n_before):
                self.places[int(i) + row0, int(j) + column0] = int(directory[i, j])

    def update(self, stamp: int) -> MapUpdate | None:
        """The tiles whose percentages changed since the last update, in the order of their place; None without any."""
        self.settle()
        changed = sorted(place for place, i in self.places.items() if self.unsent[i])
        if not changed:
            return None
        self.unsent[:] = False
        self.version += 1
        return self._message(stamp, changed)

    def settle(self) -> None:
        """Turns what was drawn into percentages, most of what `update` costs."""
        for i in np.flatnonzero(self.dirty):
            self.dirty[i] = False
            cells = percent(self.odds[i], self.seen[i]).reshape(-1) + np.int8(1)
            if not np.array_equal(cells, self.known[i]):
                self.known[i] = cells
                self.unsent[i] = True

    def whole(self, stamp: int) -> MapUpdate:
        """All tiles as last published."""
        return self._message(stamp, sorted(p for p, i in self.places.items() if self.known[i].any()))

    def load(self, update: MapUpdate) -> None:
        """Starts from a saved map, before the first scan; its tiles count as changed."""
        self.resolution = update.resolution
        for row, column, cells in zip(update.rows, update.columns, update.cells, strict=True):
            self._grow(1)
            i = self.places.setdefault((int(row), int(column)), len(self.places))
            known = cells.reshape(TILE_CELLS, TILE_CELLS) >= 0
            share = np.clip(
                cells.reshape(TILE_CELLS, TILE_CELLS) / 100, self.config.surest_free, self.config.surest_occupied
            )
            self.odds[i] = np.where(known, np.log(share / (1 - share)), 0)
            self.seen[i] = known
            self.dirty[i] = True

    def become(self, other: "Occupancy") -> None:
        """Takes over another drawing of the same place, best a settled one; the next update tells what is different.

        The other's arrays are taken, not copied: it is of no use after that.
        """
        for place in self.places:
            other._grow(1)
            other.places.setdefault(place, len(other.places))
        here = list(self.places.values())
        there = [other.places[place] for place in self.places]
        before, unsent = np.zeros_like(other.known), np.zeros_like(other.unsent)
        before[there], unsent[there] = self.known[here], self.unsent[here]
        self.places = other.places
        self.odds, self.seen, self.dirty, self.known = other.odds, other.seen, other.dirty, other.known
        self.unsent = unsent | (self.known != before).any(axis=1)
        self._window = (0, 0, np.full((1, 1), -1, np.int32))

    def clear_at(self, points: Float64s, around: int) -> Bools:
        """(n,) bool: which points (n, 2) m in `map` lie in free cells, with `around` free cells to each side."""
        if not len(points):
            return np.zeros(0, np.bool_)
        row0, column0, directory = self._directory(points.min(axis=0), points.max(axis=0))
        free = _free(points, self.resolution, directory, row0, column0, _logit(FREE_UP_TO / 100), around, self.odds)
        return np.asarray(free, bool)

    def occupied_near(self, points: Float64s) -> Bools:
        """(n,) bool: which points (n, 2) m in `map` lie in an occupied cell, or beside one."""
        if not len(points):
            return np.zeros(0, np.bool_)
        row0, column0, directory = self._directory(points.min(axis=0), points.max(axis=0))
        limit = _logit(OCCUPIED_FROM / 100)
        return np.asarray(_occupied_near(points, self.resolution, directory, row0, column0, limit, self.odds), bool)

    def contradicts(self, origins: Float64s, ends: Float64s) -> Bools:
        """(n,) bool: which beams from origins (n, 2) to ends (n, 2), m in `map`, cannot be with this map.

        They end in a cell known to be free, with free cells all around, or go on over 0.3 m behind an occupied cell.
        """
        return np.asarray(self.clear_at(ends, 1) | self.crosses(origins, ends), bool)

    def crosses(self, origins: Float64s, ends: Float64s) -> Bools:
        """(n,) bool: which beams from origins (n, 2) to ends (n, 2) go on over 0.3 m behind an occupied cell."""
        if not len(ends):
            return np.zeros(0, np.bool_)
        row0, column0, directory = self._directory(
            np.minimum(origins, ends).min(axis=0), np.maximum(origins, ends).max(axis=0)
        )
        limit = _logit(OCCUPIED_FROM / 100)
        return np.asarray(_crossing(origins, ends, self.resolution, directory, row0, column0, limit, self.odds), bool)

    def trim(self) -> None:
        """Gives back the memory that was meant for more tiles and for drawing: from now on it is only asked."""
        self.odds = self.odds[: max(len(self.places), 1)].copy()
        for name in TILE_ARRAYS[1:]:
            setattr(self, name, getattr(self, name)[:0].copy())

    def _message(self, stamp: int, places: list[tuple[int, int]]) -> MapUpdate:
        return MapUpdate(
            stamp,
            self.map_id,
            self.version,
            self.resolution,
            np.array([row for row, _ in places], np.int32),
            np.array([column for _, column in places], np.int32),
            (self.known[[self.places[p] for p in places]] - np.int8(1)).reshape(len(places), TILE_CELLS**2),
        )

    def _directory(self, low: Float64s, high: Float64s) -> tuple[int, int, Int32s]:
        """A window of tiles from low (2,) m to high: first row and column, and indices (-1: no tile)."""
        side = TILE_CELLS * self.resolution
        column0, row0 = (floor(v / side - 0.1) for v in low.tolist())
        column1, row1 = (floor(v / side + 0.1) for v in high.tolist())
        first_row, first_column, directory = self._window
        last_row, last_column = first_row + directory.shape[0] - 1, first_column + directory.shape[1] - 1
        if first_row <= row0 and first_column <= column0 and row1 <= last_row and column1 <= last_column:
            return self._window
        # wider than asked, so that it lasts for some scans
        row0, column0, row1, column1 = row0 - 3, column0 - 3, row1 + 3, column1 + 3
        directory = np.full((row1 - row0 + 1, column1 - column0 + 1), -1, np.int32)
        for (i, j), index in self.places.items():
            if row0 <= i <= row1 and column0 <= j <= column1:
                directory[i - row0, j - column0] = index
        self._window = row0, column0, directory
        return self._window

    def _grow(self, room: int) -> None:
        """Makes room for new tiles. Zeros cost nothing until they are written, so that a wide window is cheap."""
        n, capacity = len(self.places), len(self.odds)
        while n + room > capacity:
            capacity *= 2
        if capacity > len(self.odds):
            for name in TILE_ARRAYS:
                old = getattr(self, name)
                new = np.zeros((capacity, *old.shape[1:]), old.dtype)
                new[:n] = old[:n]
                setattr(self, name, new)


def percent(odds: Float32s, seen: UInt8s) -> Int8s:
    """Log-odds to 0..100, -1 where no scan drew the cell."""
    share = 100 / (1 + np.exp(-odds.astype(np.float64)))
    return np.where(seen > 0, np.round(share), -1).astype(np.int8)


def _logit(probability: float) -> float:
    return log(probability / (1 - probability))


@njit(cache=True, nogil=True)
def _free(points, resolution, directory, row0, column0, limit, around, odds):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    free = np.zeros(len(points), np.bool_)
    for k in range(len(points)):
        column, row = int(np.floor(points[k, 0] / resolution)), int(np.floor(points[k, 1] / resolution))
        all_free = True
        for r in range(row - around, row + around + 1):
            for c in range(column - around, column + around + 1):
                i, j = (r >> 6) - row0, (c >> 6) - column0
                inside = 0 <= i < directory.shape[0] and 0 <= j < directory.shape[1]
                tile = directory[i, j] if inside else -1
                if tile < 0 or odds[tile, r & 63, c & 63] > limit:
                    all_free = False
        free[k] = all_free
    return free


@njit(cache=True, nogil=True)
def _occupied_near(points, resolution, directory, row0, column0, limit, odds):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    near = np.zeros(len(points), np.bool_)
    for k in range(len(points)):
        column, row = int(np.floor(points[k, 0] / resolution)), int(np.floor(points[k, 1] / resolution))
        for r in range(row - 1, row + 2):
            for c in range(column - 1, column + 2):
                i, j = (r >> 6) - row0, (c >> 6) - column0
                inside = 0 <= i < directory.shape[0] and 0 <= j < directory.shape[1]
                tile = directory[i, j] if inside else -1
                if tile >= 0 and odds[tile, r & 63, c & 63] > limit:
                    near[k] = True
    return near


@njit(cache=True, nogil=True)
def _crossing(origins, ends, resolution, directory, row0, column0, limit, odds):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
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
                if tile >= 0 and odds[tile, row & 63, column & 63] > limit:
                    crossing[k] = True
                    break
    return crossing
