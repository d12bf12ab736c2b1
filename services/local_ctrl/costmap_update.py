# SPDX-License-Identifier: Apache-2.0
"""Brings a local costmap up to date: the robot's place, the map below it, zones and contacts, and distances.

The order of the layers is our own.
"""

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
