# SPDX-License-Identifier: Apache-2.0
"""How far a robot can be from where odometry puts it: bounds by what its wheels did.

A wheel that slips or sticks, and a count that is missed, are wrong by a part of the motion. Odometry that comes late is
wrong by the motion of that time. So a place that is much farther off is a wrong match, whatever its beams say: the
laser may see the ground ahead, which moves with the robot.
"""

from dataclasses import dataclass
from math import hypot

from shared.geometry import Pose2

LATE = 0.03  # m, rad: what odometry that is late or comes in steps is off besides
PUSHED = 0.05  # m, rad that a robot whose wheels stand may be moved between two scans
TURN_PER_M = 0.3  # rad a metre: one wheel of a small robot slips for a tenth of the path


@dataclass(frozen=True, slots=True)
class Slip:
    """path, turn: m and rad that were driven, by odometry, since the last scan that fitted."""

    path: float
    turn: float

    def explains(self, off: Pose2) -> bool:
        """Whether a robot can be so far from where odometry leads, or from where it was."""
        return hypot(off.x, off.y) <= PUSHED + self.path and abs(off.yaw) <= PUSHED + self.turn + TURN_PER_M * self.path

    def surprise(self, off: Pose2, max_path: float, max_turn: float) -> float:
        """How unlikely it is to be so far off, as the square of distance over slip.

        max_path, max_turn: m, rad that the drive can do in the time.
        """
        slip = LATE + min(self.path, max_path)
        slip_turn = LATE + min(self.turn + TURN_PER_M * self.path, max_turn)
        return (hypot(off.x, off.y) / slip) ** 2 + (off.yaw / slip_turn) ** 2
