# SPDX-License-Identifier: Apache-2.0
"""What crossing a cell costs the robot: obstacles inflated by exact distance, unknown space by policy."""

from math import ceil, exp
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field
from scipy import ndimage

from shared.config import Robot, Section
from shared.distance_field import distance_field
from shared.grid import FREE_UP_TO, OCCUPIED_FROM, OccupancyGrid

Bools = NDArray[np.bool_]
Int8s = NDArray[np.int8]
Int32s = NDArray[np.int32]
Float32s = NDArray[np.float32]
Float64s = NDArray[np.float64]
UInt16s = NDArray[np.uint16]

UNIT = 50
"""The cost of a cell that costs nothing extra; a cell of cost 150 is three times as long. 0 is blocked."""


class CostConfig(Section):
    """How obstacles and unknown space lengthen a way."""

    margin: float = Field(0.07, ge=0, le=1, description="m kept free around the footprint's inscribed circle")
    least_margin: float = Field(0.03, ge=0, le=1, description="m kept free around it where there is no other way")
    inflation_radius: float = Field(
        1.0, gt=0, le=5, description="m from an obstacle at which it stops to matter for the plan"
    )
    clearance_weight: float = Field(
        5.0, ge=0, le=100, description="times its length that a way costs more where it just fits; more keeps off walls"
    )
    clearance_falloff: float = Field(4.0, gt=0, le=50, description="1/m: how fast that extra cost falls with distance")
    narrow_weight: float = Field(
        2.0, ge=0, le=100, description="times its length that a way costs more where the robot cannot turn on the spot"
    )
    unknown: Literal["allowed", "costly", "forbidden"] = Field(
        "costly", description="ways through space that nobody has seen"
    )
    unknown_weight: float = Field(
        2.0, ge=0, le=100, description="times its length that a way through unknown space costs more, where `costly`"
    )
    beyond_map: float = Field(
        0.0, ge=0, le=50, description="m outside the map's tiles that count as unknown space instead of as outside"
    )


class Terrain:
    """The costs of a map for a robot, and which cells hang together; kept up to date from the changed cells.

    `costs` (h + 2 pad, w + 2 pad) uint16: UNIT and more, 0 blocked; its outermost ring is blocked, so that a search
    needs no bounds. `regions`: same shape, int32, equal numbers can be reached from each other, 0 blocked.
    """

    def __init__(self, config: CostConfig, robot: Robot, resolution: float) -> None:
        self.config, self.robot = config, robot
        self.resolution = resolution
        self.blocked_under = robot.inscribed_radius + config.margin
        radius = max(config.inflation_radius, self.blocked_under, robot.circumscribed_radius + config.margin)
        self.reach_cells = ceil(radius / resolution)
        beyond = config.beyond_map if config.unknown != "forbidden" else 0.0
        self.pad = 1 + ceil(beyond / resolution)
        self.by_distance = cost_by_distance(config, robot, resolution, self.reach_cells)
        self.unknown_cost = {
            "allowed": 0,
            "costly": round(UNIT * config.unknown_weight),
            "forbidden": -1,
        }[config.unknown]
        self.distance: Float32s = np.zeros((0, 0), np.float32)  # cells to the nearest obstacle, at most reach_cells
        self.costs: UInt16s = np.zeros((2, 2), np.uint16)
        self.regions: Int32s = np.zeros((2, 2), np.int32)
        self.origin = (0.0, 0.0)  # m, lower left corner of costs[0, 0] in `map`
        self.cells: Int8s = np.zeros((0, 0), np.int8)  # the map's, percent
        self.highest = UNIT

    def update(self, grid: OccupancyGrid, changed: Bools | None) -> None:
        """Takes the map. `changed`: (h, w) bool, the cells that differ from the map of the last call; None: all."""
        occupied = grid.occupied
        if changed is None or occupied.shape != self.distance.shape:
            self.distance = np.minimum(distance_field(occupied, 1.0), np.float32(self.reach_cells))
        elif changed.any():
            self._redistance(occupied, changed)
        self.cells = grid.cells
        self.origin = (grid.x0 - self.pad * self.resolution, grid.y0 - self.pad * self.resolution)
        self._fill()

    def eased(self) -> "Terrain":
        """The same map for a robot that keeps only the least margin: its way where there is no other."""
        margin = min(self.config.least_margin, self.config.margin)
        eased = Terrain(self.config.model_copy(update={"margin": margin}), self.robot, self.resolution)
        eased.distance, eased.cells, eased.origin, eased.reach_cells = (
            self.distance,
            self.cells,
            self.origin,
            self.reach_cells,
        )
        eased.by_distance = cost_by_distance(eased.config, self.robot, self.resolution, self.reach_cells)
        eased._fill()
        return eased

    def _fill(self) -> None:
        """The costs by distance and what is known, and the regions."""
        h, w = self.cells.shape
        pad = self.pad
        costs = np.full((h + 2 * pad, w + 2 * pad), 0, np.uint16)
        if pad > 1:
            costs[1:-1, 1:-1] = UNIT + self.unknown_cost
        _fill_costs(self.cells, self.distance, self.by_distance, self.unknown_cost, costs[pad : pad + h, pad : pad + w])
        self.costs = costs
        # diagonal steps need both straight neighbours free, so what hangs together does so by straight steps
        self.regions = ndimage.label(costs, output=np.int32)[0]
        self.highest = max(int(costs.max()), UNIT)

    def cell(self, x: float, y: float) -> tuple[int, int]:
        """(row, column) in `costs` of a point of `map`; may lie outside."""
        x0, y0 = self.origin
        return int((y - y0) // self.resolution), int((x - x0) // self.resolution)

    def centre(self, row: int, column: int) -> tuple[float, float]:
        """(x, y) m in `map` of a cell of `costs`."""
        x0, y0 = self.origin
        return x0 + (column + 0.5) * self.resolution, y0 + (row + 0.5) * self.resolution

    def holds(self, row: int, column: int) -> bool:
        """Whether the cell lies inside the blocked outer ring."""
        h, w = self.costs.shape
        return bool(0 < row < h - 1 and 0 < column < w - 1)

    def occupied(self, row: int, column: int) -> bool:
        """Whether the map says that an obstacle is in the cell of `costs`."""
        return self._distance(row, column) == 0

    def crowded(self, row: int, column: int) -> bool:
        """Whether an obstacle is nearer to the cell of `costs` than the robot's body allows."""
        return bool(self._distance(row, column) * self.resolution < self.blocked_under)

    def known_free(self, points: Float64s) -> Bools:
        """(n,) bool: which points (n, 2) m of `map` the map knows to be free."""
        h, w = self.cells.shape
        columns, rows = np.floor((points - self.origin) / self.resolution).astype(np.int64).T - self.pad
        inside = (rows >= 0) & (columns >= 0) & (rows < h) & (columns < w)
        percent = self.cells[np.clip(rows, 0, h - 1), np.clip(columns, 0, w - 1)]
        return np.asarray(inside & (percent >= 0) & (percent <= FREE_UP_TO))

    def _distance(self, row: int, column: int) -> float:
        row, column = row - self.pad, column - self.pad
        h, w = self.distance.shape
        return float(self.distance[row, column]) if 0 <= row < h and 0 <= column < w else float(self.reach_cells)

    def _redistance(self, occupied: Bools, changed: Bools) -> None:
        """Only what lies within reach of a change can have another distance; obstacles within reach of that decide."""
        rows, columns = np.flatnonzero(changed.any(axis=1)), np.flatnonzero(changed.any(axis=0))
        reach = self.reach_cells
        r0, r1 = max(int(rows[0]) - reach, 0), int(rows[-1]) + 1 + reach
        c0, c1 = max(int(columns[0]) - reach, 0), int(columns[-1]) + 1 + reach
        near_r0, near_c0 = max(r0 - reach, 0), max(c0 - reach, 0)
        window = distance_field(occupied[near_r0 : r1 + reach, near_c0 : c1 + reach], 1.0)
        part = self.distance[r0:r1, c0:c1]
        dr, dc = r0 - near_r0, c0 - near_c0
        np.minimum(window[dr : dr + part.shape[0], dc : dc + part.shape[1]], np.float32(reach), out=part)


def cost_by_distance(config: CostConfig, robot: Robot, resolution: float, reach_cells: int) -> UInt16s:
    """(reach_cells^2 + 1,) uint16: a known cell's cost by its squared distance (cells^2) to the nearest obstacle.

    0 under the inscribed radius and margin; then `1 + weight * exp(-falloff * d)` as in Nav2's inflation layer, shifted
    to end at 1 at the inflation radius; more under the circumscribed radius, where the heading is not free.
    """
    nearest = robot.inscribed_radius + config.margin
    turning = robot.circumscribed_radius + config.margin
    end = exp(-config.clearance_falloff * max(config.inflation_radius - nearest, 0.0))
    distance = np.sqrt(np.arange(reach_cells**2 + 1)) * resolution
    close = (np.exp(-config.clearance_falloff * (distance - nearest)) - end) / max(1 - end, 1e-9)
    factor = 1 + config.clearance_weight * np.clip(close, 0, 1) + config.narrow_weight * (distance < turning - 1e-9)
    return np.where(distance < nearest - 1e-9, 0, np.rint(UNIT * factor)).astype(np.uint16)


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
