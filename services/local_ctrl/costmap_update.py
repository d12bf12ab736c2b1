# SPDX-License-Identifier: Apache-2.0
"""Brings a local costmap up to date: the robot's place, the map below it, zones and contacts, and distances.

The order of the layers is our own.
"""

import numpy as np

from services.local_ctrl.footprint import Footprint
from services.local_ctrl.inputs import ControlInputs
from services.local_ctrl.local_costmap import LocalCostmap
from services.local_ctrl.zones import LocalZones
from shared.geometry import Pose2
from shared.grid import OccupancyGrid


def update_costmap(
    costmap: LocalCostmap,
    inputs: ControlInputs,
    grid: OccupancyGrid,
    zones: LocalZones,
    footprint: Footprint,
    now: int,
) -> None:
    """Centres a costmap on the robot and updates its map, zones and distances. grid: the map.  now: ns."""
    here = inputs.odometry.odom_from_base
    costmap.recentre(here.x, here.y)
    if inputs.pose is not None:
        odom_from_map, map_id = inputs.odom_from_map, grid.map_id
        costmap.set_static_map(grid, odom_from_map)
        window = costmap.x0, costmap.y0, costmap.resolution, len(costmap.field)
        costmap.forbidden_cells = zones.forbidden_cells(odom_from_map, here, window, map_id)
    else:
        costmap.set_static_map(OccupancyGrid(), Pose2())
        costmap.forbidden_cells = None
    costmap.refresh(now, here, footprint)


def clear_costmap(costmap: LocalCostmap, inputs: ControlInputs, side: float, outside: bool) -> bool:
    """Clears a costmap, or a square about the robot, or all but that. side: m; 0: everything.

    False where there is no odometry yet: then the robot has no place.
    """
    if not side:
        costmap.clear()
        return True
    if inputs.odometry.latest is None:
        return False
    here = inputs.odometry.odom_from_base
    clear_square(costmap, here.x, here.y, side, outside)
    return True


def clear_square(costmap: LocalCostmap, x: float, y: float, side: float, outside: bool) -> None:
    """Clears a square about (x, y), m in `odom`, or all but that. side: m, along the axes of `odom`."""
    offsets = np.arange(len(costmap.evidence)) * costmap.resolution
    rows, columns = (np.abs(start + offsets) <= side / 2 for start in (costmap.y0 - y, costmap.x0 - x))
    cells = np.logical_and.outer(rows, columns) != outside
    for layer in (costmap.evidence, costmap.hit_at, costmap.free_at, costmap.echo_at):
        layer[cells] = 0
    costmap.dynamic_obstacles.clear_square(x, y, side, outside)
