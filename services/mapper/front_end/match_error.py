# SPDX-License-Identifier: Apache-2.0
"""Errors of matches beyond what their beams claim, learned where matches are erratic and odometry is even.

Plants, and ground that the laser sees ahead, fit the map at wrong poses, with many beams. Odometry then shows even
motion, and the matches jump to and fro. A slipping or late wheel is different: there both motions change as often, or
the robot moves less than its wheels.

The method is our own. The learned variance is added to the covariance of a match, as that of a biased sensor.
"""

from math import hypot

from services.mapper.front_end.slip import LAG_ERROR
from shared.geometry import Pose2

MIN_CHANGE_RATIO = 4.0  # squared changes of the matches' motion to those of odometry's, over which matches are erratic
CHANGE_RATE = 0.1  # weight of the newest change of a motion
LEARNING_RATE = 0.1  # weight of the newest error that is larger than the learned ones
FORGETTING_RATE = 0.02  # the same of a smaller one
TURN_ERROR = 0.02  # rad, of one match or of odometry between two scans
DOUBTED_SIGMA = 0.07  # m and rad, of matches after scans that fit nothing
DOUBTFUL_SIGMA = 0.05  # m and rad, from which matches close no loop
MIN_DOUBT = 25.0  # variance of matches to that of odometry, over which no other pose is searched for


class _Erratic:
    """The variance of one quantity of the matches, m^2 or rad^2."""

    def __init__(self) -> None:
        self.variance = self._match_changes = self._odometry_changes = 0.0

    def add(self, match_change: float, odometry_change: float, error: float) -> None:
        """Adds a motion: its squared change since the last one, by match and by odometry, and its error."""
        self._match_changes += CHANGE_RATE * (match_change - self._match_changes)
        self._odometry_changes += CHANGE_RATE * (odometry_change - self._odometry_changes)
        share = max(0.0, 1.0 - MIN_CHANGE_RATIO * self._odometry_changes / max(self._match_changes, 1e-9))
        squared = share * min(error * error, match_change)  # an error that stays is odometry's
        rate = LEARNING_RATE if squared > self.variance else FORGETTING_RATE
        self.variance += rate * (squared - self.variance)


class MatchError:
    """The learned variances of matches: 0 while odometry does not contradict them."""

    def __init__(self) -> None:
        self._position, self._heading = _Erratic(), _Erratic()
        self._last: tuple[Pose2, Pose2] | None = None

    @property
    def variance(self) -> float:
        """m^2, of the position of a match, beyond the errors that any match may have."""
        return max(0.0, self._position.variance - LAG_ERROR**2)

    @property
    def turn_variance(self) -> float:
        """rad^2, of its heading, in the same way."""
        return max(0.0, self._heading.variance - TURN_ERROR**2)

    def add(self, step: Pose2, motion: Pose2) -> None:
        """Adds the same motion by odometry, at its scale, and by a match, both in `base` before it."""
        if self._last is not None:
            last_step, last_motion = self._last
            off = step.inverse() @ motion
            slips = step.x * off.x < 0 and abs(off.x) <= abs(step.x)  # the robot moves less than its wheels
            error = max(0.0, hypot(0.0 if slips else off.x, off.y) - LAG_ERROR)
            self._position.add(_squared_distance(motion, last_motion), _squared_distance(step, last_step), error)
            turn_error = max(0.0, abs(off.yaw) - TURN_ERROR)
            self._heading.add((motion.yaw - last_motion.yaw) ** 2, (step.yaw - last_step.yaw) ** 2, turn_error)
        self._last = step, motion

    def doubt(self) -> None:
        """After scans that fit nothing the next matches are doubtful, too."""
        for learned in (self._position, self._heading):
            learned.variance = max(learned.variance, DOUBTED_SIGMA**2)

    @property
    def is_doubtful(self) -> bool:
        """Whether a match may be so wrong that a loop closure would be, too."""
        return max(self.variance, self.turn_variance) > DOUBTFUL_SIGMA**2

    def exceeds(self, variance: float, turn_variance: float) -> bool:
        """Whether matches err so much more than odometry, of these variances, that only odometry counts."""
        return self.variance > MIN_DOUBT * variance or self.turn_variance > MIN_DOUBT * turn_variance


def _squared_distance(a: Pose2, b: Pose2) -> float:
    return (a.x - b.x) ** 2 + (a.y - b.y) ** 2
