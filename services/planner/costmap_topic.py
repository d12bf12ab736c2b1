# SPDX-License-Identifier: Apache-2.0
"""The debug topic of the planner: the global costmap, published only while a client watches. Values as in Nav2."""

from copy import copy
from math import ceil, sqrt

import numpy as np

from services.planner.costmap import UNIT_COST, CostConfig, GlobalCostmap
from services.planner.keep_out_layer import KeepOutLayer
from shared.config import Robot
from shared.grid import FREE_UP_TO, OCCUPIED_FROM, OccupancyGrid
from shared.messages import Costmap
from shared.types import Int8s

PERIOD_NS = 2_000_000_000  # between two messages
MAX_CELLS = 2**20  # of a message: 51 m squared at 5 cm a cell
OCCUPIED, TOUCHING, MAX_FREE, UNKNOWN = 100, 99, 98, -1
"""as nav2_costmap_2d publishes its costs: lethal, inscribed, the highest other cost, no information."""


def costmap_message(costmap: GlobalCostmap, now: int) -> Costmap:
    """The costs of the map's cells in `map`. now: ns.

    Zones are occupied. A map of more than MAX_CELLS has larger cells, each with the highest cost in it.
    """
    pad, resolution = costmap.pad, costmap.resolution
    costs = costmap.costs[pad:-pad, pad:-pad].astype(np.float32)
    scale = MAX_FREE / max(costmap.max_cost - UNIT_COST, 1)
    cells = np.clip(np.rint(scale * (costs - UNIT_COST)), 0, MAX_FREE).astype(np.int8)
    cells[(costmap.cells < 0) | (costmap.cells > FREE_UP_TO)] = UNKNOWN
    cells[costmap.distance * resolution < costmap.min_clearance - 1e-9] = TOUCHING
    cells[costmap.cells >= OCCUPIED_FROM] = OCCUPIED
    factor = ceil(sqrt(cells.size / MAX_CELLS))
    x, y = (corner + pad * resolution for corner in costmap.origin)
    return Costmap(now, x, y, factor * resolution, _highest(cells, factor))


def separate_costmap(config: CostConfig, robot: Robot, grid: OccupancyGrid, keep_out: KeepOutLayer) -> GlobalCostmap:
    """The present costs for a client that watches. The planner's own costmap stays as it is: so do its plans."""
    costmap = GlobalCostmap(config, robot, grid.resolution)
    copy(keep_out).update(costmap, grid, None)
    return costmap


def _highest(cells: Int8s, factor: int) -> Int8s:
    """The highest value in each square of `factor` cells a side, (ceil(h / factor), ceil(w / factor))."""
    (h, w), n = cells.shape, factor
    padded = np.pad(cells, ((0, -h % n), (0, -w % n)), constant_values=UNKNOWN)
    return np.asarray(padded.reshape(-(-h // n), n, -(-w // n), n).max(axis=(1, 3)))
