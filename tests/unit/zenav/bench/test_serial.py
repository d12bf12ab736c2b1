# SPDX-License-Identifier: Apache-2.0
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from services.base_driver.boards.board_config import SerialBoardConfig
from services.base_driver.drrobot import command_all
from services.base_driver.serial_board import SerialBoard
from shared.config import load_robot
from shared.drrobot import Type
from shared.messages import SerialData
from shared.runners.port import SerialLine
from zenav.bench.decoding import LASERS, SIZES, _laser, decoding
from zenav.bench.serial import LOST, FarEnd, serial_figures

ROBOT = load_robot("x80sv").robot


@contextmanager
def line(tmp_path) -> Iterator[tuple[FarEnd, SerialLine]]:
    """The bench's end of a line, and a driver's."""
    with FarEnd(tmp_path / "board", ROBOT) as far:
        near = SerialLine(str(tmp_path / "board"), 115200, True)
        yield far, near
        near.close()


def test_every_decoder_is_timed_with_every_size_of_reading():
    rates = decoding(20_000)
    assert set(rates) == {"board", *LASERS}
    assert all(set(row) == {str(size) for size in SIZES} for row in rates.values())
    assert min(rate for row in rates.values() for rate in row.values()) > 0


@pytest.mark.parametrize("model", LASERS)
def test_the_laser_s_bytes_that_are_timed_are_understood(model):
    decoder, stream = _laser(model, 20_000)
    beams = np.concatenate([returns.ranges for returns in decoder(stream)])
    assert len(beams) > 3000
    assert np.isfinite(beams).mean() > 0.9


def test_the_far_end_tells_when_the_bytes_of_the_expected_command_came(tmp_path):
    with line(tmp_path) as (far, near):
        far.expect(-100, 200)
        near.write(command_all(Type.VELOCITY_ALL, 1, 2, 200))
        assert far.time_obeyed(0.05) is None
        far.expect(-100, 200)
        near.write(command_all(Type.VELOCITY_ALL, -100, 200, 200))
        assert far.time_obeyed(10.0) is not None


def test_a_report_s_bytes_are_the_board_s(tmp_path):
    board = SerialBoard(SerialBoardConfig(), ROBOT, 0.5)
    with line(tmp_path) as (far, near):
        assert far.report(0.0) is None  # no WheelState comes of it
        report = None
        while report is None:
            report = board.receive(SerialData(1, "board", near.read()), 1).report
    assert (report.left_counts, report.right_counts) == (0, 0)
    assert len(report.ultrasonic) + len(report.infrared) == len(ROBOT.ranges)


def test_the_summary_holds_the_tails_and_what_was_lost_counts():
    delays = {"command": [0.001] * 97 + [LOST] * 3, "wheels": [0.002] * 100, "taken": [0.0005] * 100}
    rates = {"board": {"4096": 9.0, "64": 3.0}, "ld06": {"4096": 20.0, "64": 1.5}}
    summary = serial_figures(delays, rates)["summary"]
    assert summary["n_lost"] == 3
    assert summary["command_p50_ms"] == pytest.approx(1.0)
    assert summary["command_p99_ms"] == pytest.approx(LOST * 1e3)
    assert summary["wheels_p99_ms"] == pytest.approx(2.0)
    assert summary["decoding_slowest_mb_s"] == 1.5
