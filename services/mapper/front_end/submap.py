# SPDX-License-Identifier: Apache-2.0
"""The submap: surface points to align scans with, and an occupancy grid of the same area.

It has the place of Cartographer's Submap2D, which aligns with the grid instead of points. To remove points that beams
crossed is our own.
"""

import numpy as np

from services.mapper.back_end.keyframe import Keyframe
from services.mapper.front_end.kiss_registration import KissRegistrar
from services.mapper.front_end.registration import LineRegistrar, Match, RegistrationConfig
from services.mapper.front_end.surface_normals import grid_surface
from services.mapper.grid.occupancy import TILE_ARRAYS, Occupancy, OccupancyConfig
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import MapUpdate
from shared.types import Float32s, Float64s

REGISTRARS: dict[str, type[LineRegistrar]] = {"line": LineRegistrar, "kiss": KissRegistrar}

FAST_UPDATE = {"hit": 0.7, "miss": 0.36, "hit_depth": 0.0}
"""Settings of `OccupancyConfig` for few scans: one echo makes a cell occupied, two crossings make it free."""


class Submap:
    """Surface points and occupancy of the same keyframes, in one frame: `local`, or `map` for a saved map.

    range_max: m, of the laser.
    """

    def __init__(self, registration: RegistrationConfig, occupancy: OccupancyConfig, range_max: float) -> None:
        occupancy = occupancy.model_copy(update=FAST_UPDATE)
        self.registrar = REGISTRARS[registration.registrar](registration, range_max)
        self.grid = Occupancy(occupancy, 0)

    def add_points(self, pose: Pose2, points: Float64s, normals: Float64s) -> None:
        """Adds surface points (n, 2) m in `base` with normals (n, 2), seen from a pose."""
        self.registrar.add_points(pose @ points, Pose2(0, 0, pose.yaw) @ normals)

    def add_keyframe(self, keyframe: Keyframe, pose: Pose2) -> None:
        """Adds the surface points of a keyframe at a pose, and inserts its beams into the grid."""
        self.add_points(pose, *keyframe.surface())
        keyframe.draw(self.grid, pose)

    def set_uncertainty(self, pose: Pose2, covariance: Float64s | Float32s, stamp: int) -> None:
        """Sets the pose of the points that are new since the last call, its covariance (3, 3) m, rad, and stamp, ns."""
        self.registrar.map.set_pose_of_new_points(pose.x, pose.y, covariance, stamp)

    def remove_crossed_points(self) -> None:
        """Removes points that later beams have crossed. The points of a person walking ahead would bias matches."""
        points = self.registrar.map.points[: self.registrar.map.n, :2]
        present = np.isfinite(points[:, 0])
        crossed = np.zeros(len(points), np.bool_)
        crossed[present] = self.grid.is_free(points[present], 1)
        self.registrar.remove_points(crossed)

    def insert_beams(self, origins: Float64s, ends: Float64s) -> None:
        """Inserts beams into the grid: origins and ends (n, 2) m in the submap's frame, ends NaN without an echo."""
        self.grid.insert_scan(origins, ends, np.full_like(ends, np.nan))

    def load(self, grid: OccupancyGrid, update: MapUpdate) -> None:
        """Loads a map without keyframes. grid: the cells of the update."""
        self.registrar.add_points(*grid_surface(grid.occupied, grid.free, grid.x0, grid.y0, grid.resolution))
        self.grid.load(update)

    def inlier_margin(self, match: Match, origin: Float64s, points: Float64s) -> float:
        """Share of the inliers of a match less that of the beams that contradict the grid, -1..1.

        points: (n, 2) m in `base`, those of the match.  origin: (2,) m in `base`, of their beams.
        """
        pose, others = match.map_from_base, points[~match.inliers]
        contradictions = self.grid.contradicts(pose @ np.broadcast_to(origin, others.shape), pose @ others)
        return float(match.inliers.sum() - contradictions.sum()) / max(len(points), 1)

    @property
    def n_bytes(self) -> int:
        """Bytes of memory."""
        arrays = (getattr(self.grid, name) for name in TILE_ARRAYS)
        return sum(array.nbytes for array in (*arrays, *self.registrar.map.index))
