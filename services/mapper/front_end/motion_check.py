# SPDX-License-Identifier: Apache-2.0
"""Do matches and odometry measure the same motion, and for how long have they disagreed?

Slip of a wheel, or odometry that is a little late, explains a part of a motion. A laser that repeats a scan, or wheels
that spin at an obstacle, give a larger difference for as long as that lasts.

The method is our own: two motions over a window are compared, with a bound that grows with the motion.
"""

from collections import deque
from math import hypot

from shared.geometry import Pose2

WINDOW_S = 0.5  # s over which motions are compared
MIN_DISAGREEMENT_S = 0.5  # from here on one of the two is wrong
MIN_LOST_S = 1.5  # from here on the pose is lost
MIN_SCANS = 4
MAX_SLIP_SHARE = 0.4  # of a motion, explained by slip
TOLERANCE_M, TOLERANCE_RAD = 0.06, 0.1  # beside slip: error of a match, and the scan's lag


class MotionCheck:
    """Compares the motions by matches and by odometry.

    seconds, n_scans: for how long, and over how many scans, they have disagreed.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Drops all motions."""
        self.seconds, self.n_scans = 0.0, 0
        self._motions: deque[tuple[float, Pose2, Pose2]] = deque()

    def add(self, odometry_motion: Pose2, match_motion: Pose2, seconds: float) -> None:
        """Adds the motion in the `seconds` since the last scan, in `base` then, by odometry and by the match."""
        self._motions.append((seconds, odometry_motion, match_motion))
        while len(self._motions) > 1 and sum(s for s, _, _ in self._motions) - self._motions[0][0] >= WINDOW_S:
            self._motions.popleft()
        if sum(s for s, _, _ in self._motions) < WINDOW_S:
            return
        if self._is_explained_by_slip(WINDOW_S) or self._is_explained_by_slip(WINDOW_S / 2):
            self.seconds, self.n_scans = 0.0, 0
        else:
            self.seconds, self.n_scans = self.seconds + seconds, self.n_scans + 1

    @property
    def disagrees(self) -> bool:
        """Whether one of the two motions must be wrong."""
        return self.seconds > MIN_DISAGREEMENT_S and self.n_scans >= MIN_SCANS

    @property
    def is_lost(self) -> bool:
        """Whether the disagreement has lasted so long that the pose is lost."""
        return self.seconds > MIN_LOST_S and self.n_scans >= 2 * MIN_SCANS

    def _is_explained_by_slip(self, window: float) -> bool:
        """Whether slip explains the difference of the two motions over the last `window` s."""
        covered, a, b = 0.0, Pose2(), Pose2()
        for seconds, odometry_motion, match_motion in reversed(self._motions):
            covered, a, b = covered + seconds, odometry_motion @ a, match_motion @ b
            if covered >= window - 1e-6:
                break
        difference = a.inverse() @ b
        path = max(hypot(a.x, a.y), hypot(b.x, b.y))
        turn = max(abs(a.yaw), abs(b.yaw))
        share = window / WINDOW_S
        return (
            hypot(difference.x, difference.y) <= TOLERANCE_M * share + MAX_SLIP_SHARE * path
            and abs(difference.yaw) <= TOLERANCE_RAD * share + MAX_SLIP_SHARE * turn
        )
