# SPDX-License-Identifier: Apache-2.0
"""Odometry: wheel angles in; continuous pose with covariance, and twist, out."""

import numpy as np

from services.odometry.dead_reckoning import INTEGRATIONS, DeadReckoningConfig, propagated_covariance
from shared import topics
from shared.config import Robot
from shared.geometry import Pose2
from shared.messages import Odometry, WheelState
from shared.rejections import RejectionCause
from shared.service import Log, Out, Service, on
from shared.stamps import precedes

MAX_TRAVEL_M = 100.0  # m between two messages; a larger value is an error of the publisher, not motion
MAX_VARIANCE = 1e11  # m^2, rad^2; below the message's bound of 1e12


class OdometryService(Service):
    """Integrates the travel of each wheel. After a restart of the base driver (new epoch) the pose continues."""

    config_type = DeadReckoningConfig
    config: DeadReckoningConfig

    def __init__(self, config: DeadReckoningConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self.integrate = INTEGRATIONS[config.integration]
        self.odom_from_base = Pose2()
        self.covariance = np.zeros((3, 3))
        self.last_wheels: WheelState | None = None

    @on(topics.WHEELS)
    def wheels(self, wheels: WheelState) -> Out:
        last_wheels = self.last_wheels
        if last_wheels is not None and last_wheels.epoch == wheels.epoch:
            if wheels.stamp <= last_wheels.stamp:
                detail = "stamps stand still" if wheels.stamp == last_wheels.stamp else "stamps go back"
                self.rejections.reject(topics.WHEELS.key, RejectionCause.SEQUENCE, detail, self.now)
                return
            yield from self._integrate(last_wheels, wheels)
        elif last_wheels is not None and precedes(wheels.epoch, last_wheels.epoch, self.now):
            return  # a late message of the previous driver process
        self.last_wheels = wheels
        yield topics.ODOM(self._odometry(wheels))

    def _integrate(self, before: WheelState, after: WheelState) -> Out:
        drive = self.robot.drive
        left = (after.left - before.left) * drive.left_radius
        right = (after.right - before.right) * drive.right_radius
        if max(abs(left), abs(right)) > MAX_TRAVEL_M:
            yield Log("WARNING", f"the wheels jumped by {left:.0f} and {right:.0f} m: not taken as motion")
            return
        motion, jacobian = self.integrate(left, right, drive.wheel_distance)
        heading = self.odom_from_base.yaw
        variance = self.config.wheel_variance
        covariance = propagated_covariance(self.covariance, heading, motion, jacobian, (left, right), variance)
        self.covariance = covariance if covariance.max() < MAX_VARIANCE else self.covariance
        self.odom_from_base = self.odom_from_base @ motion

    def _odometry(self, wheels: WheelState) -> Odometry:
        drive = self.robot.drive
        left, right = drive.left_radius * wheels.left_speed, drive.right_radius * wheels.right_speed
        v, w = (left + right) / 2, (right - left) / drive.wheel_distance
        # a board may report any speed; the message's bounds are what a robot can do
        v, w = min(max(v, -20.0), 20.0), min(max(w, -50.0), 50.0)
        return Odometry(wheels.stamp, self.odom_from_base, v, w, self.covariance.ravel())
