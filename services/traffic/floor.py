# SPDX-License-Identifier: Apache-2.0
"""The floor that a robot may drive on: the map, with the keep-out zones as walls, as its planner sees it."""

from copy import copy

from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.joint_map import JointMap
from shared.messages import MapUpdate, Zones
from shared.zones import KeepOut, laid


class Floor:
    """The newest map and zones. version: another number for every other floor."""

    def __init__(self, reach: float) -> None:
        """reach: circumscribed radius of the robot, m."""
        self._map, self._keep_out = JointMap(), KeepOut(reach)
        self._walled: OccupancyGrid | None = None
        self.version = 0

    def apply(self, update: MapUpdate) -> None:
        """Takes tiles of the map."""
        self._map.apply(update)
        self._renew()

    def apply_others(self, update: MapUpdate) -> None:
        """Takes tiles of what the robots know that it explores with."""
        self._map.apply_others(update)
        self._renew()

    def set_zones(self, zones: Zones) -> None:
        """Replaces the zones."""
        self._keep_out.take(zones)
        self._renew()

    def grid(self, pose: Pose2) -> OccupancyGrid:
        """The map with the zones that a robot at a pose in `map` may not enter: it may leave one that it stands in."""
        if self._keep_out.moved(pose):
            self._renew()
        if self._walled is None:
            self._walled = copy(self._map.grid)
            self._walled.cells = laid(self._map.grid, self._keep_out.holding)
        return self._walled

    def _renew(self) -> None:
        self._walled, self.version = None, self.version + 1
