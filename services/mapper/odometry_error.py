# SPDX-License-Identifier: Apache-2.0
"""What odometry gets wrong, learnt from the matches, and how far it is believed."""

from collections import deque
from math import hypot, inf, sqrt

import numpy as np

from services.mapper.registration import Float64s, Prior, RegistrationConfig
from services.mapper.slip import TURN_PER_M
from shared.geometry import Pose2

OBSERVED = 0.012  # m, standard deviation up to which the beams fix a direction
UNKNOWN = 0.1  # standard deviation of a scale that nothing was learnt about
LEARNING = 0.05  # weight of the newest motion in odometry's error
SPAN = 0.065
"""s over which motions are compared, at least.

A comparison holds the error of odometry, which grows with its time, and the error of two matches, which does not.
A match of some hundred beams resolves 5 to 7 mm (median of its covariance: 5.3 among thin posts, 7.0 on the log intel).
Odometry's least doubt (`registration.prior`, 5 mm in this time) reaches that after 0.065 to 0.09 s. Over shorter times
the errors of matches are learnt as odometry's, and the next match has more freedom to err. A comparison takes whole
steps: four at 50 Hz, two at 20 Hz, one up to 15 Hz. A step's share of the doubt is its share of that time, so that the
scan rate does not matter.
"""
ENOUGH = 0.95  # of it: stamps jitter
MIN_SWEEP_S = 0.01  # s: no laser sweeps faster; a logger that writes in bursts stamps scans 1 ms apart
LONG, LONG_TURN = 0.3, 0.5  # m, rad: a scale is learnt from motions so long, of which lag and steps are a small part
MAX_LONG = 50  # of SPAN
MAX_JITTER_S = 0.15  # s between two scans up to which odometry that is late, or comes in steps, shows
OUTLIER = 9.0  # variances: a slip, or a match that is wrong, tells no more of how far off odometry is as a rule
EVEN = 3  # steps that are compared
MAX_SHARE = 0.5  # of a motion, as odometry's standard deviation: else scans that lie teach that it says nothing
MAX_STANDING = 0.03  # m, rad: the same of a robot that stands
UNEVEN = 0.5  # of what they differ by, is the standard deviation of the next one
NO_JITTER = 4.0  # var(w) / var(n) from which odometry is followed as it is
LEAST_JITTER_RATIO = 0.02
FORGETTING = 0.005  # share of what is known of its scale that each step replaces


class Scale:
    """The ratio of true to measured motion: least squares with forgetting, drawn to 1 by `stiffness` (m^2 or rad^2)."""

    def __init__(self, stiffness: float) -> None:
        self.stiffness = stiffness
        self.squares = self.products = 0.0

    @property
    def gain(self) -> float:
        return (self.products + self.stiffness) / (self.squares + self.stiffness)

    @property
    def sigma(self) -> float:
        """What is left to doubt of the gain."""
        return UNKNOWN * sqrt(self.stiffness / (self.squares + self.stiffness))

    def learn(self, measured: float, true: float, n: int = 1) -> None:
        """Takes a motion of n steps, unless no scale explains it: a slip, a stall, a wrong sign."""
        if abs(true - measured) <= 0.2 * abs(measured):
            forgotten = 1 - (1 - FORGETTING) ** n
            self.squares += measured * measured / n - forgotten * self.squares
            self.products += measured * true / n - forgotten * self.products


class Jitter:
    """How much of what odometry and matches differ by, from scan to scan, is undone by the next scan.

    Odometry that comes in steps, or late, is off by a bounded amount, here and there; a slip stays. The differences r
    of a local level model (a random walk w seen with white noise n) have the autocorrelation -1 / (2 + q) one step
    apart, with q = var(w) / var(n). The Kalman gain of its steady state is (sqrt(q^2 + 4 q) - q) / 2 (Harvey 1989,
    section 4.1.2).
    """

    def __init__(self, variance: float) -> None:
        self.variance, self.product = variance, 0.0
        self.last: tuple[float, ...] | None = None

    def learn(self, difference: tuple[float, ...]) -> None:
        """Takes the difference of a motion by a match and by odometry, (k,), of a scan that follows the last one's."""
        squared = sum(x * x for x in difference)
        if squared > OUTLIER * self.variance:
            shrunk = sqrt(OUTLIER * self.variance / squared)
            difference, squared = tuple(shrunk * x for x in difference), OUTLIER * self.variance
        self.variance += LEARNING * (squared - self.variance)
        if self.last is not None:
            product = sum(x * y for x, y in zip(difference, self.last))
            self.product += LEARNING * (product - self.product)
        self.last = difference

    @property
    def gain(self) -> float:
        """Share of what a match says against odometry that is believed to last; 1 without jitter."""
        correlation = self.product / max(self.variance, 1e-12)
        if correlation >= -1 / (2 + NO_JITTER):
            return 1.0
        q = max(-1 / correlation - 2, LEAST_JITTER_RATIO)
        return (sqrt(q * q + 4 * q) - q) / 2


class OdometryError:
    """What odometry has got wrong of late, as the matches that know better tell: its scale, and what is left.

    What a match gets wrong, the next one undoes, so from scan to scan of a fast laser that is most of what they differ
    by: motions are compared over `SPAN` or longer, and a shorter step has its share of the time that was compared.
    """

    def __init__(self) -> None:
        self.squared, self.squared_turn = 0.015**2, 0.01**2  # m^2, rad^2: what a wheeled robot's is like
        self.measured, self.moved, self.seconds = Pose2(), Pose2(), 0.0  # since they were last compared
        self.forward, self.turn = Scale(0.05), Scale(0.004)
        self.jitter, self.jitter_turn = Jitter(self.squared), Jitter(self.squared_turn)
        self.compared_s = SPAN  # s, mean time over which motions were compared
        self._forget_long()
        self.last_path = self.last_turn = 0.0  # m, rad: the last motion by a match
        self.recent: deque[tuple[float, float, float]] = deque(maxlen=EVEN)  # s, m, rad of the last steps
        self.uneven = self.uneven_turn = 0.0  # m, rad, standard deviations of the next one besides

    def corrected(self, step: Pose2) -> Pose2:
        """A motion by odometry, at its true scale: a tyre's radius and the distance of the wheels are never right."""
        return Pose2(self.forward.gain * step.x, self.forward.gain * step.y, self.turn.gain * step.yaw)

    def hear(self, step: Pose2, seconds: float) -> None:
        """Notices how evenly odometry comes: where it comes in steps, or late, motion and standing take turns."""
        self.recent.append((seconds, hypot(step.x, step.y), abs(step.yaw)))
        times, ways, turns = (np.array(column) for column in zip(*self.recent))
        even = len(times) == EVEN and times.max() <= min(2 * times.min(), MAX_JITTER_S)
        self.uneven = UNEVEN * float(np.ptp(ways)) if even else 0.0
        self.uneven_turn = UNEVEN * float(np.ptp(turns)) if even else 0.0

    def learn(self, step: Pose2, moved: Pose2, information: Float64s, seconds: float = SPAN) -> None:
        """Takes a motion by odometry and by a match, where the beams fix the pose in every direction.

        seconds: that it took.
        """
        self.last_path, self.last_turn = hypot(moved.x, moved.y), abs(moved.yaw)
        if float(np.linalg.eigvalsh(information[:2, :2])[0]) < 1 / OBSERVED**2:
            self.measured, self.moved, self.seconds = Pose2(), Pose2(), 0.0
            self.jitter.last = self.jitter_turn.last = None
            return
        if seconds <= MAX_JITTER_S:
            now = self.corrected(step).inverse() @ moved
            self.jitter.learn((now.x, now.y))
            self.jitter_turn.learn((now.yaw,))
        step, moved, self.seconds = self.measured @ step, self.moved @ moved, self.seconds + seconds
        if self.seconds < ENOUGH * SPAN:
            self.measured, self.moved = step, moved
            return
        self.compared_s += LEARNING * (self.seconds - self.compared_s)
        self.measured, self.moved, self.seconds = Pose2(), Pose2(), 0.0
        off = self.corrected(step).inverse() @ moved
        most = OUTLIER if seconds <= MAX_JITTER_S else inf
        self.squared += LEARNING * (min(off.x**2 + off.y**2, most * self.squared) - self.squared)
        self.squared_turn += LEARNING * (min(off.yaw**2, most * self.squared_turn) - self.squared_turn)
        self._learn_scale(step, moved)

    def _learn_scale(self, step: Pose2, moved: Pose2) -> None:
        """Takes a motion over SPAN or longer; the scales are learnt from longer ones, as if from so many of these."""
        self.n_long += 1
        self.long += (step.x, moved.x, step.yaw, moved.yaw)
        is_long = abs(self.long[0]) >= LONG or abs(self.long[2]) >= LONG_TURN or self.n_long >= MAX_LONG
        if is_long or self.forward.squares < self.forward.stiffness:  # at first little is better than nothing
            self.forward.learn(float(self.long[0]), float(self.long[1]), self.n_long)
            self.turn.learn(float(self.long[2]), float(self.long[3]), self.n_long)
            self._forget_long()

    def _forget_long(self) -> None:
        self.long, self.n_long = np.zeros(4), 0  # forward and turn, by odometry and by matches; motions in these sums

    def prior(
        self,
        config: RegistrationConfig,
        before: Pose2,
        step: Pose2,
        doubt: float = 1.0,
        skew: float = 0.0,
        seconds: float = inf,
        smooth: bool = False,
    ) -> Prior:
        """The prior after a corrected step from a matched pose; `doubt` widens it.

        seconds: that the step took; a stamp that cannot be true says nothing, and the step is doubted as a whole one.
        smooth: without what uneven odometry is off here and there.
        """
        uneven, uneven_turn = (0.0, 0.0) if smooth else (self.uneven, self.uneven_turn)
        seconds = seconds if seconds >= MIN_SWEEP_S else inf
        share, known = min(seconds / SPAN, 1.0), config.trust * min(seconds / self.compared_s, 1.0)
        least = share * config.prior + config.prior_share * hypot(step.x, step.y)
        least_turn = share * config.prior_turn + config.prior_turn_share * abs(step.yaw)
        path, turn = max(hypot(step.x, step.y), self.last_path), max(abs(step.yaw), self.last_turn)
        most = MAX_STANDING + MAX_SHARE * path
        most_turn = MAX_STANDING + MAX_SHARE * turn + TURN_PER_M * path
        return Prior(
            before @ step,
            doubt * (max(least, min(known * sqrt(self.squared), most)) + uneven),
            doubt * (max(least_turn, min(known * sqrt(self.squared_turn), most_turn)) + uneven_turn),
            skew,
        )
