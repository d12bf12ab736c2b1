# SPDX-License-Identifier: Apache-2.0
"""Odometry: wheel angles and gyro, or a base's own odometry, in; continuous pose with covariance, and twist, out."""

import numpy as np

from services.odometry.base_heading import STANDING_M, BaseHeading
from services.odometry.base_pose import BasePose
from services.odometry.base_scale import BaseScale
from services.odometry.dead_reckoning import INTEGRATIONS, DeadReckoningConfig, arc_motion, propagated_covariance
from services.odometry.gyro import Gyro
from shared import topics
from shared.config import Robot
from shared.geometry import Pose2
from shared.messages import BaseOdometry, Imu, Odometry, WheelState
from shared.rejections import RejectionCause
from shared.service import Log, Out, Service, on
from shared.stamps import precedes

MAX_TRAVEL_M = 100.0  # m between two messages; a larger value is an error of the publisher, not motion
MAX_VARIANCE = 1e11  # m^2, rad^2; below the message's bound of 1e12
MAX_IMU_AGE_S = 0.5
SLIP_QUIET_NS = 10_000_000_000  # between two log lines about slip


class OdometryService(Service):
    """Integrates the travel of each wheel, and the turn of the gyro where there is one.

    After a restart of the base driver (new epoch) the pose continues.
    """

    config_type = DeadReckoningConfig
    config: DeadReckoningConfig

    def __init__(self, config: DeadReckoningConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self.integrate = INTEGRATIONS[config.integration]
        self.odom_from_base = Pose2()
        self.covariance = np.zeros((3, 3))
        self.last_wheels: WheelState | None = None
        self.base_pose = BasePose(config.wheel_variance, robot.drive.wheel_distance)
        self.base_scale = BaseScale(config.base_distance_scale, config.base_turn_scale)
        self.last_base: BaseOdometry | None = None
        self.gyro = Gyro(config.gyro)
        self.base_heading = BaseHeading(self.gyro, robot.drive.wheel_distance)
        self.by_gyro = False  # the last step's heading
        self.slips = False
        self.n_slips = 0
        self._slip_logged_at: int | None = None  # ns

    def state(self) -> str:
        """Source of the heading and the slips, for the health message."""
        if self.gyro.stamp is None:
            return "heading by wheels: no imu"
        source = "gyro" if self.by_gyro else "wheels" if self.gyro.bias is not None else "wheels: no standstill yet"
        return f"heading by {source}, {'slips' if self.slips else f'{self.n_slips} slips'}"

    @on(topics.IMU)
    def imu(self, imu: Imu) -> Out:
        """Takes a reading of the inertial sensor."""
        if self.rejections.judge(topics.IMU.key, imu.stamp, self.gyro.stamp, self.now, MAX_IMU_AGE_S):
            self.gyro.add(imu)
        return ()

    @on(topics.WHEELS)
    def wheels(self, wheels: WheelState) -> Out:
        last_wheels = self.last_wheels
        if last_wheels is not None and last_wheels.epoch == wheels.epoch:
            if self._is_repeated(topics.WHEELS.key, last_wheels.stamp, wheels.stamp):
                return
            yield from self._integrate(last_wheels, wheels)
        elif last_wheels is not None and precedes(wheels.epoch, last_wheels.epoch, self.now):
            return  # a late message of the previous driver process
        else:
            self.gyro.skip_turn()
        self.last_wheels = wheels
        yield topics.ODOM(self._odometry(wheels))

    @on(topics.BASE_ODOMETRY)
    def base_odometry(self, message: BaseOdometry) -> Out:
        """Passes on the odometry of a base that does its own, with the gyro's heading where there is one."""
        last = self.last_base
        is_next = last is not None and last.epoch == message.epoch
        if last is not None and is_next and self._is_repeated(topics.BASE_ODOMETRY.key, last.stamp, message.stamp):
            return
        if last is not None and not is_next and precedes(message.epoch, last.epoch, self.now):
            return  # a late message of the previous driver process
        corrected = self.base_scale.corrected(message)
        if self.config.gyro.use:
            corrected = self.base_heading.corrected(corrected)
            yield from self._watch_base_slip()
        if is_next:
            self.base_pose.add(corrected)
        else:
            self.base_pose.begin_epoch(corrected)
        self.last_base = message
        pose = self.base_pose
        covariance = np.clip(pose.covariance, -MAX_VARIANCE, MAX_VARIANCE)
        v, w = min(max(pose.v, -20.0), 20.0), min(max(pose.w, -50.0), 50.0)
        yield topics.ODOM(Odometry(message.stamp, pose.odom_from_base, v, w, covariance.ravel()))

    def _watch_base_slip(self) -> Out:
        """Compares the turns of gyro and base in its last step."""
        turns = self.base_heading.turns
        self.by_gyro = turns is not None
        if turns is None:
            self.slips = False
        else:
            yield from self._watch_slip(*turns)

    def _is_repeated(self, key: str, before: int, stamp: int) -> bool:
        """Whether a stamp (ns) is not after the one before in its epoch; then the message is rejected."""
        if stamp > before:
            return False
        detail = "stamps stand still" if stamp == before else "stamps go back"
        self.rejections.reject(key, RejectionCause.SEQUENCE, detail, self.now)
        return True

    def _integrate(self, before: WheelState, after: WheelState) -> Out:
        drive = self.robot.drive
        left = (after.left - before.left) * drive.left_radius
        right = (after.right - before.right) * drive.right_radius
        flicker = STANDING_M / drive.left_radius, STANDING_M / drive.right_radius
        self.gyro.watch_wheels(after.stamp, after.left, after.right, flicker)
        if max(abs(left), abs(right)) > MAX_TRAVEL_M:
            self.gyro.skip_turn()
            yield Log("WARNING", f"the wheels jumped by {left:.0f} and {right:.0f} m: not taken as motion")
            return
        turn = self.gyro.turn_until(after.stamp) if self.config.gyro.use else None
        self.by_gyro = turn is not None
        if turn is None:
            self.slips = False
            motion, jacobian = self.integrate(left, right, drive.wheel_distance)
            variances = self.config.wheel_variance * abs(left), self.config.wheel_variance * abs(right)
        else:
            motion, by_forward, by_turn = arc_motion((left + right) / 2, turn)
            jacobian = np.column_stack((by_forward, by_turn))
            seconds = (after.stamp - before.stamp) * 1e-9
            difference = turn - (right - left) / drive.wheel_distance
            yield from self._watch_slip(turn, turn - difference, seconds)
            variances = self._gyro_variances(left, right, turn, seconds, difference)
        covariance = propagated_covariance(self.covariance, self.odom_from_base.yaw, motion, jacobian, variances)
        self.covariance = covariance if covariance.max() < MAX_VARIANCE else self.covariance
        self.odom_from_base = self.odom_from_base @ motion

    def _gyro_variances(
        self, left: float, right: float, turn: float, seconds: float, difference: float
    ) -> tuple[float, float]:
        """Variances of the mean travel (m^2) and of the gyro's turn (rad^2).

        While the wheels slip, either wheel may have made the difference (rad) of gyro and wheels. Then the mean travel
        is wrong by half of that wheel's slip.
        """
        gyro = self.config.gyro
        forward = self.config.wheel_variance * (abs(left) + abs(right)) / 4
        if self.slips:
            forward += (difference * self.robot.drive.wheel_distance / 2) ** 2
        moves = left != 0 or right != 0 or turn != 0
        return forward, gyro.yaw_variance * seconds * moves + gyro.turn_variance * abs(turn)

    def _watch_slip(self, gyro: float, wheels: float, seconds: float) -> Out:
        """Compares the turns (rad) of both sources; logs the begin of a slip."""
        slips = self.gyro.is_slipping(gyro, wheels, seconds)
        if slips and not self.slips:
            self.n_slips += 1
            last = self._slip_logged_at
            if last is None or not 0 <= self.now - last < SLIP_QUIET_NS:
                self._slip_logged_at = self.now
                yield Log("WARNING", f"a wheel slips: gyro and wheels turn differently ({self.n_slips} times)")
        self.slips = slips

    def _odometry(self, wheels: WheelState) -> Odometry:
        drive = self.robot.drive
        left, right = drive.left_radius * wheels.left_speed, drive.right_radius * wheels.right_speed
        v, w = (left + right) / 2, (right - left) / drive.wheel_distance
        if self.by_gyro:
            w = self.gyro.rate
        # a board may report any speed; the message's bounds are what a robot can do
        v, w = min(max(v, -20.0), 20.0), min(max(w, -50.0), 50.0)
        return Odometry(wheels.stamp, self.odom_from_base, v, w, self.covariance.ravel())
