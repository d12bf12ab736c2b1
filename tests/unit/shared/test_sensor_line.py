# SPDX-License-Identifier: Apache-2.0
"""The line of a sensor: when it is silent, when its sensor is started again, and what the log says."""

import pytest

from shared.messages import PortState
from shared.ports import PortConfig
from shared.sensor_line import SensorLine
from shared.types import NS_PER_S as S


def opened(at=0):
    line = SensorLine(PortConfig(device="/dev/laser"), "lidar_driver", "laser", 1.0)
    assert line.update_port(PortState(at, "laser", True, ""), at)
    return line


def logs(line, fault, n_readings):
    return [log.text for log in line.fault_log(fault, n_readings)]


def test_a_line_without_a_device_says_which_setting_is_missing():
    assert SensorLine(PortConfig(), "imu_driver", "imu", 1.0).why_closed == "no port: set imu_driver.port.device"


@pytest.mark.parametrize("detail", ["unplugged", ""])
def test_a_closed_port_has_a_cause(detail):
    line = opened()
    assert not line.update_port(PortState(S, "laser", False, detail), S)
    assert line.why_closed == (detail or "its port is closed")


def test_it_is_silent_after_the_time_without_a_byte_and_lacks_readings_after_twice_that_time():
    line = opened()
    assert not line.is_silent(S)
    assert line.is_silent(S + 1)
    for at in (S, 2 * S):
        line.add_bytes(at)
    assert not line.lacks_readings(2 * S)
    assert line.lacks_readings(2 * S + 1)


def test_after_a_silence_the_first_reading_may_take_its_time():
    line = opened()
    line.add_bytes(10 * S)
    assert not line.lacks_readings(12 * S)


def test_a_silent_sensor_is_started_once_in_the_time():
    line = opened()
    assert not line.is_start_due(S)
    assert line.is_start_due(S + 1)
    line.started_at = S + 1
    assert not line.is_start_due(2 * S)
    line.update_port(PortState(2 * S, "laser", False, ""), 2 * S)
    assert not line.is_start_due(9 * S)


def test_a_clock_that_is_set_back_leaves_no_time_ahead():
    line = opened(100 * S)
    line.add_bytes(100 * S)
    line.limit_times(5 * S)
    assert line.is_silent(7 * S)


def test_a_fault_is_logged_once_and_ends_with_the_next_reading():
    line = opened()
    assert logs(line, "", 3) == []
    assert logs(line, "no bytes", 3) == ["laser: no bytes"]
    assert logs(line, "no bytes", 3) == []
    assert logs(line, "no sense", 3) == ["laser: no sense"]
    assert logs(line, "", 3) == []
    assert logs(line, "", 4) == ["laser: in order again"]
    assert logs(line, "", 5) == []
