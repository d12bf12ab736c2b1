# SPDX-License-Identifier: Apache-2.0
"""What the last scans are matched with: a window of the way, that moves on with the robot.

Two submaps grow at a time, one half a window behind the other, as in Cartographer (Hess et al., ICRA 2016, section IV):
when the older is full, the younger one takes its place. So a scan is never matched with what was drawn long ago from
somewhere else: how that lies to this is for the pose graph to say.
"""

import numpy as np
from numpy.typing import NDArray

from services.mapper.occupancy import TILE_ARRAYS, Occupancy, OccupancyConfig
from services.mapper.registration import REGISTRARS, Match, RegistrationConfig
from services.mapper.surface import grid_surface
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import MapUpdate

Float64s = NDArray[np.float64]


class Submap:
    """Surface points to match with, and what is known to be free between them, in one frame."""

    def __init__(self, registration: RegistrationConfig, occupancy: OccupancyConfig, range_max: float) -> None:
        self.registrar = REGISTRARS[registration.registrar](registration, range_max)
        self.grid = Occupancy(occupancy, 0)
        self.n = 0  # keyframes

    def extend(self, pose: Pose2, points: Float64s, normals: Float64s) -> None:
        """Adds a keyframe: surface points (n, 2) m in `base` with normals."""
        self.registrar.extend(pose @ points, Pose2(0, 0, pose.yaw) @ normals)
        self.n += 1

    def balance(self, match: Match, origin: Float64s, points: Float64s) -> float:
        """Share of points (n, 2) m in `base`, seen from origin (2,), that agree in a match, less those against it."""
        pose, other = match.map_from_base, points[~match.agree]
        against = self.grid.contradicts(pose @ np.broadcast_to(origin, other.shape), pose @ other)
        return float(match.agree.sum() - against.sum()) / max(len(points), 1)

    @property
    def n_bytes(self) -> int:
        """What it takes of memory."""
        arrays = (getattr(self.grid, name) for name in TILE_ARRAYS)
        return sum(array.nbytes for array in (*arrays, *self.registrar.map.index))


class Window:
    """`active` is matched with. size: keyframes of a full submap, 0 for one that grows for ever."""

    def __init__(
        self, registration: RegistrationConfig, occupancy: OccupancyConfig, range_max: float, size: int
    ) -> None:
        self._settings = registration, occupancy, range_max
        self.size = size
        self.start()

    def start(self) -> None:
        """Forgets everything."""
        self.active = Submap(*self._settings)
        self.young: Submap | None = None

    def load(self, grid: OccupancyGrid, update: MapUpdate) -> None:
        """A saved map; it stays."""
        self.start()
        self.active.registrar.extend(*grid_surface(grid.occupied, grid.free, grid.x0, grid.y0, grid.resolution))
        self.active.grid.load(update)
        self.active.n = -1

    @property
    def moves(self) -> bool:
        """Whether it leaves behind what is old: neither a saved map, nor one that grows for ever."""
        return self.size > 0 and self.active.n >= 0

    def draw(self, origins: Float64s, ends: Float64s) -> None:
        """Draws beams, (n, 2) m in the window's frame, that are trusted."""
        silent = np.full_like(ends, np.nan)
        for submap in (self.active, self.young):
            if submap is not None:
                submap.grid.integrate(origins, ends, silent)

    def extend(self, pose: Pose2, points: Float64s, normals: Float64s) -> None:
        """Adds a keyframe: surface points (n, 2) m in `base` with normals."""
        if not self.moves:
            self.active.registrar.extend(pose @ points, Pose2(0, 0, pose.yaw) @ normals)
            return
        if self.active.n >= self.size and self.young is not None:
            self.active, self.young = self.young, None
        if self.young is None and 2 * self.active.n >= self.size:
            self.young = Submap(*self._settings)
        for submap in (self.active, self.young):
            if submap is not None:
                submap.extend(pose, points, normals)
