# SPDX-License-Identifier: Apache-2.0
"""The heading of a base with odometry of its own is the gyro's, where there is one, and else the base's own."""

from math import nan, pi

import numpy as np
import pytest

from services.odometry.dead_reckoning import DeadReckoningConfig
from services.odometry.service import OdometryService
from shared.config import load_robot
from shared.geometry import Pose2, arc
from shared.messages import BaseOdometry, Imu, Odometry
from shared.service import Log

ROBOT = load_robot("turtlebot3_burger").robot
STEP_NS, STEP_S = 20_000_000, 0.02
BIAS = 0.02  # rad/s


class Robot:
    """A base whose own odometry turns too much by a share, and a gyro with a bias, at 50 Hz."""

    def __init__(self, turn_error: float = 0.0, has_pose: bool = True, **gyro: object) -> None:
        self.odometry = OdometryService(DeadReckoningConfig.model_validate({"gyro": gyro}), ROBOT)
        self.turn_error, self.has_pose = turn_error, has_pose
        self.true, self.reported = Pose2(), Pose2()
        self.now, self.epoch, self.has_imu = 10**9, 1, True
        self.out: list[Odometry] = []
        self.lines: list[str] = []

    def go(self, seconds: float, v: float = 0.0, w: float = 0.0) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.now += STEP_NS
            self.odometry.now = self.now
            self.true @= arc(v * STEP_S, w * STEP_S)
            turn_rate = w * (1 + self.turn_error)
            self.reported @= arc(v * STEP_S, turn_rate * STEP_S)
            if self.has_imu:
                list(self.odometry.imu(Imu(self.now, w + BIAS, nan, nan, nan)))
            pose = self.reported if self.has_pose else Pose2()
            covariances = np.zeros(9), np.zeros(9)
            message = BaseOdometry(
                self.now, self.epoch, self.has_pose, pose, True, v, 0.0, turn_rate, *covariances, nan
            )
            for item in self.odometry.base_odometry(message):
                if isinstance(item, Log):
                    self.lines.append(item.text)
                else:
                    self.out.append(item.message)

    @property
    def estimate(self) -> Pose2:
        return self.out[-1].odom_from_base


def error(robot: Robot) -> tuple[float, float]:
    """m and rad between the estimate and the truth."""
    off = robot.true.inverse() @ robot.estimate
    return robot.true.distance(robot.estimate), abs(off.yaw)


def driven(**options: object) -> Robot:
    robot = Robot(**options)
    robot.go(2.0)
    for _ in range(4):
        robot.go(2.0, v=0.2)
        robot.go(1.0, v=0.1, w=pi / 2)
    robot.go(1.0)
    return robot


@pytest.mark.parametrize("has_pose", [True, False])
def test_the_gyro_corrects_a_base_that_turns_wrongly(has_pose):
    robot = driven(turn_error=0.1, has_pose=has_pose)
    off, turned = error(robot)
    assert off < 0.02
    assert turned < 0.02
    uncorrected = driven(turn_error=0.1, has_pose=has_pose, use=False)
    assert error(uncorrected)[1] > 0.4


def test_without_a_gyro_the_pose_is_the_bases_own_to_the_bit():
    robot = Robot(turn_error=0.1)
    robot.has_imu = False
    robot.go(1.0)
    robot.go(3.0, v=0.2, w=0.3)
    assert robot.estimate == robot.reported
    assert robot.odometry.state() == "heading by wheels: no imu"


def test_a_gyro_that_falls_silent_gives_the_heading_back_to_the_base_without_a_jump():
    robot = driven(turn_error=0.1)
    before, reported = robot.estimate, robot.reported
    robot.has_imu = False
    robot.go(1.0, v=0.1, w=0.5)
    step = before.inverse() @ robot.estimate
    by_base = reported.inverse() @ robot.reported
    assert step.distance(by_base) < 0.01
    assert abs((by_base.inverse() @ step).yaw) < 0.05


def test_a_restarted_base_continues_where_it_was():
    robot = driven(turn_error=0.1)
    robot.epoch, robot.reported = 2, Pose2(5.0, 5.0, 1.0)
    before = robot.estimate
    robot.go(STEP_S)
    assert robot.estimate == before
    robot.go(1.0, v=0.2)
    assert (before.inverse() @ robot.estimate).x == pytest.approx(0.2, abs=0.02)


def test_a_base_that_turns_otherwise_than_the_gyro_is_reported_as_slip():
    robot = Robot(turn_error=1.0)
    robot.go(2.0)
    robot.go(1.5, w=0.5)
    assert any("slips" in line for line in robot.lines)
    assert not driven().lines
