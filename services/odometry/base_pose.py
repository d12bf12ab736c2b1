# SPDX-License-Identifier: Apache-2.0
"""Odometry of a base that does its own: its pose passed through, or its twist integrated, continuous over restarts.

The rules are our own. A pose is moved by one rigid transform for each epoch, which begins where the last one ended. The
covariance is propagated as in Siegwart, Nourbakhsh, Scaramuzza 2011, equation 5.8.
"""

from math import cos, sin

import numpy as np

from services.odometry.dead_reckoning import arc_motion, propagated_covariance
from shared.geometry import Pose2
from shared.messages import BaseOdometry
from shared.types import Float64s

MAX_STEP_S = 1.0  # s; over a longer pause a twist is no motion


class BasePose:
    """`odom_from_base` and its covariance (3, 3), from the messages of one base.

    wheel_variance: m^2 for each m of a wheel, wheel_distance: m; for a base that gives no covariance.
    """

    def __init__(self, wheel_variance: float, wheel_distance: float) -> None:
        self.odom_from_base = Pose2()
        self.covariance = np.zeros((3, 3))
        self.v = self.w = 0.0  # m/s, rad/s
        self._wheel_variance, self._wheel_distance = wheel_variance, wheel_distance
        self._last: BaseOdometry | None = None
        self._odom_from_start = Pose2()  # at the beginning of the epoch, as the two below
        self._start_covariance = np.zeros((3, 3))
        self._base_start = Pose2()

    def begin_epoch(self, message: BaseOdometry) -> None:
        """Takes the first message of an epoch: the robot has not moved since the last one."""
        if self._last is None and message.has_pose:
            self.odom_from_base, self.covariance = message.odom_from_base, _square(message.covariance)
            self._base_start = Pose2()
        else:
            self._odom_from_start, self._start_covariance = self.odom_from_base, self.covariance
            self._base_start = message.odom_from_base
        self._take_twist(message, 0.0, Pose2())

    def add(self, message: BaseOdometry) -> None:
        """Takes a message that follows the last one."""
        last = self._last
        if last is None:
            self.begin_epoch(message)
            return
        seconds = (message.stamp - last.stamp) * 1e-9
        step = last.odom_from_base.inverse() @ message.odom_from_base
        if not message.has_pose:
            known = seconds if seconds <= MAX_STEP_S else 0.0
            forward, turn = (last.v + message.v) / 2 * known, (last.w + message.w) / 2 * known
            self._move(forward, turn, _twist_variances(message, known))
        elif message.covariance.any():
            self._follow(message)
        else:
            self._move(step.x, step.yaw, None)
            self.odom_from_base = self._odom_from_start @ (self._base_start.inverse() @ message.odom_from_base)
        self._take_twist(message, seconds, step)

    def _follow(self, message: BaseOdometry) -> None:
        """Passes the base's pose through, with its covariance turned into `odom`."""
        motion = self._base_start.inverse() @ message.odom_from_base
        self.odom_from_base = self._odom_from_start @ motion
        dx, dy = self.odom_from_base.x - self._odom_from_start.x, self.odom_from_base.y - self._odom_from_start.y
        by_start = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
        angle = self._odom_from_start.yaw - self._base_start.yaw
        c, s = cos(angle), sin(angle)
        turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        own = turned @ _square(message.covariance) @ turned.T
        self.covariance = by_start @ self._start_covariance @ by_start.T + own

    def _move(self, forward: float, turn: float, variances: tuple[float, float] | None) -> None:
        """Moves along an arc (m, rad). variances: of both, m^2 and rad^2; None: from the travel of both wheels."""
        motion, by_forward, by_turn = arc_motion(forward, turn)
        if variances is None:
            half = turn * self._wheel_distance / 2
            total = self._wheel_variance * (abs(forward - half) + abs(forward + half))
            variances = total / 4, total / self._wheel_distance**2
        jacobian = np.column_stack((by_forward, by_turn))
        self.covariance = propagated_covariance(self.covariance, self.odom_from_base.yaw, motion, jacobian, variances)
        self.odom_from_base = self.odom_from_base @ motion

    def _take_twist(self, message: BaseOdometry, seconds: float, step: Pose2) -> None:
        """Takes the twist of the message, or that of the step where it has none."""
        if message.has_twist:
            self.v, self.w = message.v, message.w
        elif seconds > 0:
            self.v, self.w = step.x / seconds, step.yaw / seconds
        self._last = message


def _square(covariance: Float64s) -> Float64s:
    return np.array(covariance, np.float64).reshape(3, 3)


def _twist_variances(message: BaseOdometry, seconds: float) -> tuple[float, float] | None:
    """Variances of forward travel (m^2) and turn (rad^2) of a step; None where the base gives none."""
    if not message.twist_covariance.any():
        return None
    square = _square(message.twist_covariance)
    return float(square[0, 0]) * seconds**2, float(square[2, 2]) * seconds**2
