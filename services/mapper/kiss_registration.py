# SPDX-License-Identifier: Apache-2.0
"""How a scan is aligned with the map, by the kiss-icp package (Vizzo et al., RA-L 2023)."""

from dataclasses import replace
from math import cos, pi, sin

import numpy as np

from services.mapper.deskew import turned_back
from services.mapper.registration import LineRegistrar, Match, Prior, RegistrationConfig
from shared.geometry import Bools, Float64s, Pose2, wrapped

VOXEL, MAX_POINTS_IN_VOXEL = 0.5, 20  # m, and points, of the package's map: 0.11 m between two
MAX_ITERATIONS = 100
MIN_THRESHOLD = 0.1  # m, of its kernel: its map has a point in 0.11 m


class KissRegistrar(LineRegistrar):
    """The kiss-icp package's voxel map and registration, fused with the odometry prior; measured as for `line`.

    The package minimises over the pose alone, point to point, without a prior. So the prior enters around it. Its
    standard deviations give the adaptive threshold, which in KISS-ICP too is how far predictions were off of late. The
    aligned pose is fused with it by their information. A sweep's twist is its share of the turn that odometry missed,
    not a fourth unknown.
    """

    def __init__(self, config: RegistrationConfig, range_max: float) -> None:
        super().__init__(config, range_max)
        from kiss_icp.mapping import VoxelHashMap
        from kiss_icp.registration import Registration

        self._voxels = VoxelHashMap(VOXEL, max(range_max, 1.0), MAX_POINTS_IN_VOXEL)
        self._registration = Registration(MAX_ITERATIONS, 1e-4, max_num_threads=1)

    def clear(self) -> None:
        super().clear()
        self._voxels.clear()

    def extend(self, points: Float64s, normals: Float64s) -> None:
        super().extend(points, normals)
        self._voxels.add_points(_solid(points))

    def forget(self, gone: Bools) -> None:
        super().forget(gone)
        if gone.any():  # the package removes points by their distance alone
            points = self.map.points[: self.map.n, :2]
            self._voxels.clear()
            self._voxels.add_points(_solid(points[np.isfinite(points[:, 0])]))

    def register(
        self, points: Float64s, normals: Float64s, start: Pose2, prior: Prior, back: Float64s | None = None
    ) -> Match:
        if not len(points) or self._voxels.empty():
            return self.measured(points, normals, prior.map_from_base)
        sigma = self.threshold(prior)
        pose, twist = self._aligned(points, start, sigma), 0.0
        if back is not None and prior.skew > 0:
            twist = prior.skew * wrapped(pose.yaw - prior.map_from_base.yaw)
            points, normals = turned_back(points, back, twist), turned_back(normals, back, twist)
            pose = self._aligned(points, pose, sigma)
        fused = _fused(self.measured(points, normals, pose), prior)
        return replace(self.measured(points, normals, fused), twist=twist)

    def threshold(self, prior: Prior) -> float:
        """m: the kernel, a third of the farthest match; how far odometry may be off, at the laser's range."""
        off = prior.sigma + 2 * self.range_max * sin(min(prior.sigma_turn, pi) / 2)
        return float(min(max(off, MIN_THRESHOLD), max(self.config.gate, MIN_THRESHOLD)))

    def _aligned(self, points: Float64s, start: Pose2, sigma: float) -> Pose2:
        moved = self._registration.align_points_to_map(
            points=_solid(points), voxel_map=self._voxels, initial_guess=_matrix(start),
            max_correspondance_distance=3 * sigma, kernel=sigma,
        )  # fmt: skip
        return Pose2(float(moved[0, 3]), float(moved[1, 3]), float(np.arctan2(moved[1, 0], moved[0, 0])))


def _fused(match: Match, prior: Prior) -> Pose2:
    """The mean of a match and the prior, weighted by their information: one update of an extended Kalman filter."""
    own = np.diag((1 / prior.sigma**2, 1 / prior.sigma**2, 1 / prior.sigma_turn**2))
    at, guess = match.map_from_base, prior.map_from_base
    off = np.array((at.x - guess.x, at.y - guess.y, wrapped(at.yaw - guess.yaw)))
    x, y, yaw = np.linalg.solve(match.information + own, match.information @ off).tolist()
    return Pose2(guess.x + x, guess.y + y, wrapped(guess.yaw + yaw))


def _solid(points: Float64s) -> Float64s:
    return np.column_stack((points, np.zeros(len(points))))


def _matrix(pose: Pose2) -> Float64s:
    matrix = np.eye(4)
    matrix[:2, :2] = (cos(pose.yaw), -sin(pose.yaw)), (sin(pose.yaw), cos(pose.yaw))
    matrix[:2, 3] = pose.x, pose.y
    return matrix
