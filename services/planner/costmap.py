# SPDX-License-Identifier: Apache-2.0
"""The global costmap: cost of each cell from the exact distance to obstacles, and from the policy for unknown space.

The cost by distance is that of Nav2's inflation layer over an exact distance (`cost_by_distance`). The extra cost of
narrow places, and the second costmap with a smaller margin, are our own.
"""

from itertools import product
from math import ceil, exp, hypot
from typing import ClassVar, Literal

import numpy as np
from numba import njit
from pydantic import Field

from services.planner.abstract_graph import AbstractGraph
from services.planner.connected_components import ConnectedComponents
from shared.clearance import required_clearance
from shared.config import Robot, Section
from shared.distance_field import distance_field
from shared.grid import FREE_UP_TO, OCCUPIED_FROM, OccupancyGrid
from shared.messages import TILE_CELLS
from shared.types import Bools, Float32s, Float64s, Int8s, UInt16s, UInt64s

Window = tuple[int, int, int, int]  # first row, first column, last row + 1, last column + 1

UNIT_COST = 50
"""Cost of a free cell far from obstacles. A cell of cost 150 counts as three times its length; 0 is blocked."""

LEAVE_PENALTY = 10 * UNIT_COST
"""Extra cost of a cell in a keep-out zone around the robot, so that it leaves on a short path."""


class CostConfig(Section):
    """Cost of clearance and of unknown space."""

    RENAMED: ClassVar[dict[str, str]] = {"least_margin": "min_margin"}

    margin: float = Field(
        0.07,
        ge=0,
        le=1,
        description="m kept free around the footprint's inscribed circle at 5 cm a cell; more on coarser maps",
    )
    min_margin: float = Field(
        0.03, ge=0, le=1, description="m kept free around it where no other path exists; more on coarser maps"
    )
    inflation_radius: float = Field(1.0, gt=0, le=5, description="m from an obstacle within which cells cost more")
    clearance_weight: float = Field(
        5.0,
        ge=0,
        le=100,
        description=(
            "m of detour that equal 1 m of path where the robot just fits. A higher weight keeps more "
            "clearance and never gives a shorter path; 0 gives the shortest path"
        ),
    )
    clearance_falloff: float = Field(4.0, gt=0, le=50, description="1/m: exponential decay of that cost with distance")
    narrow_weight: float = Field(
        2.0, ge=0, le=100, description="extra cost, in lengths, of a path where the robot cannot turn in place"
    )
    unknown: Literal["allowed", "costly", "forbidden"] = Field("costly", description="paths through unknown space")
    unknown_weight: float = Field(
        2.0, ge=0, le=100, description="extra cost, in lengths, of a path through unknown space, where `costly`"
    )
    beyond_map: float = Field(
        0.0, ge=0, le=50, description="m outside the map's tiles that count as unknown space instead of as outside"
    )

    @property
    def beyond(self) -> float:
        """m outside the map's tiles to which a path may lead."""
        return self.beyond_map if self.unknown != "forbidden" else 0.0


class GlobalCostmap:
    """The costs of a map for a robot, with the abstract graph and the components of its free cells.

    `costs`: (h + 2 pad, w + 2 pad) uint16, UNIT_COST and more, 0 blocked. Its outermost ring is blocked, so that a
    search needs no bounds. `graph` and `components` follow each update. `max_cost` is an upper bound of the costs.
    `resolution`: m a cell.
    """

    def __init__(self, config: CostConfig, robot: Robot, resolution: float) -> None:
        self.config, self.robot = config, robot
        self.resolution = resolution
        margin = required_clearance(config.margin, resolution)
        self.min_clearance = robot.inscribed_radius + margin
        radius = max(config.inflation_radius, self.min_clearance, robot.circumscribed_radius + margin)
        self.reach_cells = ceil(radius / resolution)
        self.pad = 1 + ceil(config.beyond / resolution)
        self._by_distance = cost_by_distance(config, robot, resolution, self.reach_cells)
        self._unknown_cost = {
            "allowed": 0,
            "costly": round(UNIT_COST * config.unknown_weight),
            "forbidden": -1,
        }[config.unknown]
        self.max_cost = int(self._by_distance.max()) + max(self._unknown_cost, 0)
        self.distance: Float32s = np.zeros((0, 0), np.float32)  # cells to the nearest obstacle, at most reach_cells
        self.cells: Int8s = np.zeros((0, 0), np.int8)  # the map's, percent
        self.origin = (0.0, 0.0)  # m, lower left corner of costs[0, 0] in `map`
        self.costs: UInt16s = np.zeros((2, 2), np.uint16)
        self.graph, self.components = AbstractGraph.of(self.costs), ConnectedComponents(self.costs)
        self._reduced: GlobalCostmap | None = None
        self._max_cost_without_zones = self.max_cost
        self._penalized: Bools | None = None
        self._closed: Bools | None = None

    def set_keep_out(self, penalized: Bools | None, closed: Bools | None) -> None:
        """Sets the masks of the keep-out zones from the next update on, which must be of all cells.

        penalized: (h, w) bool, cells of the map that the robot should leave. closed: as `costs`, blocked cells beyond
        the map.
        """
        self._penalized, self._closed = penalized, closed
        self.max_cost = self._max_cost_without_zones + (LEAVE_PENALTY if penalized is not None else 0)

    def update(self, grid: OccupancyGrid, changed: Bools | None) -> None:
        """Updates the costs to a map. changed: (h, w) bool, cells that differ from the last call; None: all."""
        self.cells = grid.cells
        self.origin = (grid.x0 - self.pad * self.resolution, grid.y0 - self.pad * self.resolution)
        if changed is None or grid.cells.shape != self.distance.shape:
            self.distance = np.minimum(distance_field(grid.occupied, 1.0), np.float32(self.reach_cells))
            self._reduced = None
            self._rebuild()
            return
        for window in _changed_windows(changed):
            self._update_window(self._update_distances(*window))
        if self._reduced:
            self._reduced.cells, self._reduced.origin = self.cells, self.origin
            for r0, c0, r1, c1 in _changed_windows(changed):
                self._reduced._update_window(self._window_in_reach(r0, c0, r1, c1))

    def with_min_margin(self) -> "GlobalCostmap":
        """The costmap of the same map with `min_margin`; this one where its margin is not larger."""
        if self.config.min_margin >= self.config.margin:
            return self
        if self._reduced is None:
            reduced = GlobalCostmap(
                self.config.model_copy(update={"margin": self.config.min_margin}), self.robot, self.resolution
            )
            reduced._by_distance = cost_by_distance(reduced.config, self.robot, self.resolution, self.reach_cells)
            reduced.reach_cells, reduced.distance = self.reach_cells, self.distance
            reduced.cells, reduced.origin = self.cells, self.origin
            reduced.set_keep_out(self._penalized, self._closed)
            reduced._rebuild()
            self._reduced = reduced
        return self._reduced

    def _rebuild(self) -> None:
        """Computes the costs of the whole map, its graph and components."""
        (h, w), pad = self.cells.shape, self.pad
        self.costs = np.full((h + 2 * pad, w + 2 * pad), 0, np.uint16)
        if pad > 1:
            self.costs[1:-1, 1:-1] = UNIT_COST + self._unknown_cost
        if self._closed is not None:
            self.costs[self._closed] = 0
        _fill_costs(self.cells, self.distance, self._by_distance, self._unknown_cost, self.costs[pad:-pad, pad:-pad])
        if self._penalized is not None:
            _raise_costs(self.costs[pad:-pad, pad:-pad], self._penalized)
        self.graph, self.components = AbstractGraph.of(self.costs), ConnectedComponents(self.costs)

    def _update_window(self, window: Window) -> None:
        """Computes the costs of a window of the map, with its part of graph and components."""
        (r0, c0, r1, c1), pad = window, self.pad
        target = r0 + pad, c0 + pad, r1 + pad, c1 + pad
        _fill_costs(
            self.cells[r0:r1, c0:c1], self.distance[r0:r1, c0:c1], self._by_distance, self._unknown_cost,
            self.costs[target[0] : target[2], target[1] : target[3]],
        )  # fmt: skip
        if self._penalized is not None:
            _raise_costs(self.costs[target[0] : target[2], target[1] : target[3]], self._penalized[r0:r1, c0:c1])
        self.graph.update(self.costs, *target)
        self.components.update(self.costs, *target)

    def cell(self, x: float, y: float) -> tuple[int, int]:
        """(row, column) in `costs` of a point in `map`, m; may lie outside."""
        x0, y0 = self.origin
        return int((y - y0) // self.resolution), int((x - x0) // self.resolution)

    def centre(self, row: int, column: int) -> tuple[float, float]:
        """(x, y) m in `map` of a cell of `costs`."""
        x0, y0 = self.origin
        return x0 + (column + 0.5) * self.resolution, y0 + (row + 0.5) * self.resolution

    def contains(self, row: int, column: int) -> bool:
        """Whether the cell lies inside the blocked outer ring."""
        h, w = self.costs.shape
        return bool(0 < row < h - 1 and 0 < column < w - 1)

    def is_occupied(self, row: int, column: int) -> bool:
        """Whether the map has an obstacle in the cell of `costs`."""
        return self._distance(row, column) == 0

    def is_too_close(self, row: int, column: int) -> bool:
        """Whether an obstacle is nearer to the cell of `costs` than the robot's inscribed radius with margin."""
        return bool(self._distance(row, column) * self.resolution < self.min_clearance)

    def with_escape_area(self, row: int, column: int, radius: int) -> UInt16s:
        """A copy of `costs`, of the same shape, for a robot in inflated space at a cell.

        Within `radius` cells it may cross inflated space at the highest cost, no nearer to an obstacle than it stands.
        """
        costs, here = self.costs.copy(), self._distance(row, column)
        for r in range(row - radius, row + radius + 1):
            for c in range(column - radius, column + radius + 1):
                near = self.contains(r, c) and hypot(r - row, c - column) <= radius
                if near and not costs[r, c] and (self._distance(r, c) >= max(here, 1.0) or (r, c) == (row, column)):
                    costs[r, c] = self.max_cost
        return costs

    def is_known_free(self, points: Float64s) -> Bools:
        """(n,) bool: which points (n, 2) m in `map` lie in cells that the map knows to be free."""
        h, w = self.cells.shape
        columns, rows = np.floor((points - self.origin) / self.resolution).astype(np.int64).T - self.pad
        inside = (rows >= 0) & (columns >= 0) & (rows < h) & (columns < w)
        percent = self.cells[np.clip(rows, 0, h - 1), np.clip(columns, 0, w - 1)]
        return np.asarray(inside & (percent >= 0) & (percent <= FREE_UP_TO))

    def _distance(self, row: int, column: int) -> float:
        row, column = row - self.pad, column - self.pad
        h, w = self.distance.shape
        return float(self.distance[row, column]) if 0 <= row < h and 0 <= column < w else float(self.reach_cells)

    def _window_in_reach(self, r0: int, c0: int, r1: int, c1: int) -> Window:
        """The window of cells with distances that a change inside a window can alter."""
        (h, w), reach = self.cells.shape, self.reach_cells
        return max(r0 - reach, 0), max(c0 - reach, 0), min(r1 + reach, h), min(c1 + reach, w)

    def _update_distances(self, r0: int, c0: int, r1: int, c1: int) -> Window:
        """Computes the distances around changed cells. Returns the window with new distances."""
        window = r0, c0, r1, c1 = self._window_in_reach(r0, c0, r1, c1)
        near_r0, near_c0, near_r1, near_c1 = self._window_in_reach(*window)
        away = distance_field(self.cells[near_r0:near_r1, near_c0:near_c1] >= OCCUPIED_FROM, 1.0)
        part = away[r0 - near_r0 : r1 - near_r0, c0 - near_c0 : c1 - near_c0]
        np.minimum(part, np.float32(self.reach_cells), out=self.distance[r0:r1, c0:c1])
        return window


def _changed_windows(changed: Bools) -> list[Window]:
    """Windows that hold all changed cells, (h, w) bool: one for each group of adjacent tiles."""
    windows = []
    for first_row, first_column, rows_end, columns_end in tile_groups(_changed_tiles(changed.view(np.uint64))):
        r0, c0 = first_row * TILE_CELLS, first_column * TILE_CELLS
        part = changed[r0 : rows_end * TILE_CELLS, c0 : columns_end * TILE_CELLS]
        down, across = np.flatnonzero(part.any(axis=1)), np.flatnonzero(part.any(axis=0))
        windows.append((r0 + int(down[0]), c0 + int(across[0]), r0 + int(down[-1]) + 1, c0 + int(across[-1]) + 1))
    return windows


def tile_groups(tiles: Bools) -> list[Window]:
    """The bounding window of each group of tiles, (h, w) bool, that touch by edge or corner; by their first tile.

    As scipy.ndimage.label and find_objects, whose import costs every process of the stack 10 MB.
    """
    left = dict.fromkeys(zip(*(index.tolist() for index in np.nonzero(tiles)), strict=True))
    windows = []
    while left:
        group = [next(iter(left))]
        del left[group[0]]
        for row, column in group:  # it grows meanwhile
            for near in product((row - 1, row, row + 1), (column - 1, column, column + 1)):
                if near in left:
                    del left[near]
                    group.append(near)
        rows, columns = zip(*group, strict=True)
        windows.append((min(rows), min(columns), max(rows) + 1, max(columns) + 1))
    return windows


@njit(cache=True, nogil=True)
def _changed_tiles(eights: UInt64s) -> Bools:
    """Which tiles hold a changed cell. eights: the cells as uint64, eight cells a number."""
    h, w = eights.shape
    per_tile = TILE_CELLS // 8
    tiles = np.zeros((h // TILE_CELLS, w // per_tile), np.bool_)
    for row in range(h):
        for column in range(w):
            if eights[row, column]:
                tiles[row // TILE_CELLS, column // per_tile] = True
    return tiles


def cost_by_distance(config: CostConfig, robot: Robot, resolution: float, reach_cells: int) -> UInt16s:
    """(reach_cells^2 + 1,) uint16: a known cell's cost by its squared distance (cells^2) to the nearest obstacle.

    0 under the inscribed radius with margin. Beyond it `1 + weight * exp(-falloff * d)`, as in Nav2's inflation layer,
    shifted to reach 1 at the inflation radius. Under the circumscribed radius `narrow_weight` is added.
    """
    margin = required_clearance(config.margin, resolution)
    nearest, turning = robot.inscribed_radius + margin, robot.circumscribed_radius + margin
    end = exp(-config.clearance_falloff * max(config.inflation_radius - nearest, 0.0))
    distance = np.sqrt(np.arange(reach_cells**2 + 1)) * resolution
    close = (np.exp(-config.clearance_falloff * (distance - nearest)) - end) / max(1 - end, 1e-9)
    factor = 1 + config.clearance_weight * np.clip(close, 0, 1) + config.narrow_weight * (distance < turning - 1e-9)
    return np.where(distance < nearest - 1e-9, 0, np.rint(UNIT_COST * factor)).astype(np.uint16)


@njit(cache=True, nogil=True)
def _fill_costs(cells: Int8s, distance: Float32s, by_distance: UInt16s, unknown_cost: int, costs: UInt16s) -> None:
    h, w = cells.shape
    for row in range(h):
        for column in range(w):
            squared = distance[row, column] * distance[row, column]
            cost = int(by_distance[int(squared + np.float32(0.5))])
            percent = cells[row, column]
            if cost and (percent < 0 or FREE_UP_TO < percent < OCCUPIED_FROM):
                cost = cost + unknown_cost if unknown_cost >= 0 else 0
            costs[row, column] = cost


def _raise_costs(costs: UInt16s, penalized: Bools) -> None:
    costs[penalized & (costs > 0)] += LEAVE_PENALTY
