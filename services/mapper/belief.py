# SPDX-License-Identifier: Apache-2.0
"""How sure the front end is of its pose: what the beams tell now, and what the map that they tell it from is worth.

A scan that fits a map drawn a moment ago from an unsure place is no surer than that place. So each point of the map
keeps how unsure the pose was from which it was drawn (`PointMap.sign`), and a match takes that over, in the directions
that the beams decide. Only what the beams left open is kept so: the drift of a map that they hold everywhere is not.
"""

import numpy as np
from numpy.typing import NDArray

from services.mapper.registration import Prior
from shared.geometry import Pose2

Float32s = NDArray[np.float32]
Float64s = NDArray[np.float64]


class Belief:
    """covariance: (3, 3) of (x, y, yaw) in `local` about the pose.  carried: (3, 3), the part a map drawn here keeps.

    drift: (3,), where the pose would be if all that odometry got wrong, unseen, were one standard deviation of its
    scale: such errors add up with the way, not with its root.
    """

    def __init__(self) -> None:
        self.start()

    def start(self) -> None:
        """Sure, as of now: what was carried so far is known, or is for somebody else to say."""
        self.covariance: Float64s = np.zeros((3, 3))
        self.carried: Float64s = np.zeros((3, 3))
        self.drift: Float64s = np.zeros(3)

    def take(self, before: Pose2, prior: Prior, ahead: float, information: Float64s, drawn: Float64s | None) -> None:
        """A step from `before`, and a match.

        ahead: m, standard deviation of what may be wrong with the way alone, each time the same.  information: (3, 3),
        from the beams.  drawn: (3, 3), how unsure the map is that they agree with; None where there is none.
        """
        lever = moved_by(prior.map_from_base.x - before.x, prior.map_from_base.y - before.y)
        yaw = prior.map_from_base.yaw
        drift = lever @ self.drift
        further = drift + ahead * np.array((np.cos(yaw), np.sin(yaw), 0.0))
        before_it = lever @ self.carried @ lever.T
        grown = np.outer(further, further) - np.outer(drift, drift)
        # in units of the step's uncertainty and along the axes of what is known, each axis is a matter of its own
        sigmas = np.array((prior.sigma, prior.sigma, prior.sigma_turn))
        told, axes = np.linalg.eigh(information * np.outer(sigmas, sigmas))
        open_ = 1 / (1 + np.maximum(told, 0))  # share of each axis that the step decides; the beams decide the rest
        by_step = sigmas[:, None] * (axes * np.sqrt(open_)) @ axes.T / sigmas
        by_beams = sigmas[:, None] * (axes * np.sqrt(1 - open_)) @ axes.T / sigmas
        # what the map shares with the pose counts once, what this step adds is the beams' to take away
        carried = by_step @ before_it @ by_step.T + by_beams @ (before_it if drawn is None else drawn) @ by_beams.T
        kept = by_step @ by_step
        carried = _positive(carried + kept @ grown @ kept.T)
        modes = sigmas[:, None] * axes
        left_open = np.where(open_ > 0.5, open_, 0)
        self.covariance = carried + (modes * open_) @ modes.T
        self.carried = carried + (modes * left_open) @ modes.T
        self.drift = kept @ further

    @property
    def sigma(self) -> float:
        """m, the standard deviation of the place in its worst direction."""
        return float(np.sqrt(max(np.linalg.eigvalsh(self.covariance[:2, :2])[-1], 0.0)))


def _positive(covariance: Float64s) -> Float64s:
    """The nearest that is one: who drives back takes away of a drift that the map may have taken away before."""
    sizes, axes = np.linalg.eigh(covariance)
    return np.asarray((axes * np.maximum(sizes, 0)) @ axes.T)


def moved_by(dx: float, dy: float) -> Float64s:
    """(3, 3): what an error of (x, y, yaw) is of a place (dx, dy) m farther on, rigidly tied to it."""
    return np.array(((1.0, 0.0, -dy), (0.0, 1.0, dx), (0.0, 0.0, 1.0)))


def mean_doubt(doubts: Float32s, places: Float32s, x: float, y: float) -> Float64s | None:
    """(3, 3): the mean of doubts (n, 3, 3) of poses at places (n, 2), as errors of a pose at x, y; None without any."""
    if not len(doubts):
        return None
    if not doubts.any():
        return np.zeros((3, 3))
    lever = np.tile(np.eye(3), (len(doubts), 1, 1))
    lever[:, 0, 2], lever[:, 1, 2] = places[:, 1] - y, x - places[:, 0]
    return np.asarray((lever @ doubts @ lever.transpose(0, 2, 1)).mean(axis=0), np.float64)
