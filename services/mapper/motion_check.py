# SPDX-License-Identifier: Apache-2.0
"""Do scans and odometry tell of the same motion? For how long have they not?

A wheel that slips, or odometry that is a little late, explains a share of a motion. A laser that repeats what it saw,
or wheels that spin before an obstacle, are farther off, for as long as that lasts.
"""

from collections import deque
from math import hypot

from shared.geometry import Pose2

WINDOW = 0.5  # s over which motions are compared
AT_ODDS_S, LOST_S = 0.5, 1.5  # s of disagreement
MIN_SCANS = 4
SLIP = 0.4  # share of a motion that slip explains
SLACK, SLACK_TURN = 0.06, 0.1  # m, rad, besides: a match's error, and a scan's lag


class MotionCheck:
    """Compares motions by matches and by odometry. seconds, n: how long, and in how many scans, they have disagreed."""

    def __init__(self) -> None:
        self.start()

    def start(self) -> None:
        """Forgets what was compared so far."""
        self.seconds, self.n = 0.0, 0
        self._motions: deque[tuple[float, Pose2, Pose2]] = deque()

    def take(self, step: Pose2, moved: Pose2, seconds: float) -> None:
        """Takes a motion by odometry and by a match, that took so many seconds."""
        self._motions.append((seconds, step, moved))
        while len(self._motions) > 1 and sum(s for s, _, _ in self._motions) - self._motions[0][0] >= WINDOW:
            self._motions.popleft()
        if sum(s for s, _, _ in self._motions) < WINDOW:
            return
        if self._explained(WINDOW) or self._explained(WINDOW / 2):
            self.seconds, self.n = 0.0, 0
        else:
            self.seconds, self.n = self.seconds + seconds, self.n + 1

    @property
    def at_odds(self) -> bool:
        """Whether they have disagreed for so long that one of them is wrong."""
        return self.seconds > AT_ODDS_S and self.n >= MIN_SCANS

    @property
    def is_lost(self) -> bool:
        """Whether they have disagreed for so long that the pose is worth nothing."""
        return self.seconds > LOST_S and self.n >= 2 * MIN_SCANS

    def _explained(self, window: float) -> bool:
        """Whether slip explains what the motions of the last so many seconds differ by."""
        covered, a, b = 0.0, Pose2(), Pose2()
        for seconds, step, moved in reversed(self._motions):
            covered, a, b = covered + seconds, step @ a, moved @ b
            if covered >= window - 1e-6:
                break
        off = a.inverse() @ b
        far = max(hypot(a.x, a.y), hypot(b.x, b.y))
        turned = max(abs(a.yaw), abs(b.yaw))
        share = window / WINDOW
        return hypot(off.x, off.y) <= SLACK * share + SLIP * far and abs(off.yaw) <= SLACK_TURN * share + SLIP * turned
