# SPDX-License-Identifier: Apache-2.0
"""The map for ROS 2 nodes: the whole one from time to time, and in between the rectangle that changed."""

from typing import Any

import numpy as np

from shared.grid import OccupancyGrid
from shared.messages import MapUpdate
from shared.ros_messages import RosMessages
from shared.types import NS_PER_S, Int8s

GRID_UPDATE = "map_msgs/msg/OccupancyGridUpdate"
MAP_AGAIN_NS = 5 * NS_PER_S
"""after which the map is sent again: a subscription of ROS may miss the latched one (docs/ros2.md)."""


class OutgoingMap:
    """The present map, and the whole one that was sent last. min_interval: ns between two whole maps after changes."""

    def __init__(self, make: RosMessages, min_interval: int) -> None:
        self._make, self._min_interval = make, min_interval
        self._grid = OccupancyGrid()
        self._stamp = 0
        self._is_changed = False
        self._sent_at: int | None = None  # ns on the stack's clock
        self._sent: tuple[object, Int8s] | None = None  # place and cells of the whole map that was sent last

    def add(self, update: MapUpdate) -> None:
        """Takes tiles."""
        self._grid.apply(update)
        self._stamp, self._is_changed = update.stamp, True

    def send_now(self) -> None:
        """A new subscriber: the whole map is due."""
        self._sent_at = None

    def due(self, now: int) -> Any:
        """nav_msgs/OccupancyGrid of the whole map, where it is due at `now` (ns); else None."""
        if self._grid.empty:
            return None
        since = None if self._sent_at is None else now - self._sent_at
        wait = self._min_interval if self._is_changed else MAP_AGAIN_NS
        if since is not None and 0 <= since < wait:
            return None
        self._sent_at, self._is_changed = now, False
        self._sent = self._place, self._grid.cells
        return self._make.occupancy(self._grid, self._stamp)

    def change(self) -> Any:
        """map_msgs/OccupancyGridUpdate: the rectangle of all cells that differ from the whole map sent last.

        So a lost update does no harm. None where no cell differs, and where the map has another place or size: the
        whole map follows then.
        """
        if self._sent is None or self._sent[0] != self._place:
            return None
        rows, columns = np.nonzero(self._sent[1] != self._grid.cells)
        if not len(rows):
            return None
        top, left = int(rows.min()), int(columns.min())
        part = self._grid.cells[top : int(rows.max()) + 1, left : int(columns.max()) + 1]
        header = self._make.header(self._stamp, self._make.frames.map)
        height, width = part.shape
        return self._make.new(GRID_UPDATE, header=header, x=left, y=top, width=width, height=height, data=part.ravel())

    @property
    def _place(self) -> object:
        grid = self._grid
        return grid.map_id, grid.resolution, grid.first_row, grid.first_column, grid.cells.shape
