# SPDX-License-Identifier: Apache-2.0
"""Covariance of the pose in `local`: what the beams measure now, and the uncertainty of the map that they match.

A scan that fits a map drawn a moment ago from an uncertain pose is no more certain than that pose. So each point of
the map keeps the covariance of the pose at which it was seen (`PointMap.set_pose_of_new_points`). A match inherits it
in the directions that the beams determine. The map keeps the covariance only of directions that the beams left open.
Where beams determine all directions, the drift of the map is not counted.

This inheritance is our own. Covariances are compounded to first order (Smith, Self and Cheeseman, "Estimating uncertain
spatial relationships in robotics", 1990). Directions are separated by eigenvectors as in Zhang et al., ICRA 2016.
"""

import numpy as np

from services.mapper.front_end.registration import Prior
from shared.geometry import Pose2
from shared.types import Float32s, Float64s


class PoseCovariance:
    """All in m and rad, about the present pose in the axes of `local`.

    covariance: (3, 3) of (x, y, yaw).  map_covariance: (3, 3), the part that points drawn at this pose inherit.
    drift: (3,) displacement if the scale of odometry is wrong by one standard deviation. Such errors add up in
    proportion to the path, not to its root.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Sets all to zero: the present pose defines `local`, or the back end knows the uncertainty so far."""
        self.covariance: Float64s = np.zeros((3, 3))
        self.map_covariance: Float64s = np.zeros((3, 3))
        self.drift: Float64s = np.zeros(3)

    def update(
        self, before: Pose2, prior: Prior, scale_sigma: float, information: Float64s, matched: Float64s | None
    ) -> None:
        """Adds a step by odometry from the pose `before`, and the match after it.

        scale_sigma: m, standard deviation of the step's length by the scale of odometry, the same error each time.
        information: (3, 3) from the beams.  matched: (3, 3) covariance of the matched points of the map, at this pose;
        None without any.
        """
        lever = lever_matrix(prior.map_from_base.x - before.x, prior.map_from_base.y - before.y)
        yaw = prior.map_from_base.yaw
        drift = lever @ self.drift
        drift_after = drift + scale_sigma * np.array((np.cos(yaw), np.sin(yaw), 0.0))
        before_match = lever @ self.map_covariance @ lever.T
        growth = np.outer(drift_after, drift_after) - np.outer(drift, drift)
        # scaled by the step's standard deviations, the eigenvectors of the information are independent
        sigmas = np.array((prior.sigma, prior.sigma, prior.sigma_turn))
        eigenvalues, axes = np.linalg.eigh(information * np.outer(sigmas, sigmas))
        step_share = 1 / (1 + np.maximum(eigenvalues, 0))  # of each axis; the beams determine the rest
        by_step = sigmas[:, None] * (axes * np.sqrt(step_share)) @ axes.T / sigmas
        by_beams = sigmas[:, None] * (axes * np.sqrt(1 - step_share)) @ axes.T / sigmas
        # the covariance that map and pose share counts once; the beams reduce what this step adds
        inherited = before_match if matched is None else matched
        propagated = by_step @ before_match @ by_step.T + by_beams @ inherited @ by_beams.T
        remaining = by_step @ by_step
        propagated = _positive_semidefinite(propagated + remaining @ growth @ remaining.T)
        modes = sigmas[:, None] * axes
        open_share = np.where(step_share > 0.5, step_share, 0)
        self.covariance = propagated + (modes * step_share) @ modes.T
        self.map_covariance = propagated + (modes * open_share) @ modes.T
        self.drift = remaining @ drift_after

    @property
    def sigma(self) -> float:
        """m, standard deviation of the position in its least certain direction."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.covariance[:2, :2])[-1], 0.0)))


def _positive_semidefinite(covariance: Float64s) -> Float64s:
    """The nearest covariance: a robot that drives back may remove drift that the map removed before."""
    eigenvalues, axes = np.linalg.eigh(covariance)
    return np.asarray((axes * np.maximum(eigenvalues, 0)) @ axes.T)


def lever_matrix(dx: float, dy: float) -> Float64s:
    """(3, 3) Jacobian from an error of (x, y, yaw) of a pose to that of a point (dx, dy) m away, rigidly connected."""
    return np.array(((1.0, 0.0, -dy), (0.0, 1.0, dx), (0.0, 0.0, 1.0)))


def mean_covariance(covariances: Float32s, positions: Float32s, x: float, y: float) -> Float64s | None:
    """(3, 3) mean of covariances (n, 3, 3) of poses at positions (n, 2) m, as errors of a pose at x, y m.

    None without any.
    """
    if not len(covariances):
        return None
    if not covariances.any():
        return np.zeros((3, 3))
    lever = np.tile(np.eye(3), (len(covariances), 1, 1))
    lever[:, 0, 2], lever[:, 1, 2] = positions[:, 1] - y, x - positions[:, 0]
    return np.asarray((lever @ covariances @ lever.transpose(0, 2, 1)).mean(axis=0), np.float64)
