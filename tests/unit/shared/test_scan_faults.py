# SPDX-License-Identifier: Apache-2.0
import os
from dataclasses import replace
from math import pi
from pathlib import Path

import numpy as np
import pytest

from shared.config import Laser, Mount, load_robot
from shared.geometry import Pose2
from shared.messages import LaserScan
from shared.scan_faults import RepeatedScans, mismatch
from zenav.convert.carmen import read_carmen
from zenav.convert.content import range_max_of
from zenav.convert.records import LoggedScan

LOGS = Path(os.environ.get("ZENAV_DATA") or "") / "slam"  # noqa: TID251
LASER = load_robot("x80sv").robot.laser
MS = 1_000_000


def scan_of(laser, ranges=None, ms=0, **fields):
    ranges = np.ones(laser.n_beams, np.float32) if ranges is None else ranges
    scan = LaserScan(ms * MS, laser.angle_min, laser.angle_increment, 0.0, 0.05, 12.0, ranges)
    return replace(scan, **fields)


# --- beams that are not the configured ones --------------------------------------------------------------------------


@pytest.mark.parametrize("robot", ["x80sv", "x80sv_xv11", "jackal"])
def test_the_configured_beams_are_followed_also_the_other_way_round(robot):
    laser = load_robot(robot).robot.laser
    assert mismatch(scan_of(laser), laser) == ""
    last = laser.angle_min + (laser.n_beams - 1) * laser.angle_increment
    mirrored = scan_of(laser, angle_min=(last + pi) % (2 * pi) - pi, angle_increment=-laser.angle_increment)
    assert mismatch(mirrored, laser) == ""


def test_a_motor_that_turns_a_little_slower_gives_more_beams_of_the_same_sweep():
    n = LASER.n_beams + 20
    step = LASER.angle_increment * (LASER.n_beams - 1) / (n - 1)
    assert mismatch(scan_of(LASER, np.ones(n, np.float32), angle_increment=step), LASER) == ""


@pytest.mark.parametrize(
    ("n", "share", "numbers"),
    [(225, 1.0, ("225", "450")), (225, 2.0, ("225", "450")), (450, 0.8, ("0.0111701", "0.0139626")),
     (430, 1.0, ("430", "450")), (450, 0.95, ("450", "0.0132645"))],
)  # fmt: skip
def test_other_beams_are_told_with_both_numbers(n, share, numbers):
    told = mismatch(scan_of(LASER, np.ones(n, np.float32), angle_increment=share * LASER.angle_increment), LASER)
    assert all(number in told for number in numbers), told


def test_a_sweep_that_begins_elsewhere_is_told_unless_it_is_a_full_turn():
    half = Laser(
        angle_min=-pi / 2, angle_increment=pi / 180, n_beams=181, scan_time=0, rate=10, range_min=0, range_max=9
    )
    assert mismatch(scan_of(half, angle_min=-pi / 2 + 0.02), half) == ""
    assert "-1.571" in mismatch(scan_of(half, angle_min=-1.2), half)
    assert mismatch(scan_of(LASER, angle_min=1.0), LASER) == ""


# --- repeated scans --------------------------------------------------------------------------------------------------


class ScannedRoom:
    """A laser in a rectangle of 6 m by 4 m with a robot that stands or drives along x, ten scans a second."""

    def __init__(self, sigma=0.01, step=0.001, seed=0, half_length=3.0):
        self.repeats = RepeatedScans(Mount())
        self.rng = np.random.default_rng(seed)
        self.sigma, self.step, self.half_length = sigma, step, half_length
        self.ms, self.x, self.told = 0, 0.0, 0.0
        self.angles = LASER.angle_min + LASER.angle_increment * np.arange(LASER.n_beams)

    def measured(self):
        c, s = np.cos(self.angles), np.sin(self.angles)
        with np.errstate(divide="ignore"):
            to_ends = np.where(c > 0, self.half_length - self.x, self.half_length + self.x) / np.abs(c)
            ranges = np.minimum(to_ends, 2.0 / np.abs(s))
        ranges = ranges + self.sigma * self.rng.normal(size=len(ranges))
        ranges = np.round(ranges / self.step) * self.step if self.step else ranges
        return np.where(ranges > 12.0, np.nan, ranges).astype(np.float32)

    def run(self, n, speed=0.0, ranges=None, odom_speed=None):
        """The number of scans until the laser was found to repeat itself, 0 where it was not."""
        for i in range(n):
            self.ms += 100
            self.x += 0.1 * speed
            self.told += 0.1 * (speed if odom_speed is None else odom_speed)
            scan = scan_of(LASER, self.measured() if ranges is None else ranges, self.ms)
            if self.repeats.take(scan, Pose2(self.told, 0.0, 0.0)):
                return i + 1
        return 0


@pytest.mark.parametrize("speed", [0.0, 0.3])
@pytest.mark.parametrize(("sigma", "step"), [(0.01, 0.001), (0.001, 0.01), (0.005, 0.05)])
def test_a_buffer_of_a_laser_with_noise_is_found_within_half_a_second_standing_or_driving(speed, sigma, step):
    room = ScannedRoom(sigma, step)
    assert not room.run(30)
    frozen = room.measured()
    room.run(1, ranges=frozen)
    assert 0 < room.run(10, speed, frozen) <= 5
    assert not room.run(30), "it is over when scans change again"


@pytest.mark.parametrize("speed", [0.2, 0.5])
def test_without_known_noise_motion_that_should_have_changed_the_scan_finds_it(speed):
    room = ScannedRoom(0.0, 0.0)
    assert not room.run(10, speed)
    frozen = room.measured()
    assert 0 < room.run(20, speed, frozen) <= 0.2 / (0.1 * speed) + 1


@pytest.mark.parametrize("step", [0.0, 0.001, 0.05])
def test_a_laser_without_noise_may_repeat_while_the_robot_stands(step):
    room = ScannedRoom(0.0, step)
    assert not room.run(10)
    assert not room.run(20, 0.1)
    assert not room.run(100)


def test_a_laser_without_noise_may_repeat_in_a_corridor_whose_ends_it_does_not_see():
    room = ScannedRoom(0.0, 0.001, half_length=60.0)
    assert not room.run(10)
    assert not room.run(50, 0.5)


def test_a_driver_that_publishes_each_sweep_twice_is_no_fault_and_its_buffer_still_is():
    room = ScannedRoom()
    for _ in range(40):
        ranges = room.measured()
        assert not room.run(3, ranges=ranges)
    assert 0 < room.run(10, ranges=room.measured()) <= 6


def test_few_returns_and_constant_ones_prove_no_repetition():
    room = ScannedRoom()
    room.run(30)
    assert not room.run(20, ranges=np.full(LASER.n_beams, np.nan, np.float32))
    assert not room.run(20, ranges=np.full(LASER.n_beams, 0.06, np.float32))


@pytest.mark.skipif(not LOGS.is_dir(), reason="ZENAV_DATA names no folder with slam/")
@pytest.mark.parametrize(
    "name", ["aces", "belgioioso", "edmonton", "fhw", "fr079-raw", "xiaon15", "xiaon40", "xiaon43"]
)
def test_no_real_log_holds_a_repeated_or_unlike_scan_and_a_repeated_one_is_found(name):
    scans = [r for r in read_carmen(LOGS / f"{name}.log.gz").records if isinstance(r, LoggedScan)][:3000]
    far, first = range_max_of(scans), scans[0]
    laser = Laser(
        angle_min=first.angle_min, angle_increment=first.angle_increment, n_beams=len(first.ranges), scan_time=0.0,
        rate=10, range_min=0.05, range_max=far,
    )  # fmt: skip
    repeats = RepeatedScans(Mount())
    for s in scans:
        scan = LaserScan(s.stamp, s.angle_min, s.angle_increment, 0.0, 0.05, far, s.ranges)
        assert not repeats.take(scan, s.odom_from_base)
        assert mismatch(scan, laser) == ""
