# SPDX-License-Identifier: Apache-2.0
"""The heading of a base that does its own odometry, by a gyro: each step turns as the gyro says.

Our own, by the rule of gyro.py that the gyro always gives the turn. The path of a step keeps its length, and its chord
keeps the angle to the mean heading of the step. The covariance is passed on.
"""

from dataclasses import replace

from services.odometry.gyro import Gyro
from shared.geometry import Pose2
from shared.messages import BaseOdometry

STANDING_M = 0.002  # m of a wheel's rim that the odometry of a standing base may flicker


class BaseHeading:
    """The chain of corrected poses. wheel_distance: m, by which the base's motion is that of two wheels."""

    def __init__(self, gyro: Gyro, wheel_distance: float) -> None:
        self._gyro, self._wheel_distance = gyro, wheel_distance
        self._last: BaseOdometry | None = None
        self._pose = Pose2()  # corrected, in the frame of the epoch's first pose
        self._is_corrected = False  # in this epoch: then the chain differs from the base's
        self._forward = self._turned = 0.0  # m, rad of the base since the start
        self.turns: tuple[float, float, float] | None = None
        """rad by gyro, rad by the base, s of the last step; None where the base gave its heading."""

    def corrected(self, message: BaseOdometry) -> BaseOdometry:
        """The message with the gyro's heading; itself where the gyro was not used in this epoch."""
        last, self._last = self._last, message
        self.turns = None
        if last is None or last.epoch != message.epoch:
            self._pose, self._is_corrected = message.odom_from_base, False
            self._gyro.skip_turn()
            return message
        seconds = (message.stamp - last.stamp) * 1e-9
        step = _step(last, message, seconds)
        self._watch(message.stamp, step)
        turn = self._gyro.turn_until(message.stamp)
        if turn is not None:
            self.turns, self._is_corrected = (turn, step.yaw, seconds), True
            moved = Pose2(0.0, 0.0, (turn - step.yaw) / 2) @ Pose2(step.x, step.y)
            step = Pose2(moved.x, moved.y, turn)
            message = replace(message, w=self._gyro.rate)
        if not self._is_corrected:
            self._pose = message.odom_from_base
            return message
        self._pose = self._pose @ step
        return replace(message, odom_from_base=self._pose) if message.has_pose else message

    def _watch(self, stamp: int, step: Pose2) -> None:
        """Lets the gyro know a standstill, by the travel of the two wheels that the base's motion is that of."""
        self._forward, self._turned = self._forward + step.x, self._turned + step.yaw
        half = self._turned * self._wheel_distance / 2
        self._gyro.watch_wheels(stamp, self._forward - half, self._forward + half, (STANDING_M, STANDING_M))


def _step(before: BaseOdometry, after: BaseOdometry, seconds: float) -> Pose2:
    """The motion between two messages of a base, by its poses or else by its twist."""
    if after.has_pose:
        return before.odom_from_base.inverse() @ after.odom_from_base
    return Pose2((before.v + after.v) / 2 * seconds, 0.0, (before.w + after.w) / 2 * seconds)
