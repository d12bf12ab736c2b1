# SPDX-License-Identifier: Apache-2.0
"""The odometry of a base that does its own, as the angles of two wheels of the robot's file, and as two scales.

So the estimate of wheels and laser mount serves such a base too: what it finds of the wheels are the base's scales.
"""

from dataclasses import dataclass

from services.base_driver.kinematics import wheel_speeds
from shared.config import Drive
from shared.messages import BaseOdometry, WheelState
from zenav.calibrate.hand_eye import HandEyeSolution

MAX_STEP_S = 1.0  # s; over a longer pause a twist is no motion


class BaseMotion:
    """Converts the messages of one base, in order of their stamps."""

    def __init__(self, drive: Drive) -> None:
        self.drive = drive
        self.left = self.right = 0.0  # rad
        self._last: BaseOdometry | None = None

    def wheels(self, message: BaseOdometry) -> WheelState:
        """The wheels' angles at this message."""
        last, self._last = self._last, message
        if last is not None and last.epoch == message.epoch:
            if message.has_pose:
                step = last.odom_from_base.inverse() @ message.odom_from_base
                forward, turn = step.x, step.yaw
            else:
                seconds = (message.stamp - last.stamp) * 1e-9
                known = seconds if seconds <= MAX_STEP_S else 0.0
                forward, turn = (last.v + message.v) / 2 * known, (last.w + message.w) / 2 * known
            left, right = wheel_speeds(forward, turn, self.drive)
            self.left, self.right = self.left + left, self.right + right
        return WheelState(
            stamp=message.stamp,
            epoch=message.epoch,
            left=self.left,
            right=self.right,
            left_speed=0.0,
            right_speed=0.0,
        )


@dataclass(frozen=True, slots=True)
class BaseScales:
    """The true motion over the one that the base reports, of distances and of turns, with standard deviations.

    bend: rad by which the robot turns in a metre that the base reports as straight.
    """

    distance: float
    turn: float
    sigma_distance: float
    sigma_turn: float
    bend: float

    @classmethod
    def of(cls, solution: HandEyeSolution, drive: Drive) -> "BaseScales":
        """From the wheels that were found, and those of the robot's file, by which the angles were made."""
        wheels = solution.wheels
        distance = wheels.radius / drive.wheel_radius
        turn = distance * drive.wheel_distance / wheels.distance
        bend = (wheels.right_radius - wheels.left_radius) / (wheels.radius * wheels.distance)
        sigma = solution.sigma_radius / drive.wheel_radius
        return cls(distance, turn, sigma, turn * solution.sigma_turn_share, bend)
