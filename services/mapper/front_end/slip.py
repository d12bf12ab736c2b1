# SPDX-License-Identifier: Apache-2.0
"""How far can the robot be from the pose by odometry? Bounds from the motion of the wheels.

A wheel that slips or sticks, and a missed count, err by a part of the motion. Late odometry errs by the motion during
the delay. A match farther off is doubtful, however well its beams fit. Outdoors, for example, the laser may see the
ground ahead, which moves with the robot.

The bounds are our own, from the kinematics of a differential drive.
"""

from dataclasses import dataclass
from math import hypot

import numpy as np

from shared.geometry import Pose2
from shared.types import Float64s

LAG_ERROR = 0.03  # m, rad: error of odometry that is late or comes in steps
TURN_PER_M = 0.3  # rad a metre: one wheel of a small robot slips for a tenth of the path
MAX_ERROR = 0.1  # m, rad: error of odometry between two keyframes while no wheel slips
MAX_SLIP_TURN_PER_M = 1.0  # rad a metre: turn of a robot of which one wheel slips all the path
MIN_INLIER_RATIO = 0.5  # share of the beams that agree with the submap, under which a match may be wrong


@dataclass(frozen=True, slots=True)
class SlipBound:
    """Bound of the error of odometry after a motion.

    path, turn: m and rad that the robot moved since the last scan with a good match.
    """

    path: float
    turn: float

    def squared_ratio(self, off: Pose2, max_path: float, max_turn: float) -> float:
        """Squared ratio of an offset from odometry to the slip that explains it; over 1 it is unlikely.

        off: offset in the axes of the pose by odometry.  max_path, max_turn: m, rad that the drive reaches in the time.
        """
        slip = LAG_ERROR + min(self.path, max_path)
        slip_turn = LAG_ERROR + min(self.turn + TURN_PER_M * self.path, max_turn)
        return (hypot(off.x, off.y) / slip) ** 2 + (off.yaw / slip_turn) ** 2


def widen_where_doubtful(information: Float64s, step: Pose2, off: Pose2, inlier_ratio: float) -> Float64s:
    """Information (3, 3) of a matched motion in its own axes, reduced where the match may be wrong.

    step: the motion by matches.  off: its offset from the motion by odometry, in the same axes.
    inlier_ratio: share of the beams that agree with the submap.
    A wheel slips by its own turn at most. Beyond that the match may be wrong, and a loop closure decides. So it is
    where most beams see new ground, as in a door: the few others may fit at a wrong pose. There the covariance grows by
    off off^T. Its inverse follows from Sherman and Morrison (1950).
    """
    odometry = step @ off.inverse()
    path = hypot(odometry.x, odometry.y)
    max_turn = MAX_ERROR + abs(odometry.yaw) + MAX_SLIP_TURN_PER_M * path
    is_slip = hypot(off.x, off.y) <= MAX_ERROR + path and abs(off.yaw) <= max_turn
    if is_slip and inlier_ratio >= MIN_INLIER_RATIO:
        return information
    d = np.array((off.x, off.y, off.yaw))
    less = information @ d
    return np.asarray(information - np.outer(less, less) / (1 + d @ less))
