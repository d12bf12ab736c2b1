# SPDX-License-Identifier: Apache-2.0
"""How far a robot can be from where odometry puts it: bounds by what its wheels did.

A wheel that slips or sticks, and a count that is missed, are wrong by a part of the motion. Odometry that comes late is
wrong by the motion of that time. A match that is much farther off is doubtful, whatever its beams say: outdoors the
laser may see the ground ahead, which moves with the robot.
"""

from dataclasses import dataclass
from math import hypot

import numpy as np

from shared.geometry import Float64s, Pose2

LATE = 0.03  # m, rad: error of odometry that is late or comes in steps
TURN_PER_M = 0.3  # rad a metre: one wheel of a small robot slips for a tenth of the path
MAX_ERROR = 0.1  # m, rad by which odometry errs between two keyframes while no wheel slips
MAX_SLIP_TURN_PER_M = 1.0  # rad a metre: a wheel that slips all the way turns a robot, the less the wider it is


@dataclass(frozen=True, slots=True)
class Slip:
    """path, turn: m and rad that the robot moved, by odometry and by matches, since the last scan that fitted."""

    path: float
    turn: float

    def surprise(self, off: Pose2, max_path: float, max_turn: float) -> float:
        """How unlikely it is to be so far off, as the square of distance over slip.

        max_path, max_turn: m, rad that the drive can do in the time.
        """
        slip = LATE + min(self.path, max_path)
        slip_turn = LATE + min(self.turn + TURN_PER_M * self.path, max_turn)
        return (hypot(off.x, off.y) / slip) ** 2 + (off.yaw / slip_turn) ** 2


def widened(information: Float64s, step: Pose2, off: Pose2) -> Float64s:
    """Information (3, 3) of a motion in its own axes, less certain where no slip explains what odometry says.

    step: the motion.  off: what it differs from odometry by, in the same axes. A wheel can slip for as long as it
    turned, and no farther: beyond that the match may be wrong, and a loop closure decides. The covariance grows by
    off off^T; Sherman and Morrison (1950) give the inverse.
    """
    odometry = step @ off.inverse()
    path = hypot(odometry.x, odometry.y)
    max_turn = MAX_ERROR + abs(odometry.yaw) + MAX_SLIP_TURN_PER_M * path
    if hypot(off.x, off.y) <= MAX_ERROR + path and abs(off.yaw) <= max_turn:
        return information
    d = np.array((off.x, off.y, off.yaw))
    less = information @ d
    return np.asarray(information - np.outer(less, less) / (1 + d @ less))
