# SPDX-License-Identifier: Apache-2.0
"""What odometry gets wrong, learnt from the matches, and how far it is believed."""

from math import hypot, sqrt

import numpy as np

from services.mapper.registration import Float64s, Prior, RegistrationConfig
from shared.geometry import Pose2

OBSERVED = 0.012  # m, standard deviation up to which the beams fix a direction
UNKNOWN = 0.1  # standard deviation of a scale that nothing was learnt about
LEARNING = 0.05  # weight of the newest motion in odometry's error
SPAN = 0.065  # s: motions are compared over this long, at least
ENOUGH = 0.95  # of it: stamps jitter
LEAST_SHARE = 0.05  # of what is doubted of a motion over SPAN, that a step has: stamps may lie
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

    def learn(self, measured: float, true: float) -> None:
        """Takes a motion, unless no scale explains it: a slip, a stall, a wrong sign."""
        if abs(true - measured) <= 0.2 * abs(measured):
            self.squares += measured * measured - FORGETTING * self.squares
            self.products += measured * true - FORGETTING * self.products


class OdometryError:
    """What odometry has got wrong of late, as the matches that know better tell: its scale, and what is left.

    What a match gets wrong, the next one undoes, so from scan to scan of a fast laser that is most of what they differ
    by: motions are compared over `SPAN`, and of that a shorter step has its share.
    """

    def __init__(self) -> None:
        self.squared, self.squared_turn = 0.015**2, 0.01**2  # m^2, rad^2: what a wheeled robot's is like
        self.measured, self.moved, self.seconds = Pose2(), Pose2(), 0.0  # since they were last compared
        self.forward, self.turn = Scale(0.05), Scale(0.004)

    def corrected(self, step: Pose2) -> Pose2:
        """A motion by odometry, at its true scale: a tyre's radius and the distance of the wheels are never right."""
        return Pose2(self.forward.gain * step.x, self.forward.gain * step.y, self.turn.gain * step.yaw)

    def learn(self, step: Pose2, moved: Pose2, information: Float64s, seconds: float = SPAN) -> None:
        """Takes a motion by odometry and by a match, where the beams fix the pose in every direction.

        seconds: that it took.
        """
        if float(np.linalg.eigvalsh(information[:2, :2])[0]) < 1 / OBSERVED**2:
            self.measured, self.moved, self.seconds = Pose2(), Pose2(), 0.0
            return
        step, moved, self.seconds = self.measured @ step, self.moved @ moved, self.seconds + seconds
        if self.seconds < ENOUGH * SPAN:
            self.measured, self.moved = step, moved
            return
        self.measured, self.moved, self.seconds = Pose2(), Pose2(), 0.0
        off = self.corrected(step).inverse() @ moved
        self.squared += LEARNING * (off.x**2 + off.y**2 - self.squared)
        self.squared_turn += LEARNING * (off.yaw**2 - self.squared_turn)
        self.forward.learn(step.x, moved.x)
        self.turn.learn(step.yaw, moved.yaw)

    def prior(
        self,
        config: RegistrationConfig,
        before: Pose2,
        step: Pose2,
        doubt: float = 1.0,
        skew: float = 0.0,
        seconds: float = SPAN,
    ) -> Prior:
        """The prior after a corrected step from a matched pose; `doubt` widens it. seconds: that the step took."""
        share = min(max(seconds / SPAN, LEAST_SHARE), 1.0)
        least = share * config.prior + config.prior_share * hypot(step.x, step.y)
        least_turn = share * config.prior_turn + config.prior_turn_share * abs(step.yaw)
        return Prior(
            before @ step,
            doubt * max(least, share * config.trust * sqrt(self.squared)),
            doubt * max(least_turn, share * config.trust * sqrt(self.squared_turn)),
            skew,
        )
