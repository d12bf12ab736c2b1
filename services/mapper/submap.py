# SPDX-License-Identifier: Apache-2.0
"""A piece of the map to match with: surface points, and what is free between them."""

import numpy as np
from numpy.typing import NDArray

from services.mapper.keyframe import Float32s, Keyframe
from services.mapper.kiss_registration import KissRegistrar
from services.mapper.occupancy import TILE_ARRAYS, Occupancy, OccupancyConfig
from services.mapper.registration import LineRegistrar, Match, RegistrationConfig
from services.mapper.surface import grid_surface
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import MapUpdate

Float64s = NDArray[np.float64]

REGISTRARS: dict[str, type[LineRegistrar]] = {"line": LineRegistrar, "kiss": KissRegistrar}

QUICK = {"hit": 0.7, "miss": 0.36, "behind": 0.0}
"""Of `OccupancyConfig`: here few scans must tell enough, so one echo is a wall, and two crossings are free."""


class Submap:
    """Surface points to match with, and what is known to be free between them, in one frame."""

    def __init__(self, registration: RegistrationConfig, occupancy: OccupancyConfig, range_max: float) -> None:
        occupancy = occupancy.model_copy(update=QUICK)
        self.registrar = REGISTRARS[registration.registrar](registration, range_max)
        self.grid = Occupancy(occupancy, 0)

    def extend(self, pose: Pose2, points: Float64s, normals: Float64s) -> None:
        """Adds a keyframe: surface points (n, 2) m in `base` with normals."""
        self.registrar.extend(pose @ points, Pose2(0, 0, pose.yaw) @ normals)

    def take(self, keyframe: Keyframe, pose: Pose2) -> None:
        """Adds a keyframe at a pose, and draws it."""
        self.extend(pose, *keyframe.surface())
        keyframe.draw(self.grid, pose)

    def sign(self, pose: Pose2, doubt: Float64s | Float32s, stamp: int) -> None:
        """What is new since the last call was drawn from a pose with this covariance (3, 3), at stamp ns."""
        self.registrar.map.sign(pose.x, pose.y, doubt, stamp)

    def forget(self) -> None:
        """Forgets points where beams have gone through since: who walked there would hold the robot back."""
        points = self.registrar.map.points[: self.registrar.map.n, :2]
        there = np.isfinite(points[:, 0])
        gone = np.zeros(len(points), np.bool_)
        gone[there] = self.grid.clear_at(points[there], 1)
        self.registrar.forget(gone)

    def draw(self, origins: Float64s, ends: Float64s) -> None:
        """Draws beams, (n, 2) m in its frame."""
        self.grid.integrate(origins, ends, np.full_like(ends, np.nan))

    def load(self, grid: OccupancyGrid, update: MapUpdate) -> None:
        """Takes a map that has no keyframes; grid: the update's."""
        self.registrar.extend(*grid_surface(grid.occupied, grid.free, grid.x0, grid.y0, grid.resolution))
        self.grid.load(update)

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
