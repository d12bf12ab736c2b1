# SPDX-License-Identifier: Apache-2.0
"""The costmap of the newest map and zones: changes are collected, and the costs follow when asked for (our own)."""

from services.planner.costmap import CostConfig, GlobalCostmap
from services.planner.costmap_topic import separate_costmap
from services.planner.keep_out_layer import KeepOutLayer
from shared.config import Robot
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.joint_map import JointMap
from shared.messages import MapUpdate, Zones
from shared.types import Bools, Float64s


class PresentCostmap:
    """The map that is planned on, with its zones and costs. updated_at: ns, of the costs."""

    def __init__(self, config: CostConfig, robot: Robot) -> None:
        self.config, self.robot = config, robot
        self.costmap: GlobalCostmap | None = None
        self.updated_at: int | None = None
        self._maps, self._keep_out = JointMap(), KeepOutLayer(robot.circumscribed_radius)
        self._changed: Bools | None = None  # cells of the map since the update; None: all
        self._is_current = True

    @property
    def grid(self) -> OccupancyGrid:
        """The robot's map, and where that is not sure what the robots know that it explores with."""
        return self._maps.grid

    def configure(self, config: CostConfig) -> None:
        """Takes other settings."""
        self.config, self.costmap = config, None

    def apply(self, update: MapUpdate) -> bool:
        """Takes tiles of the own map. Returns whether another map begins with them."""
        before, shape = (self.grid.map_id, self.grid.resolution), self.grid.cells.shape
        changed = self._maps.apply(update)
        begins = (self.grid.map_id, self.grid.resolution) != before
        if begins:
            self.costmap = None
        self._collect(changed, shape)
        return begins

    def apply_others(self, update: MapUpdate) -> None:
        """Takes tiles of what the others know."""
        shape = self.grid.cells.shape
        self._collect(self._maps.apply_others(update), shape)

    def _collect(self, changed: Bools, shape: tuple[int, ...]) -> None:
        same = self.costmap is not None and changed.shape == shape
        if self._is_current:
            self._changed = changed if same else None
        elif self._changed is not None:
            self._changed = self._changed | changed if same else None
        self._is_current = False

    def set_zones(self, zones: Zones) -> None:
        """Replaces the zones."""
        self._keep_out.set_zones(zones)
        self._renew()

    def set_temporary(self, polygons: tuple[Float64s, ...]) -> None:
        """Replaces the polygons (n, 2) m in `map` of contacts, and of robots that stand."""
        self._keep_out.set_temporary(polygons)
        self._renew()

    def _renew(self) -> None:
        self._changed, self._is_current = None, False

    def is_forbidden(self, pose: Pose2) -> bool:
        """Whether a pose lies in a user's keep-out zone."""
        return self._keep_out.is_forbidden(pose)

    def at(self, pose: Pose2, now: int) -> GlobalCostmap:
        """The costs for a robot at a pose in `map`. now: ns."""
        if self._keep_out.update_pose(pose):
            self._renew()
        if self.costmap is None:
            self.costmap = GlobalCostmap(self.config, self.robot, self.grid.resolution)
            self._renew()
        if not self._is_current:
            self._keep_out.update(self.costmap, self.grid, self._changed)
            self._is_current, self.updated_at = True, now
        return self.costmap

    def shown(self) -> GlobalCostmap:
        """The present costs for a client that watches. Those of the plans stay as they are."""
        current = self.costmap if self._is_current else None
        return current or separate_costmap(self.config, self.robot, self.grid, self._keep_out)
