# SPDX-License-Identifier: Apache-2.0
"""Slip of the wheels in a corridor: did the robot move along it by more, or by less, than odometry says?

Along a corridor only a few beams measure the position: those on door frames and corners. There registration follows
odometry. Where the wheels slip, the walls to both sides still fit, and the frames do not. So a scan that fits worse
than usual is compared with the map at other poses along the corridor. Another pose counts where the scan fits as well
as usual.

The method is our own. What is usual is a mean and three deviations, as in a control chart of single measurements
(Shewhart 1931).
"""

from dataclasses import dataclass
from math import cos, exp, hypot, sin

import numpy as np

from services.mapper.back_end.keyframe import Sweep
from services.mapper.front_end.registration import MIN_DIRECTION_SHARE, Match, Prior
from services.mapper.front_end.scan_alignment import Prediction
from services.mapper.front_end.slip import LAG_ERROR
from services.mapper.front_end.submap import Submap
from shared.geometry import Pose2
from shared.types import Float64s

STEP_M, MAX_REACH_M = 0.05, 1.5  # of the poses that are compared; two doors are farther apart
MAX_ANGLE_RAD = 0.2  # from the corridor to the robot's heading: wheels slip ahead
MIN_SLIP_M = 0.09  # registration corrects less
SLIP_SIGMA_M, SLIP_SIGMA_RAD = 0.1, 0.02  # of a pose that was found, before registration
NEAR_M = 0.3  # from a beam's end to the surfaces of the submap, where one of them may be what it hit
MIN_NEAR_BEAMS = 40  # with fewer a fit says little
LEARNING_RATE = 0.05  # weight of the newest fit
MAX_DEVIATIONS = 3.0  # of a usual fit from the mean
MIN_LOSS, MIN_SHORTFALL = 0.02, 0.012  # of a fit: a few beams err in an ideal corridor, too
MAX_LOSS = 0.06  # where fits vary more, people or clutter are the cause
MIN_GAIN_SHARE, MIN_GAIN_BEAMS = 0.6, 4  # of the lost inliers that another pose must bring back
SPEED_MEMORY_S = 3.0  # time constant: wheels that slip may turn slowly


@dataclass(frozen=True, slots=True)
class Fit:
    """How a scan fits the submap at a pose: its beams near a surface, and the inliers among them."""

    n_inliers: int
    n_near: int

    @property
    def share(self) -> float:
        """Share of the inliers, 0..1. A beam into unknown space does not count: new ground is no misfit."""
        return self.n_inliers / max(self.n_near, 1)


@dataclass(frozen=True, slots=True)
class Usual:
    """Mean of the fits' shares, and the mean of their absolute deviations from it."""

    mean: float
    deviation: float = MIN_LOSS / MAX_DEVIATIONS

    def after(self, share: float) -> "Usual":
        """With the share of another fit."""
        off = min(abs(share - self.mean), MAX_DEVIATIONS * self.deviation)
        mean = self.mean + LEARNING_RATE * (share - self.mean)
        return Usual(mean, self.deviation + LEARNING_RATE * (off - self.deviation))


class CorridorSlip:
    """Finds the pose of a robot whose wheels slipped in a corridor.

    recent: of all scans in corridors.  usual: the same, up to the last scan that fitted as usual.
    path: m, how far the robot may have driven since its scans fitted as usual.  speed: m/s, its largest recent one.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Another submap, or another kind of place."""
        self.usual: Usual | None = None
        self.recent: Usual | None = None
        self.path = self.speed = 0.0

    def corrected_pose(self, submap: Submap, sweep: Sweep, match: Match, prediction: Prediction) -> Pose2 | None:
        """The pose in `local` along the corridor where the scan fits as usual; None if it is that of the match.

        sweep: beams with an echo, but not those on free-standing objects, which may move as the robot does.
        """
        self._drive(prediction)
        pose, direction = match.map_from_base, open_direction(match.information)
        drives_along = direction is not None and abs(direction @ (cos(pose.yaw), sin(pose.yaw))) >= cos(MAX_ANGLE_RAD)
        fit = fit_at(submap, sweep, pose) if drives_along else None
        if fit is None or fit.n_near < MIN_NEAR_BEAMS:
            self.path = 0.0
            return None
        usual = self.usual or Usual(fit.share)
        min_share = usual.mean - max(MIN_SHORTFALL, usual.deviation)
        loss = max(MIN_LOSS, MAX_DEVIATIONS * usual.deviation)
        self.recent = (self.recent or usual).after(fit.share)
        if fit.share >= min_share:
            self.usual, self.path = self.recent, 0.0
        elif self.path > MAX_REACH_M:  # another kind of place, not slip
            self.reset()
            return None
        if fit.share > usual.mean - loss or loss > MAX_LOSS or self.path < MIN_SLIP_M:
            return None
        pose = self._best_pose(submap, sweep, pose)
        prior = Prior(pose, SLIP_SIGMA_M, SLIP_SIGMA_RAD)
        pose = submap.registrar.register(sweep.points, sweep.normals, pose, prior, sweep.remaining).map_from_base
        better, off = fit_at(submap, sweep, pose), match.map_from_base.inverse() @ pose
        min_gain = max(MIN_GAIN_BEAMS, MIN_GAIN_SHARE * loss * fit.n_near)
        is_usual = better.share >= min_share and better.n_inliers - fit.n_inliers >= min_gain
        if not is_usual or hypot(off.x, off.y) < MIN_SLIP_M:
            return None
        self.path = 0.0
        return pose

    def _drive(self, prediction: Prediction) -> None:
        step, motion, seconds = prediction.step, prediction.motion, prediction.seconds
        self.speed = max(hypot(motion.x, motion.y) / seconds, self.speed * exp(-seconds / SPEED_MEMORY_S))
        path = hypot(step.x, step.y)
        self.path += max(path, self.speed * seconds) if path > 0 else 0.0  # wheels at rest do not slip

    def _best_pose(self, submap: Submap, sweep: Sweep, pose: Pose2) -> Pose2:
        """The pose with most inliers before or behind a pose, as far as the wheels may have slipped."""
        n = int((LAG_ERROR + self.path) / STEP_M)
        poses = [pose @ Pose2(STEP_M * i) for i in range(-n, n + 1)]
        return max(poses, key=lambda one: fit_at(submap, sweep, one).n_inliers)


def fit_at(submap: Submap, sweep: Sweep, pose: Pose2) -> Fit:
    """The fit of a sweep at a pose in `local`."""
    registrar = submap.registrar
    inliers = registrar.evaluate(sweep.points, sweep.normals, pose).inliers
    return Fit(int(inliers.sum()), int((inliers | registrar.are_near(sweep.points, pose, NEAR_M)).sum()))


def open_direction(information: Float64s) -> Float64s | None:
    """(2,) unit vector along which a match, information (3, 3), measures little of the position; None if there is none.

    Less than MIN_DIRECTION_SHARE of the information, as in registration: the prior decides there.
    """
    if information[2, 2] <= 0:
        return None
    position = information[:2, :2] - np.outer(information[:2, 2], information[2, :2]) / information[2, 2]
    values, vectors = np.linalg.eigh(position)
    is_open = values[0] < MIN_DIRECTION_SHARE * np.trace(information[:2, :2])
    return np.asarray(vectors[:, 0]) if is_open else None
