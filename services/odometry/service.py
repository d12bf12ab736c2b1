# SPDX-License-Identifier: Apache-2.0
"""Dead reckoning as a service: wheel angles in, a continuous pose with its covariance and twist out."""

import numpy as np

from services.odometry.dead_reckoning import INTEGRATIONS, OdometryConfig, grown
from shared import topics
from shared.config import Robot
from shared.geometry import Pose2
from shared.messages import Odometry, WheelState
from shared.rejections import Kind
from shared.service import Log, Out, Service, on
from shared.stamps import precedes

LONGEST_ROLL = 100.0  # m between two messages; more is a broken publisher, not motion
LARGEST_VARIANCE = 1e11  # m^2, rad^2: within the message's bound for ever


class OdometryService(Service):
    """Integrates each wheel's travel; a restarted driver (a new epoch) continues the pose."""

    config_type = OdometryConfig
    config: OdometryConfig

    def __init__(self, config: OdometryConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self.integrate = INTEGRATIONS[config.integration]
        self.odom_from_base = Pose2()
        self.covariance = np.zeros((3, 3))
        self.last: WheelState | None = None

    @on(topics.WHEELS)
    def wheels(self, wheels: WheelState) -> Out:
        last = self.last
        if last is not None and last.epoch == wheels.epoch:
            if wheels.stamp <= last.stamp:
                words = "stamps stand still" if wheels.stamp == last.stamp else "stamps go back"
                self.rejections.reject(topics.WHEELS.key, Kind.SEQUENCE, words, self.now)
                return
            yield from self._roll(last, wheels)
        elif last is not None and precedes(wheels.epoch, last.epoch, self.now):
            return  # late words of a driver that was replaced
        self.last = wheels
        yield topics.ODOM(self._odometry(wheels))

    def _roll(self, before: WheelState, after: WheelState) -> Out:
        drive = self.robot.drive
        left = (after.left - before.left) * drive.left_radius
        right = (after.right - before.right) * drive.right_radius
        if max(abs(left), abs(right)) > LONGEST_ROLL:
            yield Log("WARNING", f"the wheels jumped by {left:.0f} and {right:.0f} m: not taken as motion")
            return
        motion, jacobian = self.integrate(left, right, drive.wheel_distance)
        heading = self.odom_from_base.yaw
        variance = self.config.wheel_variance
        covariance = grown(self.covariance, heading, motion, jacobian, (left, right), variance)
        self.covariance = covariance if covariance.max() < LARGEST_VARIANCE else self.covariance
        self.odom_from_base = self.odom_from_base @ motion

    def _odometry(self, wheels: WheelState) -> Odometry:
        drive = self.robot.drive
        left, right = drive.left_radius * wheels.left_speed, drive.right_radius * wheels.right_speed
        v, w = (left + right) / 2, (right - left) / drive.wheel_distance
        # a board may report any speed; the message's bounds are what a robot can do
        v, w = min(max(v, -20.0), 20.0), min(max(w, -50.0), 50.0)
        return Odometry(wheels.stamp, self.odom_from_base, v, w, self.covariance.ravel())
