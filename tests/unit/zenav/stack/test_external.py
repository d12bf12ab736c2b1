# SPDX-License-Identifier: Apache-2.0
"""Which messages external programs must send, and what the launcher says about them."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from shared import sample_messages
from shared.codec import Envelope, encode
from shared.config import UserError, configured, load_robot
from shared.messages import BoardReport
from zenav.stack.external import ALL_RUN, PERIOD_S, ExternalWatch, expected_topics
from zenav.stack.hardware import Hardware
from zenav.stack.up import UpOptions, chosen_hardware, selected_services

FILE = load_robot("x80sv")
NOW = 1_700_000_000_000_000_000
DRIVING = ("base_driver", "odometry", "mapper", "guard")


class Ear:
    """A client whose messages the test hands over. seconds: of its clock."""

    def __init__(self) -> None:
        self.callbacks: dict[str, Any] = {}
        self.seconds = 0.0

    def listen_raw(self, key: str, callback: Any) -> None:
        self.callbacks[key] = callback

    def now(self) -> int:
        return NOW + round(self.seconds * 1e9)


def keys(names: tuple[str, ...], external: tuple[str, ...] = (), file: Any = FILE) -> list[str]:
    return [topic.key for topic in expected_topics(names, external, file)]


def test_without_a_source_board_and_scan_are_expected():
    assert keys(DRIVING) == ["hardware/board", "scan"]
    assert keys(DRIVING, ("sim",)) == ["hardware/board", "scan"]
    assert keys((*DRIVING, "ros2")) == ["hardware/board", "scan"]
    assert keys((*DRIVING, "sim")) == []
    assert keys((*DRIVING, "lidar_driver")) == ["hardware/board"]
    with_board = configured("x80sv", ["base_driver.port.device=/dev/ttyUSB0"])
    assert keys(DRIVING, (), with_board) == ["scan"]
    assert keys(("planner",)) == []


def test_the_topics_of_an_external_service_are_expected_where_a_service_reads_them():
    assert keys(("odometry", "sim"), ("base_driver",)) == ["hardware/motors", "base/wheels"]
    assert keys(("base_driver", "sim"), ("odometry",)) == []


def test_the_launcher_says_what_is_missing_what_is_wrong_and_what_passes():
    ear, shown = Ear(), list[str]()
    watch = ExternalWatch(ear, expected_topics(DRIVING, ("sim",), FILE), FILE.robot, shown.append, lambda: ear.seconds)
    assert "nothing usable comes on hardware/board, scan; hint: " in watch.ready_text()
    board = BoardReport(0, 1, 2, 0.0, 0.0, np.ones(2, np.float32), np.ones(7, np.float32), 7, np.zeros(2, np.float32))
    sequence = 0

    def run(board: BoardReport, scans: bool) -> None:
        nonlocal sequence
        for i in range(round(50 * PERIOD_S)):
            sequence += 1
            ear.seconds = sequence / 50
            envelope = Envelope("sim", "a", sequence, ear.now())
            ear.callbacks["hardware/board"]("", encode(replace(board, stamp=ear.now()), envelope))
            if scans and i % 5 == 0:
                ear.callbacks["scan"]("", encode(sample_messages.scan(ear.now(), FILE.robot.laser), envelope))
            watch.step()

    run(board, scans=True)
    assert ["the board sends 2 ultrasonic ranges, robot.ranges has 3" in line for line in shown] == [True, False]
    assert "scan passes: 10.0 Hz of sim" in shown[1]
    assert watch.missing() == ["hardware/board"]
    run(replace(board, ultrasonic=np.ones(3, np.float32)), scans=False)
    assert shown[2:] == ["hardware/board passes: 50.0 Hz of sim", "scan: no messages any more", ALL_RUN]
    run(replace(board, ultrasonic=np.ones(3, np.float32)), scans=False)
    assert len(shown) == 5, "a state is reported once"


def test_a_wrong_external_service_is_an_error_with_a_hint():
    assert selected_services([], ["sim", "guard"], ["sim"]) == ["guard"]
    with pytest.raises(UserError, match="simm is not a service"):
        selected_services([], ["guard"], ["simm"])
    with pytest.raises(UserError, match="no service is left"):
        selected_services(["sim"], [], ["sim"])
    assert chosen_hardware(UpOptions(external=["sim"])) is Hardware.MESSAGES
    assert chosen_hardware(UpOptions(external=["base_driver"])) is Hardware.REAL
    for wrong in ({"world": "office"}, {"hardware": Hardware.EMULATED}, {"speed": 2.0}):
        with pytest.raises(UserError, match="own world"):
            chosen_hardware(UpOptions(external=["sim"], **wrong))
