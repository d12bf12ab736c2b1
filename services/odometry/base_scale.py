# SPDX-License-Identifier: Apache-2.0
"""Corrects the odometry of a base that does its own by two scales: of its distances, and of its turns.

Our own: each step of the base's pose is scaled, so the corrected pose stays one chain. The covariance is passed on.
"""

from dataclasses import replace

from shared.geometry import Pose2
from shared.messages import BaseOdometry


class BaseScale:
    """distance, turn: the true motion over the one that the base reports."""

    def __init__(self, distance: float, turn: float) -> None:
        self.distance, self.turn = distance, turn
        self._last: BaseOdometry | None = None
        self._pose = Pose2()  # corrected, in the frame of the epoch's first pose

    def corrected(self, message: BaseOdometry) -> BaseOdometry:
        """The message with its pose and twist corrected; itself where both scales are 1."""
        if self.distance == 1.0 and self.turn == 1.0:
            return message
        if message.has_pose:
            if self._last is None or self._last.epoch != message.epoch:
                self._pose = message.odom_from_base
            else:
                step = self._last.odom_from_base.inverse() @ message.odom_from_base
                self._pose = self._pose @ Pose2(step.x * self.distance, step.y * self.distance, step.yaw * self.turn)
        self._last = message
        v, w = message.v * self.distance, message.w * self.turn
        return replace(message, odom_from_base=self._pose if message.has_pose else message.odom_from_base, v=v, w=w)
