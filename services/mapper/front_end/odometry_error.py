# SPDX-License-Identifier: Apache-2.0
"""Errors of odometry, learned from matches: its scale, its jitter and its noise, and the prior that follows."""

from collections import deque
from math import hypot, inf, sqrt

import numpy as np

from services.mapper.front_end.match_error import MatchError
from services.mapper.front_end.registration import Prior, RegistrationConfig
from services.mapper.front_end.slip import TURN_PER_M
from shared.geometry import Pose2
from shared.types import Float64s

MAX_MATCH_SIGMA_M = 0.012  # up to here the beams determine the position in every direction
UNKNOWN_SCALE_SIGMA = 0.1  # standard deviation of a scale before any motion
LEARNING_RATE = 0.05  # weight of the newest motion in the errors of odometry
COMPARISON_S = 0.065
"""Minimum time over which motions are compared.

A comparison holds the error of odometry, which grows with its time, and the error of two matches, which does not.
A match of some hundred beams resolves 5 to 7 mm (median of its covariance: 5.3 among thin posts, 7.0 on the log intel).
The minimum sigma of odometry (`registration.prior`, 5 mm in this time) reaches that after 0.065 to 0.09 s. Over shorter
times the errors of matches are learned as those of odometry, and the next match has more freedom to err. A comparison
takes whole steps: four at 50 Hz, two at 20 Hz, one up to 15 Hz. The share of a step in the sigma is its share of this
time, so that the scan rate does not matter.
"""
MIN_COMPARISON_SHARE = 0.95  # of COMPARISON_S: stamps jitter
MIN_SWEEP_S = 0.01  # no laser sweeps faster; a logger that writes in bursts stamps scans 1 ms apart
MIN_SCALE_PATH_M, MIN_SCALE_TURN_RAD = 0.3, 0.5  # of a motion that gives a scale: lag and steps are a small part of it
MAX_SCALE_COMPARISONS = 50  # after which a shorter motion gives a scale, too
MAX_JITTER_S = 0.15  # between two scans; over longer times late or stepped odometry does not show
MAX_SQUARED_RATIO = 9.0  # of a squared error to the variance: a slip or a wrong match counts as this much
N_EVENNESS_STEPS = 3  # steps that are compared
MAX_SIGMA_SHARE = 0.5  # of a motion, as sigma of odometry: scans that are wrong must not make it useless
MAX_STANDING_SIGMA = 0.03  # m, rad: the same for a robot that stands
USUAL_RATE = 0.02  # share by which a comparison changes the usual variance
MIN_USUAL_VARIANCE = 1e-6  # m^2, rad^2: a robot that stands has no error
MEDIAN_OF_SQUARES = 0.455  # median of a squared error to its variance: chi-squared with one degree of freedom
UNEVEN_SIGMA_SHARE = 0.5  # of the range of the recent steps, as standard deviation of the next one
MAX_JITTER_RATIO = 4.0  # var(w) / var(n); over it, odometry is followed without smoothing
MIN_JITTER_RATIO = 0.02
FORGETTING = 0.005  # share of the information about the scale that each step replaces


class ScaleEstimate:
    """Ratio of true to measured motion: least squares with forgetting, drawn to 1 by `stiffness`, m^2 or rad^2."""

    def __init__(self, stiffness: float) -> None:
        self.stiffness = stiffness
        self.squares = self.products = 0.0

    @property
    def value(self) -> float:
        """True motion per measured motion, 1 without any."""
        return (self.products + self.stiffness) / (self.squares + self.stiffness)

    @property
    def sigma(self) -> float:
        """Standard deviation of `value`, a ratio."""
        return UNKNOWN_SCALE_SIGMA * sqrt(self.stiffness / (self.squares + self.stiffness))

    def add(self, measured: float, true: float, n: int = 1) -> None:
        """Adds a motion of n steps, m or rad, unless no scale explains it: a slip, a stall, a wrong sign."""
        if abs(true - measured) <= 0.2 * abs(measured):
            forgotten = 1 - (1 - FORGETTING) ** n
            self.squares += measured * measured / n - forgotten * self.squares
            self.products += measured * true / n - forgotten * self.products


class JitterEstimate:
    """Share of the difference between odometry and matches that the next scan reverses.

    Odometry that comes in steps, or late, is off by a bounded amount to either side; a slip stays. The model is a local
    level: a random walk w observed with white noise n. With q = var(w) / var(n), its differences have the
    autocorrelation -1 / (2 + q) at lag 1. The Kalman gain of the steady state is (sqrt(q^2 + 4 q) - q) / 2. Both:
    Harvey 1989, section 4.1.2.
    """

    def __init__(self, variance: float) -> None:
        self.variance, self.product = variance, 0.0
        self.last: tuple[float, ...] | None = None

    def add(self, difference: tuple[float, ...]) -> None:
        """Adds the difference (k,), m or rad, of a motion by a match and by odometry, of consecutive scans."""
        squared = sum(x * x for x in difference)
        if squared > MAX_SQUARED_RATIO * self.variance:
            shrinkage = sqrt(MAX_SQUARED_RATIO * self.variance / squared)
            difference, squared = tuple(shrinkage * x for x in difference), MAX_SQUARED_RATIO * self.variance
        self.variance += LEARNING_RATE * (squared - self.variance)
        if self.last is not None:
            product = sum(x * y for x, y in zip(difference, self.last))
            self.product += LEARNING_RATE * (product - self.product)
        self.last = difference

    @property
    def gain(self) -> float:
        """Share of the difference between match and odometry that lasts; 1 without jitter."""
        correlation = self.product / max(self.variance, 1e-12)
        if correlation >= -1 / (2 + MAX_JITTER_RATIO):
            return 1.0
        q = max(-1 / correlation - 2, MIN_JITTER_RATIO)
        return (sqrt(q * q + 4 * q) - q) / 2


class ErrorVariance:
    """Variance of an error of odometry over a comparison, m^2 or rad^2.

    recent: follows the last comparisons.  usual: from the median of the squared errors, which slips do not change.
    """

    def __init__(self, variance: float) -> None:
        self.recent = self.usual = variance

    def add(self, error: float, bound: float, match_variance: float) -> None:
        """Adds an error, m or rad, of which the square counts up to `bound` times the recent variance.

        match_variance: of the errors of both matches, which are not odometry's.
        """
        squared = max(min(error * error, bound * self.recent) - match_variance, 0.0)
        self.recent += LEARNING_RATE * (squared - self.recent)
        is_larger = squared > MEDIAN_OF_SQUARES * self.usual
        self.usual = max(self.usual * (1 + USUAL_RATE if is_larger else 1 - USUAL_RATE), MIN_USUAL_VARIANCE)

    def forget_large(self) -> None:
        """The recent errors were those of matches."""
        self.recent = min(self.recent, self.usual)


class OdometryError:
    """Recent errors of odometry, measured by matches: scale, jitter, and the remaining variance.

    The error of a match is reversed by the next one. From scan to scan of a fast laser it is most of the difference.
    So motions are compared over COMPARISON_S or longer, and a shorter step has its share of the time compared.
    """

    def __init__(self) -> None:
        self.position, self.turn = ErrorVariance(0.015**2), ErrorVariance(0.01**2)  # typical of a wheeled robot
        self.by_odometry, self.by_match, self.seconds = Pose2(), Pose2(), 0.0  # motions since the last comparison
        self.forward_scale, self.turn_scale = ScaleEstimate(0.05), ScaleEstimate(0.004)
        self.jitter, self.turn_jitter = JitterEstimate(self.position.recent), JitterEstimate(self.turn.recent)
        self.mean_comparison_s = COMPARISON_S
        self.match_error = MatchError()
        self._reset_scale_sums()
        self.last_path = self.last_turn = 0.0  # m, rad: the last motion by a match
        self.recent_steps: deque[tuple[float, float, float]] = deque(maxlen=N_EVENNESS_STEPS)  # s, m, rad
        self.uneven_sigma = self.uneven_turn_sigma = 0.0  # m, rad, of the next step by its delay alone

    def scaled_step(self, step: Pose2) -> Pose2:
        """A motion by odometry at its estimated scale. The wheels' nominal radius and distance are never exact."""
        forward, turn = self.forward_scale.value, self.turn_scale.value
        return Pose2(forward * step.x, forward * step.y, turn * step.yaw)

    def add_step(self, step: Pose2, seconds: float) -> None:
        """Adds a motion by odometry over `seconds`, to measure how evenly it arrives.

        Where odometry comes in steps or late, motions and standstills alternate.
        """
        self.recent_steps.append((seconds, hypot(step.x, step.y), abs(step.yaw)))
        times, paths, turns = (np.array(column) for column in zip(*self.recent_steps))
        is_even = len(times) == N_EVENNESS_STEPS and times.max() <= min(2 * times.min(), MAX_JITTER_S)
        self.uneven_sigma = UNEVEN_SIGMA_SHARE * float(np.ptp(paths)) if is_even else 0.0
        self.uneven_turn_sigma = UNEVEN_SIGMA_SHARE * float(np.ptp(turns)) if is_even else 0.0

    def add_match(self, step: Pose2, motion: Pose2, information: Float64s, seconds: float = COMPARISON_S) -> None:
        """Adds the same motion, in `base` before it, by odometry (`step`, unscaled) and by a match, over `seconds`.

        information: (3, 3) of the match. A match that leaves a direction open starts the comparison again.
        """
        self.last_path, self.last_turn = hypot(motion.x, motion.y), abs(motion.yaw)
        matches = self.match_error
        matches.add(self.scaled_step(step), motion)
        if float(np.linalg.eigvalsh(information[:2, :2])[0]) < 1 / MAX_MATCH_SIGMA_M**2:
            self.by_odometry, self.by_match, self.seconds = Pose2(), Pose2(), 0.0
            self.jitter.last = self.turn_jitter.last = None
            if matches.variance > 0 or matches.turn_variance > 0:
                self.position.forget_large()
                self.turn.forget_large()
            return
        if seconds <= MAX_JITTER_S:
            difference = self.scaled_step(step).inverse() @ motion
            self.jitter.add((difference.x, difference.y))
            self.turn_jitter.add((difference.yaw,))
        step, motion, self.seconds = self.by_odometry @ step, self.by_match @ motion, self.seconds + seconds
        if self.seconds < MIN_COMPARISON_SHARE * COMPARISON_S:
            self.by_odometry, self.by_match = step, motion
            return
        self.mean_comparison_s += LEARNING_RATE * (self.seconds - self.mean_comparison_s)
        self.by_odometry, self.by_match, self.seconds = Pose2(), Pose2(), 0.0
        off = self.scaled_step(step).inverse() @ motion
        bound = MAX_SQUARED_RATIO if seconds <= MAX_JITTER_S else inf
        self.position.add(hypot(off.x, off.y), bound, 2 * matches.variance)  # both ends of the motion err
        self.turn.add(off.yaw, bound, 2 * matches.turn_variance)
        self._add_to_scale(step, motion)

    def _add_to_scale(self, step: Pose2, motion: Pose2) -> None:
        """Adds a compared motion. The scales take sums of such motions, as if each sum were as many single ones."""
        self.n_summed += 1
        self.sums += (step.x, motion.x, step.yaw, motion.yaw)
        is_long = abs(self.sums[0]) >= MIN_SCALE_PATH_M or abs(self.sums[2]) >= MIN_SCALE_TURN_RAD
        is_long = is_long or self.n_summed >= MAX_SCALE_COMPARISONS
        if is_long or self.forward_scale.squares < self.forward_scale.stiffness:  # at first short motions help, too
            self.forward_scale.add(float(self.sums[0]), float(self.sums[1]), self.n_summed)
            self.turn_scale.add(float(self.sums[2]), float(self.sums[3]), self.n_summed)
            self._reset_scale_sums()

    def _reset_scale_sums(self) -> None:
        self.sums, self.n_summed = np.zeros(4), 0  # m forward and rad, each by odometry and by matches

    def prior(
        self,
        config: RegistrationConfig,
        before: Pose2,
        step: Pose2,
        sigma_factor: float = 1.0,
        skew: float = 0.0,
        seconds: float = inf,
        smooth: bool = False,
    ) -> Prior:
        """The prior after a scaled step, in `base`, from the pose `before`, in the frame of that pose.

        sigma_factor: multiplies the standard deviations.  skew: see `Prior`.  seconds: duration of the step; if it is
        impossibly short, the step has the sigma of a whole comparison.  smooth: without the sigma of uneven odometry.
        """
        uneven, uneven_turn = (0.0, 0.0) if smooth else (self.uneven_sigma, self.uneven_turn_sigma)
        seconds = seconds if seconds >= MIN_SWEEP_S else inf
        share = min(seconds / COMPARISON_S, 1.0)
        trust = config.trust * min(seconds / self.mean_comparison_s, 1.0)
        min_sigma = share * config.prior + config.prior_share * hypot(step.x, step.y)
        min_turn_sigma = share * config.prior_turn + config.prior_turn_share * abs(step.yaw)
        path, turn = max(hypot(step.x, step.y), self.last_path), max(abs(step.yaw), self.last_turn)
        max_sigma = MAX_STANDING_SIGMA + MAX_SIGMA_SHARE * path
        max_turn_sigma = MAX_STANDING_SIGMA + MAX_SIGMA_SHARE * turn + TURN_PER_M * path
        by_error, by_turn_error = trust * sqrt(self.position.recent), trust * sqrt(self.turn.recent)
        return Prior(
            map_from_base=before @ step,
            sigma=sigma_factor * (max(min_sigma, min(by_error, max_sigma)) + uneven),
            sigma_turn=sigma_factor * (max(min_turn_sigma, min(by_turn_error, max_turn_sigma)) + uneven_turn),
            skew=skew,
            match_variance=self.match_error.variance,
            match_turn_variance=self.match_error.turn_variance,
        )
