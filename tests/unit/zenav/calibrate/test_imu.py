# SPDX-License-Identifier: Apache-2.0
"""The inertial sensor's calibration: on simulated squares, its readings turned as if the file were wrong."""

from dataclasses import replace
from math import cos, radians, sin

import pytest

from shared.config import UserError, load_robot
from shared.recording import Writer, about, sink
from tests.lockstep.stack import HALL
from tests.unit.zenav.calibrate.drive import CalibrationBench
from zenav.__main__ import _status
from zenav.calibrate import imu as calibration
from zenav.calibrate.manoeuvre import square
from zenav.calibrate.odometry import by_scans


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("imu")
    (folder / "hall.yaml").write_text(HALL)
    return folder


@pytest.fixture(scope="module")
def bench(folder):
    """Two squares in a hall, with an inertial sensor; recorded too."""
    with Writer(folder / "squares.mcap", about("x80")) as writer:
        bench = CalibrationBench("robot.imu={}", world=str(folder / "hall.yaml"), record=sink(writer))
        for clockwise in (True, False):
            bench.perform(square(0.7, clockwise, 0.4, 1.2, bench.robot.drive))
    return bench


@pytest.fixture(scope="module")
def solve(bench):
    """A function of readings; the scans are matched once."""
    solution, pieces, _ = by_scans(bench.log, bench.robot)
    return lambda imus: calibration.solve(imus, pieces, bench.log.rolled, solution.wheels)


def turned(reading, angle, up=1.0):
    """A reading as published by a file whose sensor is turned `angle` rad less than it is."""
    x, y = reading.acceleration_x, up * reading.acceleration_y
    c, s = cos(-angle), sin(-angle)
    return replace(reading, yaw_rate=up * reading.yaw_rate, acceleration_x=c * x - s * y, acceleration_y=s * x + c * y)


@pytest.mark.parametrize("degrees_off", [0, 30, -90, 179])
def test_scale_bias_and_direction_are_the_simulators(bench, solve, degrees_off):
    found = solve([turned(reading, radians(degrees_off)) for reading in bench.log.imus])
    noise = bench.file.section("sim", bench.lockstep.service("sim").config_type).imu
    assert found.scale == pytest.approx(1 + noise.scale_error, abs=4 * found.sigma_scale + 1e-3)
    assert found.bias == pytest.approx(noise.bias, abs=2e-3)
    assert cos(found.yaw - radians(degrees_off)) > cos(radians(5))
    assert not found.is_upside_down


def test_a_sensor_upside_down_reads_turns_the_other_way_round(bench, solve):
    found = solve([turned(reading, 0.0, up=-1.0) for reading in bench.log.imus])
    assert found.is_upside_down
    assert found.has_right_axis


def test_a_gyro_of_another_axis_is_no_gyro(bench, solve):
    found = solve([replace(reading, yaw_rate=0.2 * reading.yaw_rate) for reading in bench.log.imus])
    assert not found.has_right_axis


def test_a_sensor_that_falls_silent_loses_those_pieces_alone(bench, solve):
    everything = solve(bench.log.imus)
    middle = len(bench.log.imus) // 2
    fewer = solve([*bench.log.imus[: middle - 100], *bench.log.imus[middle + 100 :]])
    assert 0.5 * len(everything.scans) < len(fewer.scans) < len(everything.scans)
    assert fewer.scale == pytest.approx(everything.scale, abs=0.01)


def test_without_readings_or_turns_it_says_so(bench, solve):
    with pytest.raises(UserError, match="no imu"):
        solve([])
    with pytest.raises(UserError, match="turns too little"):
        solve(bench.log.imus[:50])


def test_the_command_reports_and_writes(bench, folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    recording, mine = folder / "squares.mcap", tmp_path / "mine.yaml"
    mine.write_text(bench.file.text.replace("imu: {}", "imu: {yaw: 0.5}"))
    assert _status(["calibrate", "imu", str(recording), "--robot", str(mine), "--write"]) == 0
    report = capsys.readouterr().out
    assert "of a turn" in report
    assert load_robot(str(mine)).robot.imu.yaw == pytest.approx(0.5, abs=0.1)
    assert _status(["calibrate", "imu", str(recording), "--robot", "x80sv"]) == 2
    assert "has no inertial sensor" in capsys.readouterr().err
