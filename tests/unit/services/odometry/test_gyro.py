# SPDX-License-Identifier: Apache-2.0
"""Heading by gyro: bias at standstill, fall back to the wheels, slip, and a covariance that is true to the error."""

from math import degrees, pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.odometry.dead_reckoning import DeadReckoningConfig
from services.odometry.service import OdometryService
from shared import topics
from shared.config import load_robot
from shared.messages import Imu, WheelState
from shared.rejections import RejectionCause
from shared.service import Log

ROBOT = load_robot("x80sv").robot
DRIVE = ROBOT.drive
STEP = 20_000_000  # ns
BIAS = 0.02  # rad/s


class Robot:
    """Wheels and a gyro with noise, at 50 Hz; either may be cut, and the wheels may slip."""

    def __init__(self, seed=0, sigma=0.0017, bias=BIAS, **gyro):
        self.odometry = OdometryService(DeadReckoningConfig.model_validate({"gyro": gyro}), ROBOT)
        self.rng, self.sigma, self.bias = np.random.default_rng(seed), sigma, bias
        self.now, self.angles, self.yaw = 10**9, [0.0, 0.0], 0.0
        self.has_imu = True
        self.log, self.newest = [], None

    def go(self, seconds, v=0.0, w=0.0, wheels_w=None):
        """Drives with these velocities; the wheels turn as if the turn rate was `wheels_w`."""
        wheels_w = w if wheels_w is None else wheels_w
        speeds = [(v + side * wheels_w * DRIVE.wheel_distance / 2) / DRIVE.wheel_radius for side in (-1, 1)]
        for _ in range(round(seconds * 50)):
            self.now += STEP
            self.odometry.now = self.now
            self.yaw += w * 0.02
            self.angles = [angle + speed * 0.02 for angle, speed in zip(self.angles, speeds, strict=True)]
            if self.has_imu:
                list(self.odometry.imu(self.reading(w)))
            state = WheelState(self.now, 1, *self.angles, *speeds)
            for out in self.odometry.wheels(state):
                if isinstance(out, Log):
                    self.log.append(out.text)
                else:
                    self.newest = out.message

    def reading(self, w, stamp=None):
        rate = w + self.bias + self.sigma * self.rng.standard_normal()
        return Imu(self.now if stamp is None else stamp, rate, 0.0, 0.0, 9.8)

    @property
    def error(self):
        """rad: heading of odometry minus the truth."""
        return (self.newest.odom_from_base.yaw - self.yaw + pi) % (2 * pi) - pi

    @property
    def sd(self):
        return self.newest.covariance[8] ** 0.5


def test_before_the_first_standstill_the_wheels_give_the_heading():
    robot = Robot()
    robot.go(5.0, 0.3, 0.1)
    assert robot.error == pytest.approx(-0.002, abs=1e-9)  # the first message is where it begins
    assert "no standstill yet" in robot.odometry.state()


def test_the_bias_is_found_at_standstill_and_the_heading_stays_true_where_the_wheels_are_wrong():
    robot = Robot()
    robot.go(3.0)
    assert robot.odometry.gyro.bias == pytest.approx(BIAS, abs=0.001)
    robot.go(20.0, 0.3, 0.2, wheels_w=0.25)
    assert degrees(abs(robot.error)) < 1.5
    wheels_only = Robot(use=False)
    wheels_only.go(3.0)
    wheels_only.go(20.0, 0.3, 0.2, wheels_w=0.25)
    assert degrees(wheels_only.error) == pytest.approx(degrees(1.0), abs=0.1)


def test_a_bias_that_walks_is_followed_from_stop_to_stop():
    robot = Robot()
    robot.go(3.0)
    for k in range(1, 6):
        robot.bias = BIAS + 0.002 * k
        robot.go(1.0, 0.3)
        robot.go(30.0)
    assert robot.odometry.gyro.bias == pytest.approx(BIAS + 0.01, abs=0.002)


def test_a_standing_robot_does_not_turn_by_noise():
    robot = Robot()
    robot.go(3.0)
    before = robot.newest.odom_from_base.yaw
    robot.go(60.0)
    assert robot.newest.odom_from_base.yaw == before


def test_a_robot_that_is_turned_while_its_wheels_stand_follows_and_takes_no_bias_from_it():
    robot = Robot()
    robot.go(3.0)
    bias = robot.odometry.gyro.bias
    robot.go(4.0, w=0.5, wheels_w=0.0)
    assert degrees(abs(robot.error)) < 2.0
    assert robot.odometry.gyro.bias == pytest.approx(bias, abs=0.001)


def test_a_silent_gyro_is_replaced_by_the_wheels_within_four_messages_and_taken_again_later():
    robot = Robot()
    robot.go(3.0)
    robot.go(2.0, 0.3, 0.5)
    assert robot.odometry.by_gyro
    robot.has_imu = False
    robot.go(0.08, 0.3, 0.5)
    assert not robot.odometry.by_gyro
    robot.go(4.0, 0.3, -0.5)
    assert degrees(abs(robot.error)) < 3.0  # the last rate was used for 60 ms
    robot.has_imu = True
    robot.go(4.0, 0.3, 0.5)
    assert robot.odometry.by_gyro
    assert degrees(abs(robot.error)) < 3.5


def test_readings_with_old_repeated_or_future_stamps_are_refused_and_counted():
    robot = Robot()
    robot.go(3.0)
    before = robot.odometry.gyro.stamp
    for stamp in (before, before - STEP, robot.now - 10**10, robot.now + 10**9):
        list(robot.odometry.imu(robot.reading(30.0, stamp)))
    assert robot.odometry.gyro.stamp == before
    counts = robot.odometry.rejections.counts
    assert counts[topics.IMU.key, RejectionCause.SEQUENCE] == 2
    assert counts[topics.IMU.key, RejectionCause.OLD] == 1
    assert counts[topics.IMU.key, RejectionCause.AHEAD] == 1


def test_slip_is_seen_told_once_and_widens_the_covariance():
    robot, calm = Robot(), Robot()
    for each in (robot, calm):
        each.go(3.0)
        each.go(2.0, 0.3, 0.0)
    assert robot.log == []
    robot.go(1.0, 0.3, 0.0, wheels_w=0.6)
    assert robot.odometry.slips
    assert robot.odometry.state() == "heading by gyro, slips"
    calm.go(1.0, 0.3, 0.0)
    assert robot.newest.covariance[0] > 5 * calm.newest.covariance[0]
    robot.go(2.0, 0.3, 0.0)
    robot.go(1.0, 0.3, 0.0, wheels_w=0.6)
    robot.go(2.0, 0.3, 0.0)
    assert robot.odometry.state() == "heading by gyro, 2 slips"
    assert len(robot.log) == 1


def test_a_sharp_turn_without_slip_is_no_slip():
    robot = Robot()
    robot.go(3.0)
    for _ in range(5):
        robot.go(1.0, 0.3, 2.0, wheels_w=2.1)
        robot.go(1.0, 0.3, -2.0, wheels_w=-2.1)
    assert robot.odometry.n_slips == 0


def test_the_covariance_of_the_heading_is_true_to_the_error():
    errors = []
    for seed in range(12):
        robot = Robot(seed)
        robot.go(3.0)
        for k in range(10):
            robot.go(3.0, 0.3, 0.4 * (-1) ** k)
        errors.append(robot.error / robot.sd)
    assert 0.05 < np.std(errors) < 1.5  # the sd also counts the error of a real gyro's scale, which this one has not


def test_a_new_driver_process_continues_the_heading():
    robot = Robot()
    robot.go(3.0)
    robot.go(1.0, 0.3, 0.5)
    before = robot.newest.odom_from_base.yaw
    state = WheelState(robot.now + STEP, 2 * 10**9, 0.0, 0.0, 0.0, 0.0)
    (out,) = robot.odometry.wheels(state)
    assert out.message.odom_from_base.yaw == before


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.floats(-50, 50), st.integers(-3, 8), st.floats(-1e3, 1e3)), max_size=30))
def test_any_readings_leave_a_finite_pose(readings):
    robot = Robot()
    robot.go(1.5)
    for rate, steps, roll in readings:
        robot.now += STEP
        robot.odometry.now = robot.now
        list(robot.odometry.imu(Imu(max(robot.now + steps * STEP, 0), rate, 0.0, 0.0, 0.0)))
        *_, out = robot.odometry.wheels(WheelState(robot.now, 1, roll, -roll, 0.0, 0.0))
        pose = out.message.odom_from_base
        assert np.isfinite([pose.x, pose.y, pose.yaw, *out.message.covariance]).all()
        assert abs(out.message.w) <= 50
