# SPDX-License-Identifier: Apache-2.0
"""/imu of a driven robot comes in as `imu`, in `base` and with our time, and never with a sign that may be wrong."""

from math import isnan
from typing import Any

import numpy as np
import pytest

from shared.geometry import Pose2
from shared.messages import Imu
from shared.robot import ImuMount
from tests.unit.services.ros2.core import Core

TYPE = "sensor_msgs/msg/Imu"


@pytest.fixture
def core() -> Core:
    return Core(drives=True, imu=True)


def reading(core: Core, rate: float = 0.5, force: tuple[float, float, float] = (1.0, 2.0, 9.8)) -> Any:
    """A message of a robot whose clock is an hour behind."""
    at, zeros = core.service.now + 100_000_000 - 3600 * 10**9, np.zeros(9)
    return core.make.new(
        TYPE, header=core.make.header(at, "imu_link"), orientation=core.make.turn(0.3), orientation_covariance=zeros,
        angular_velocity=core.make.vector(0.0, 0.0, rate), angular_velocity_covariance=zeros.copy(),
        linear_acceleration=core.make.vector(*force), linear_acceleration_covariance=zeros.copy(),
    )  # fmt: skip


def static(core: Core, roll: bool) -> None:
    message = core.make.transforms(core.make.transform(0, "base_link", "imu_link", Pose2()))
    if roll:
        turn = message.transforms[0].transform.rotation
        turn.x, turn.w = 1.0, 0.0
    core.message("/tf_static", message)


def test_a_reading_comes_in_with_its_turn_rate_its_force_and_our_time(core):
    [imu] = core.message("/imu", reading(core))
    assert isinstance(imu, Imu)
    assert imu.stamp == core.service.now
    assert (imu.yaw_rate, imu.acceleration_x, imu.acceleration_y, imu.acceleration_z) == (0.5, 1.0, 2.0, 9.8)


def test_a_sensor_upside_down_by_file_and_tf_is_turned_about():
    core = Core(drives=True, imu=True, imu_mount=ImuMount(upside_down=True))
    static(core, roll=True)
    [imu] = core.message("/imu", reading(core))
    assert (imu.yaw_rate, imu.acceleration_y) == (-0.5, -2.0)


@pytest.mark.parametrize("roll", [True, False])
def test_a_sensor_that_tf_places_otherwise_than_the_file_is_refused_with_the_setting(core, roll):
    static(core, roll)
    found = core.message("/imu", reading(core))
    assert (found == []) is roll
    if roll:
        assert any("set robot.imu.upside_down=true" in line for line in core.lines)


def test_a_sensor_without_a_gyro_is_refused(core):
    message = reading(core)
    message.angular_velocity_covariance[0] = -1
    assert core.message("/imu", message) == []
    assert any("without a turn rate" in line for line in core.lines)


@pytest.mark.parametrize(("force", "covariance"), [((1.0, 2.0, 9.8), -1.0), ((0.0, 1e9, 9.8), 0.0)])
def test_a_sensor_without_an_accelerometer_has_a_turn_rate_alone(core, force, covariance):
    message = reading(core, force=force)
    message.linear_acceleration_covariance[0] = covariance
    [imu] = core.message("/imu", message)
    assert isnan(imu.acceleration_x)
    assert isnan(imu.acceleration_z)
    assert imu.yaw_rate == 0.5


@pytest.mark.parametrize("rate", [float("nan"), float("inf"), 1e6])
def test_a_turn_rate_that_is_none_is_refused(core, rate):
    assert core.message("/imu", reading(core, rate)) == []
    assert core.lines
