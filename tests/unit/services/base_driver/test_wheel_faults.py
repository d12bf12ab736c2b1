# SPDX-License-Identifier: Apache-2.0
from math import pi

import pytest

from services.base_driver.encoders import EncoderConfig, Encoders
from services.base_driver.stuck_detection import StuckConfig
from services.base_driver.wheel_faults import MAX_RETRIES, RETRY_PAUSE_NS, RETRY_WINDOW_NS, WheelFaults
from services.base_driver.wheel_tracking import WheelTrackingConfig
from shared import reasons
from shared.config import load_robot

DRIVE = load_robot("x80sv").robot.drive
S = 1_000_000_000
COMMAND_M_S = 0.6 / DRIVE.wheel_radius  # rad/s


class FaultyWheels:
    """Two wheels with the command COMMAND_M_S. Each turns at a share of it, and is reported at 50 Hz."""

    def __init__(self):
        self.faults = WheelFaults(StuckConfig(), WheelTrackingConfig(), DRIVE)
        self.encoders = Encoders(EncoderConfig(), DRIVE)
        self.now = 100 * S

    def run(self, seconds, left, right, hz=50):
        """Turns the wheels by these shares of the command. The command is zero during a pause and after a fault."""
        for _ in range(round(seconds * hz)):
            self.now += S // hz
            stands = self.faults.is_pausing(self.now) or bool(self.faults.code)
            command = 0.0 if stands else COMMAND_M_S
            self.encoders.left += left * command / hz
            self.encoders.right += right * command / hz
            self.faults.update(self.now, self.encoders, (command, command), self.now)
        return self.faults.code


def test_one_wheel_that_stands_is_broken_at_once():
    wheels = FaultyWheels()
    assert wheels.run(1.0, 1.0, 1.0) == ""
    assert wheels.run(0.3, 0.0, 1.0) == reasons.WHEEL_STUCK.code
    assert wheels.faults.detail.startswith("the left wheel")


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_both_wheels_that_fall_behind_once_make_the_robot_stand_and_try_again(share):
    wheels = FaultyWheels()
    wheels.run(1.0, 1.0, 1.0)
    assert wheels.run(0.3, share, share) == ""
    assert 0 < wheels.faults.pause_until - wheels.now <= RETRY_PAUSE_NS
    assert wheels.run(3.0, 1.0, 1.0) == ""
    assert wheels.faults.pause_until < wheels.now


def test_both_wheels_that_fall_behind_are_found_where_reports_come_close_together():
    """From a drive on a busy machine: the board had no command for 0.2 s, and sent reports 5 ms apart afterwards."""
    wheels = FaultyWheels()
    wheels.run(1.0, 1.0, 1.0)
    wheels.run(0.12, 0.6, 0.6)
    count = 2 * pi / DRIVE.counts_per_turn
    for left, right in ((2, 4), (8, 6), (2, 4), (8, 6)):  # counts: as fast as before
        wheels.now += S // 200 if left < right else S * 3 // 200
        wheels.encoders.left += left * count
        wheels.encoders.right += right * count
        wheels.faults.update(wheels.now, wheels.encoders, (COMMAND_M_S, COMMAND_M_S), wheels.now)
    assert wheels.faults.code == ""
    assert wheels.faults.is_pausing(wheels.now)


@pytest.mark.parametrize("shares", [(0.0, 0.0), (0.0, 0.25), (0.25, 0.0), (0.3, 0.35)])
def test_both_wheels_that_fall_behind_again_and_again_are_a_fault_of_both_that_stays(shares):
    wheels = FaultyWheels()
    for _ in range(MAX_RETRIES + 1):
        assert wheels.faults.code == ""
        wheels.run(1.5, 1.0, 1.0)
        wheels.run(0.5, *shares)
    assert wheels.faults.code == (reasons.WHEEL_STUCK if 0.0 in shares else reasons.WHEEL_ASTRAY).code
    assert wheels.faults.detail == "the left and right wheel do not follow their commands, also after 2 pauses"
    wheels.faults.release()
    assert wheels.run(1.0, 1.0, 1.0) == ""


def test_what_happened_long_ago_counts_no_more():
    wheels = FaultyWheels()
    for _ in range(2 * MAX_RETRIES):
        wheels.run(1.5, 1.0, 1.0)
        assert wheels.run(0.5, 0.0, 0.0) == ""
        wheels.run(RETRY_WINDOW_NS / S, 1.0, 1.0)


def test_a_clock_that_is_set_back_neither_holds_the_robot_nor_blinds_the_watch():
    wheels = FaultyWheels()
    wheels.run(1.0, 1.0, 1.0)
    wheels.run(0.3, 0.0, 0.0)
    assert wheels.faults.is_pausing(wheels.now)
    assert not wheels.faults.is_pausing(wheels.now - 3600 * S)
    wheels = FaultyWheels()
    wheels.run(0.5, 0.0, 0.0)
    wheels.now -= 60 * S
    assert wheels.run(10.0, 0.0, 0.0) == reasons.WHEEL_STUCK.code


def test_angles_that_begin_again_at_zero_in_a_new_epoch_are_no_fault():
    wheels = FaultyWheels()
    wheels.encoders.left = wheels.encoders.right = 900_000.0
    wheels.encoders.epoch = 1
    wheels.run(1.0, 1.0, 1.0, hz=10)
    wheels.encoders.left = wheels.encoders.right = 0.0
    wheels.encoders.epoch = 2
    assert wheels.run(1.0, 1.0, 1.0, hz=10) == ""
    assert not wheels.faults.is_pausing(wheels.now)
