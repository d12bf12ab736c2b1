# SPDX-License-Identifier: Apache-2.0
"""The map as the planner plans on it: keep-out zones are obstacles, and one that the robot stands in is dear."""

from copy import copy

import numpy as np
from numpy.typing import NDArray

from services.planner.traversal_cost import Terrain
from shared.distance_field import distance_field
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import Zones
from shared.zones import OBSTACLE, KeepOut, holds, marked

Bools = NDArray[np.bool_]
Int64s = NDArray[np.int64]


class Zoning:
    """Follows the zones and the robot."""

    def __init__(self, reach: float) -> None:
        """reach: m from the robot's middle to the farthest point of its outline."""
        self._keep_out = KeepOut(reach)
        self._terrain: Terrain | None = None  # which has the three at the end
        self._place: object = None  # of the grid for which they were made
        self._barred: Int64s = np.zeros(0, np.int64)  # places of the cells that zones bar, row by row
        self._dear: Bools | None = None
        self._shut: Bools | None = None

    def take(self, zones: Zones) -> None:
        """Other zones hold from now on."""
        self._keep_out.take(zones)
        self._place = self._terrain = None

    def moved(self, pose: Pose2) -> bool:
        """The robot is at a pose in `map`; whether the map is another one to it now."""
        changed = self._keep_out.moved(pose)
        self._place = None if changed else self._place
        return changed

    def forbids(self, pose: Pose2) -> bool:
        """Whether a pose lies in a keep-out zone, also in one that the robot stands in."""
        return any(holds(polygon, pose.x, pose.y) for polygon in self._keep_out.polygons)

    def update(self, terrain: Terrain, grid: OccupancyGrid, changed: Bools | None) -> None:
        """Updates the terrain to the map and the zones; None: all of it, which it must be after `take` and `moved`."""
        if not self._keep_out.polygons and not self._place:
            terrain.zoned(None, None)
            terrain.update(grid, changed)
            return
        place = grid.cells.shape, grid.x0, grid.y0, grid.resolution
        if self._place != place or self._terrain is not terrain:
            self._place, self._terrain, changed = place, terrain, None
            self._mark(grid, terrain)
            terrain.zoned(self._dear, self._shut)
        zoned = copy(grid)
        zoned.cells = grid.cells.copy()
        zoned.cells.reshape(-1)[self._barred] = OBSTACLE
        terrain.update(zoned, changed)

    def _mark(self, grid: OccupancyGrid, terrain: Terrain) -> None:
        """Finds the cells that zones bar, those at zones that the robot stands in, and those barred beyond the map."""
        entered, holding = self._keep_out.entered, self._keep_out.holding
        self._dear, self._shut = None, None
        self._barred = np.flatnonzero(marked(grid, holding))
        if entered:
            self._dear = _near(marked(grid, entered), grid.resolution, terrain.blocked_under)
        if holding and terrain.pad > 1:
            self._shut = _near(marked(grid, holding, terrain.pad), grid.resolution, terrain.blocked_under)


def _near(cells: Bools, resolution: float, within: float) -> Bools:
    return np.asarray(distance_field(cells, resolution) < within)
