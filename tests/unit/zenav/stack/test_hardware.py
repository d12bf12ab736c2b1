# SPDX-License-Identifier: Apache-2.0
"""Which services run on which hardware, and that no simulation opens a device of the robot."""

from pathlib import Path

import pytest

from services.base_driver.config import BaseDriverConfig
from services.base_driver.service import BaseDriverService
from services.lidar_driver.service import LidarDriverConfig
from shared.config import UserError, configured
from zenav.stack.config_report import read_sections
from zenav.stack.hardware import Hardware, services_for, settings_for

NAMED = ("base_driver.port.device=/dev/ttyUSB0", "lidar_driver.port.device=/dev/ttyUSB1")
NUMBERED = ("base_driver.port.serial_number=A50285BI", "lidar_driver.port.serial_number='0001'")


@pytest.mark.parametrize("ports", [NAMED, NUMBERED], ids=["by name", "by serial number"])
def test_a_robot_whose_ports_are_given_speaks_with_both_devices(ports):
    file = configured("x80sv", list(ports))
    assert "lidar_driver" in services_for(Hardware.REAL, file)
    assert "sim" not in services_for(Hardware.REAL, file)
    assert BaseDriverService(file.section("base_driver", BaseDriverConfig), file.robot).serial is not None


@pytest.mark.parametrize("ports", [NAMED, NUMBERED], ids=["by name", "by serial number"])
@pytest.mark.parametrize("hardware", [Hardware.MESSAGES, Hardware.EMULATED])
def test_a_simulated_stack_opens_none_of_the_robot_s_devices(ports, hardware):
    file = configured("x80sv", list(ports))
    simulated = configured("x80sv", [*ports, *settings_for(hardware, file, Path("/run/links"))])
    used = [
        simulated.section("base_driver", BaseDriverConfig).port,
        simulated.section("lidar_driver", LidarDriverConfig).port,
    ]
    assert not any(port.by_number for port in used)
    emulated = ["/run/links/board", "/run/links/laser"]
    assert [port.device for port in used] == (emulated if hardware is Hardware.EMULATED else ["", ""])
    assert ("lidar_driver" in services_for(hardware, file)) is (hardware is Hardware.EMULATED)
    assert "sim" in services_for(hardware, file)


def test_only_a_stack_that_can_hear_other_robots_has_traffic():
    file = configured("x80sv", [])
    alone, among = (services_for(Hardware.MESSAGES, file, meets) for meets in (False, True))
    assert set(among) - set(alone) == {"traffic"}
    assert set(alone) <= set(among)


GYRO = ("base_driver.port.device=/dev/ttyUSB0", "imu_driver.port.device=/dev/ttyUSB2")


def test_a_board_with_a_gyro_beside_an_imu_driver_is_refused_with_the_way_out():
    with pytest.raises(UserError) as refused:
        read_sections(configured("turtlebot2", list(GYRO)))
    assert "the board kobuki publishes `imu`, too" in refused.value.what
    assert "base_driver.board.gyro: false" in refused.value.hint


def test_a_ros_2_robot_with_its_imu_beside_an_imu_driver_is_refused():
    with pytest.raises(UserError) as refused:
        read_sections(configured("turtlebot3_ros2", [GYRO[1], "ros2.imu=true"]))
    assert "ros2 publishes `imu`, too" in refused.value.what
    assert refused.value.hint == "leave out ros2.imu, or imu_driver.port"


@pytest.mark.parametrize(
    ("robot", "settings"),
    [
        ("turtlebot3_ros2", GYRO[1:]),
        ("turtlebot2", (*GYRO, "base_driver.board.gyro=false")),
        ("turtlebot2", GYRO[:1]),
        ("x80sv", GYRO),  # its board has none
    ],
)
def test_one_publisher_of_imu_is_valid(robot, settings):
    read_sections(configured(robot, list(settings)))
