# SPDX-License-Identifier: Apache-2.0
"""Registration of a scan with the map by the package kiss-icp (Vizzo et al., RA-L 2023)."""

from dataclasses import replace
from math import cos, pi, sin

import numpy as np

from services.mapper.front_end.deskew import remove_twist
from services.mapper.front_end.registration import LineRegistrar, Match, Prior, RegistrationConfig
from shared.config import UserError
from shared.geometry import Pose2, wrapped
from shared.types import Bools, Float64s

VOXEL_M, MAX_POINTS_IN_VOXEL = 0.5, 20  # of the package's map: 0.11 m between two points
MAX_ITERATIONS = 100
MAX_DISTANCE_RATIO = 3.0  # of a correspondence, to the kernel
MIN_THRESHOLD_M = 0.1  # of the kernel: the map has a point each 0.11 m


class KissRegistrar(LineRegistrar):
    """Voxel map and registration of kiss-icp, fused with the odometry prior. Matches are evaluated as for `line`.

    The package minimises over the pose alone, point to point, without a prior. So the prior is applied outside. Its
    standard deviations give the adaptive threshold (section III-C of the paper: the recent errors of predictions).
    The aligned pose is fused with the prior by their information. The twist is no fourth unknown: it is the sweep's
    share of the turn that odometry missed.
    """

    def __init__(self, config: RegistrationConfig, range_max: float) -> None:
        super().__init__(config, range_max)
        try:  # only here: all else works where the package has no wheel
            from kiss_icp.mapping import VoxelHashMap
            from kiss_icp.registration import Registration
        except ImportError as error:
            hint = "pip install kiss-icp, or take the default: mapper.registration.registrar: line"
            raise UserError(f"registrar kiss needs the package kiss-icp: {error}", hint) from None

        self._voxels = VoxelHashMap(VOXEL_M, max(range_max, 1.0), MAX_POINTS_IN_VOXEL)
        self._registration = Registration(MAX_ITERATIONS, 1e-4, max_num_threads=1)

    def clear(self) -> None:
        super().clear()
        self._voxels.clear()

    def add_points(self, points: Float64s, normals: Float64s) -> None:
        super().add_points(points, normals)
        self._voxels.add_points(_points_3d(points))

    def remove_points(self, mask: Bools) -> None:
        super().remove_points(mask)
        if mask.any():  # the package removes points by their distance alone
            points = self.map.points[: self.map.n, :2]
            self._voxels.clear()
            self._voxels.add_points(_points_3d(points[np.isfinite(points[:, 0])]))

    def register(
        self, points: Float64s, normals: Float64s, start: Pose2, prior: Prior, back: Float64s | None = None
    ) -> Match:
        if not len(points) or self._voxels.empty():
            return self.evaluate(points, normals, prior.map_from_base)
        sigma = self.threshold(prior)
        pose, twist = self._align(points, start, sigma), 0.0
        if back is not None and prior.skew > 0:
            twist = prior.skew * wrapped(pose.yaw - prior.map_from_base.yaw)
            points, normals = remove_twist(back, twist, points, normals)
            pose = self._align(points, pose, sigma)
        fused = _fuse(self.evaluate(points, normals, pose), prior)
        return replace(self.evaluate(points, normals, fused), twist=twist)

    def threshold(self, prior: Prior) -> float:
        """m, scale of the kernel: the error of the prior at the laser's range.

        It is a third of the maximum distance of a correspondence. So it is at most a third of `gate`: with three times
        that distance, scans slid to other walls of a small room, 1.7 rad off.
        """
        off = prior.sigma + 2 * self.range_max * sin(min(prior.sigma_turn, pi) / 2)
        return float(max(min(off, self.config.gate / MAX_DISTANCE_RATIO), MIN_THRESHOLD_M))

    def _align(self, points: Float64s, start: Pose2, sigma: float) -> Pose2:
        moved = self._registration.align_points_to_map(
            points=_points_3d(points), voxel_map=self._voxels, initial_guess=_matrix(start),
            max_correspondance_distance=MAX_DISTANCE_RATIO * sigma, kernel=sigma,
        )  # fmt: skip
        return Pose2(float(moved[0, 3]), float(moved[1, 3]), float(np.arctan2(moved[1, 0], moved[0, 0])))


def _fuse(match: Match, prior: Prior) -> Pose2:
    """The mean of a match and the prior, weighted by their information: an update of an extended Kalman filter."""
    at, guess = match.map_from_base, prior.map_from_base
    off = np.array((at.x - guess.x, at.y - guess.y, wrapped(at.yaw - guess.yaw)))
    x, y, yaw = np.linalg.solve(match.information + prior.information, match.information @ off).tolist()
    return Pose2(guess.x + x, guess.y + y, wrapped(guess.yaw + yaw))


def _points_3d(points: Float64s) -> Float64s:
    return np.column_stack((points, np.zeros(len(points))))


def _matrix(pose: Pose2) -> Float64s:
    matrix = np.eye(4)
    matrix[:2, :2] = (cos(pose.yaw), -sin(pose.yaw)), (sin(pose.yaw), cos(pose.yaw))
    matrix[:2, 3] = pose.x, pose.y
    return matrix
