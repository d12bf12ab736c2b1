# SPDX-License-Identifier: Apache-2.0
"""What the other robots of an exploration know: the own map as it is sent, and theirs in cells of the own (our own)."""

import zlib
from collections.abc import Iterable
from dataclasses import dataclass
from math import ceil, cos, floor, sin

import numpy as np
from numba import njit

from shared.geometry import Pose2
from shared.grid import FREE_UP_TO, OCCUPIED_FROM, UNKNOWN, OccupancyGrid, coarse_levels
from shared.messages import MAX_COARSE_CELLS, MAX_SPAN, TILE_CELLS, ExplorationShare, MapUpdate
from shared.types import Float64s, Int8s, Int64s

_FREE, _OCCUPIED = 0, 100  # percent

_Area = tuple[int, int, int, int]  # first row, first column, end row, end column, in tiles


@dataclass(frozen=True, slots=True)
class PackedMap:
    """A map as `ExplorationShare` has it."""

    cell: float
    first_row: int
    first_column: int
    rows: int
    columns: int
    cells: bytes


def packed_map(grid: OccupancyGrid) -> PackedMap:
    """A map for the others. One of over MAX_COARSE_CELLS is sent in larger cells."""
    n = 1
    while grid.cells.size > n * n * MAX_COARSE_CELLS:
        n *= 2
    cells, per_tile = coarse_levels(grid.cells, n), TILE_CELLS // n
    return PackedMap(
        cell=grid.resolution * n,
        first_row=grid.first_row * per_tile,
        first_column=grid.first_column * per_tile,
        rows=cells.shape[0],
        columns=cells.shape[1],
        cells=zlib.compress(cells.tobytes()),
    )


class OthersMap:
    """The maps of the others in one grid in the own `map`, with an id of its own for each exploration."""

    def __init__(self) -> None:
        self.grid = OccupancyGrid()
        self._maps: dict[str, tuple[object, ...]] = {}  # of each robot, as it was sent

    def update(
        self, shares: Iterable[ExplorationShare], common_from_map: Pose2, resolution: float, now: int
    ) -> MapUpdate | None:
        """Takes the newest messages of the others. Returns the tiles that changed; None without any.

        common_from_map: of the own `map`.  resolution: of the own map, m a cell.  now: ns. A map that lies so far away
        that no grid holds both is left out.
        """
        shares = sorted(shares, key=lambda share: share.robot)
        maps = {share.robot: _as_sent(share, common_from_map) for share in shares}
        if maps == self._maps and resolution == self.grid.resolution:
            return None
        self._maps = maps
        if self.grid.map_id == 0 or resolution != self.grid.resolution:
            self.grid = OccupancyGrid(resolution, now)
        present: list[tuple[_Area, ExplorationShare, Int8s]] = []
        area = _tiles(self.grid)
        for share in shares:
            cells = share.coarse_cells()
            if cells is None or not cells.size:
                continue
            its_area = _covered(share, common_from_map, resolution)
            wider = its_area if area is None else _union(area, its_area)
            if max(wider[2] - wider[0], wider[3] - wider[1]) <= MAX_SPAN:
                area = wider
                present.append((its_area, share, cells))
        if area is None:
            return None
        whole = OccupancyGrid(resolution, self.grid.map_id)
        whole.version, whole.first_row, whole.first_column = self.grid.version + 1, area[0], area[1]
        whole.cells = np.full(((area[2] - area[0]) * TILE_CELLS, (area[3] - area[1]) * TILE_CELLS), UNKNOWN, np.int8)
        for its_area, share, cells in present:
            row, column = (its_area[0] - area[0]) * TILE_CELLS, (its_area[1] - area[1]) * TILE_CELLS
            height, width = (its_area[2] - its_area[0]) * TILE_CELLS, (its_area[3] - its_area[1]) * TILE_CELLS
            part = whole.cells[row : row + height, column : column + width]
            _lay_share(part, share, cells, common_from_map, its_area, resolution)
        changed = self.grid.apply(whole.update_of(np.ones(whole.cells.shape, bool), now))
        return self.grid.update_of(changed, now) if changed.any() else None


def warm_up_laying() -> None:
    """Compiles the kernel, for cells that were received: they are read-only."""
    cells = np.zeros((1, 1), np.int8)
    cells.setflags(write=False)
    place = np.zeros(2, np.int64)
    _lay(np.zeros((1, 1), np.int8), cells, np.array([0.0, 0.0, 1.0, 0.0]), place, place, 1.0)


def no_map(now: int) -> MapUpdate:
    """What the others know when the exploration has ended: nothing."""
    none = np.zeros(0, np.int32)
    return MapUpdate(
        stamp=now,
        map_id=now,
        version=1,
        resolution=OccupancyGrid().resolution,
        rows=none,
        columns=none,
        cells=np.zeros((0, TILE_CELLS * TILE_CELLS), np.int8),
    )


def _as_sent(share: ExplorationShare, common_from_map: Pose2) -> tuple[object, ...]:
    place = share.first_row, share.first_column, share.rows, share.columns
    return common_from_map, share.common_from_map, share.cell, *place, share.cells


def _tiles(grid: OccupancyGrid) -> _Area | None:
    if grid.empty:
        return None
    h, w = (length // TILE_CELLS for length in grid.cells.shape)
    return grid.first_row, grid.first_column, grid.first_row + h, grid.first_column + w


def _union(a: _Area, b: _Area) -> _Area:
    return min(a[0], b[0]), min(a[1], b[1]), max(a[2], b[2]), max(a[3], b[3])


def _covered(share: ExplorationShare, common_from_map: Pose2, resolution: float) -> _Area:
    """The tiles of the own map on which the other one lies."""
    map_from_theirs = common_from_map.inverse() @ share.common_from_map
    rows = (np.array([0, 0, 1, 1]) * share.rows + share.first_row) * share.cell
    columns = (np.array([0, 1, 0, 1]) * share.columns + share.first_column) * share.cell
    x, y = (map_from_theirs @ np.column_stack((columns, rows)).astype(np.float64)).T
    side = TILE_CELLS * resolution
    return floor(y.min() / side), floor(x.min() / side), ceil(y.max() / side), ceil(x.max() / side)


def _lay_share(
    part: Int8s, share: ExplorationShare, cells: Int8s, common_from_map: Pose2, area: _Area, resolution: float
) -> None:
    """Writes another robot's map into these tiles of the own one."""
    pose = share.common_from_map.inverse() @ common_from_map
    _lay(
        part,
        cells,
        np.array([pose.x / share.cell, pose.y / share.cell, cos(pose.yaw), sin(pose.yaw)]),
        np.array([share.first_row, share.first_column], np.int64),
        np.array([area[0] * TILE_CELLS, area[1] * TILE_CELLS], np.int64),
        resolution / share.cell,
    )


@njit(cache=True, nogil=True)
def _lay(whole: Int8s, cells: Int8s, pose: Float64s, first: Int64s, corner: Int64s, ratio: float) -> None:
    """Writes the cells of another map into the cells of the own one that are unknown yet.

    whole: (h, w) int8, whose lower left cell is corner (row, column) of the own map.  cells: (k, l) int8, the lower
    left one is first (row, column) of the other map.  pose: (x, y, cos, sin) of the own map in the other one, in cells
    of that one.  ratio: side of an own cell, in cells of the other map.
    """
    x0, y0, c, s = pose
    for r in range(whole.shape[0]):
        v = (corner[0] + r + 0.5) * ratio
        for k in range(whole.shape[1]):
            if whole[r, k] != UNKNOWN:
                continue
            u = (corner[1] + k + 0.5) * ratio
            row = floor(y0 + s * u + c * v) - first[0]
            column = floor(x0 + c * u - s * v) - first[1]
            if 0 <= row < cells.shape[0] and 0 <= column < cells.shape[1]:
                value = cells[row, column]
                if value >= OCCUPIED_FROM:
                    whole[r, k] = _OCCUPIED
                elif 0 <= value <= FREE_UP_TO:
                    whole[r, k] = _FREE
