# SPDX-License-Identifier: Apache-2.0
"""Keep-out zones on the planner's map: their cells are obstacles; those of a zone around the robot only cost more.

After Nav2's KeepoutFilter, with polygons in place of a mask. The cost at which a robot leaves a zone is our own.
"""

from copy import copy

import numpy as np

from services.planner.costmap import GlobalCostmap
from shared.distance_field import distance_field
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import Zones
from shared.polygon import contains
from shared.types import Bools, Float64s, Int64s
from shared.zones import OBSTACLE, KeepOut, keep_outs, marked, position


class KeepOutLayer:
    """Marks the cells of the keep-out zones in the map, for the present zones and pose."""

    def __init__(self, reach: float) -> None:
        """reach: circumscribed radius of the robot, m."""
        self._keep_out = KeepOut(reach)
        self._zones: tuple[Float64s, ...] = ()  # polygons, m in `map`
        self._temporary: tuple[Float64s, ...] = ()  # the same, of contacts and of robots that stand
        self._costmap: GlobalCostmap | None = None  # that the three masks at the end were made for
        self._grid_geometry: object = None  # shape, origin and resolution of the grid that they were made for
        self._blocked_cells: Int64s = np.zeros(0, np.int64)  # flat indices of the cells in zones
        self._penalized: Bools | None = None
        self._closed: Bools | None = None

    def set_zones(self, zones: Zones) -> None:
        """Replaces the zones."""
        self._zones = keep_outs(zones)
        self._apply()

    def set_temporary(self, polygons: tuple[Float64s, ...]) -> None:
        """Replaces the polygons (n, 2) m in `map` of contacts, and of robots that stand: they are zones, too."""
        self._temporary = polygons
        self._apply()

    def _apply(self) -> None:
        self._keep_out.take_polygons((*self._zones, *self._temporary))
        self._grid_geometry = self._costmap = None

    def update_pose(self, pose: Pose2) -> bool:
        """Takes the robot's pose in `map`. Returns whether the blocked cells changed by it."""
        changed = self._keep_out.moved(pose)
        self._grid_geometry = None if changed else self._grid_geometry
        return changed

    def is_forbidden(self, pose: Pose2) -> bool:
        """Whether a pose lies in a user's keep-out zone, also in one that the robot stands in."""
        return any(contains(polygon, position(pose))[0] for polygon in self._zones)

    def update(self, costmap: GlobalCostmap, grid: OccupancyGrid, changed: Bools | None) -> None:
        """Updates the costmap to the map with the zones.

        changed: (h, w) bool, cells that differ from the last call; None: all. It must be None after `set_zones`, and
        after `update_pose` returned True.
        """
        if not self._keep_out.polygons and not self._grid_geometry:
            costmap.set_keep_out(None, None)
            costmap.update(grid, changed)
            return
        geometry = grid.cells.shape, grid.x0, grid.y0, grid.resolution
        if self._grid_geometry != geometry or self._costmap is not costmap:
            self._grid_geometry, self._costmap, changed = geometry, costmap, None
            self._find_cells(grid, costmap)
            costmap.set_keep_out(self._penalized, self._closed)
        zoned_grid = copy(grid)
        zoned_grid.cells = grid.cells.copy()
        zoned_grid.cells.reshape(-1)[self._blocked_cells] = OBSTACLE
        costmap.update(zoned_grid, changed)

    def _find_cells(self, grid: OccupancyGrid, costmap: GlobalCostmap) -> None:
        """Finds the cells of zones: blocked ones, penalized ones (around the robot) and blocked ones beyond the map."""
        entered, holding = self._keep_out.entered, self._keep_out.holding
        self._penalized, self._closed = None, None
        self._blocked_cells = np.flatnonzero(marked(grid, holding))
        if entered:
            self._penalized = _cells_within(marked(grid, entered), grid.resolution, costmap.min_clearance)
        if holding and costmap.pad > 1:
            self._closed = _cells_within(marked(grid, holding, costmap.pad), grid.resolution, costmap.min_clearance)


def _cells_within(cells: Bools, resolution: float, within: float) -> Bools:
    return np.asarray(distance_field(cells, resolution) < within)
