# SPDX-License-Identifier: Apache-2.0
import csv
import gzip
import os
from itertools import pairwise
from math import exp, isnan, pi
from pathlib import Path

import pytest

from services.base_driver.kinematics import wheel_speeds
from services.base_driver.wheel_tracking import WheelTrackingConfig, WheelTrackingMonitor
from shared.config import load_robot

RADIUS = 0.1
DATA = os.environ.get("ZENAV_DATA")  # noqa: TID251  # where recordings are, for tests alone
needs_data = pytest.mark.skipif(DATA is None, reason="ZENAV_DATA is not set: the folder of recordings")


def astray_after(commanded, turning, seconds=2.0, hz=50, **settings):
    """When (s) a wheel with these rim speeds (m/s, functions of s) has a tracking fault, and its speed; None: never."""
    watch = WheelTrackingMonitor(WheelTrackingConfig(**settings))
    way = 0.0
    for k in range(round(seconds * hz) + 1):
        t = k / hz
        speed = watch.update(round(t * 1e9), way / RADIUS, commanded(t) / RADIUS, RADIUS)
        if not isnan(speed):
            return t, speed
        way += turning(t) / hz
    return None


def lagging(command, lag):
    """A wheel of first order behind a command that is 0 before t = 0 and `command` after."""
    return lambda t: command * (1 - exp(-t / lag))


@pytest.mark.parametrize("sign", [1, -1])
def test_a_wheel_that_stands_at_speed_is_found_soon(sign):
    when, speed = astray_after(lambda t: sign * 0.8, lambda t: sign * 0.8 if t < 1 else 0.0)
    assert 1.06 <= when <= 1.1
    assert speed == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_motor_that_is_swapped_at_speed_is_found_before_it_has_stopped(sign):
    when, speed = astray_after(lambda t: sign * 0.8, lambda t: sign * (0.8 if t < 1 else max(0.8 - 2 * (t - 1), -0.8)))
    assert 1.15 <= when <= 1.26
    assert 0.2 < speed < 0.6


@pytest.mark.parametrize("sign", [1, -1])
def test_a_swapped_motor_is_found_when_it_starts(sign):
    when, speed = astray_after(lambda t: sign * 0.8 * t, lambda t: -sign * 0.8 * t)
    assert when <= 0.55
    assert speed < -0.1


@pytest.mark.parametrize("command", [0.06, 0.3, 0.8, -0.06, -0.3])
@pytest.mark.parametrize("lag", [0.02, 0.1, 0.25, 0.3])
def test_a_sound_wheel_follows_a_step_however_slow_it_is(command, lag):
    assert astray_after(lambda t: command, lagging(command, lag)) is None


def test_a_command_may_take_its_time_to_the_motor():
    def late(t):
        return -0.3 if t < 1.2 else 0.4

    assert astray_after(lambda t: -0.3 if t < 1 else 0.4, late) is None
    assert astray_after(lambda t: -0.3 if t < 1 else 0.4, late, delay=0.0, lag=0.1) is not None


def test_a_wheel_slower_than_the_slowest_sound_one_is_astray():
    assert astray_after(lambda t: 0.8, lagging(0.8, 1.0)) is not None
    assert astray_after(lambda t: 0.8, lagging(0.8, 1.0), lag=1.0) is None


@pytest.mark.parametrize(("share", "found"), [(0.7, False), (0.76, False), (0.6, True)])
def test_how_much_slower_than_told_is_allowed(share, found):
    # 0.05 m/s and a fifth of 0.4 m/s: 0.27 m/s, 68 %
    assert (astray_after(lambda t: 0.4, lambda t: share * 0.4, seconds=4) is not None) is found


def test_too_fast_rolling_on_and_being_pushed_are_no_faults():
    assert astray_after(lambda t: 0.2, lambda t: 0.9) is None
    assert astray_after(lambda t: 0.0, lambda t: -0.5) is None
    assert astray_after(lambda t: 0.05, lambda t: -0.5) is None


def test_braking_as_fast_as_a_reversal_allows_is_no_fault():
    def command(t):
        return 0.8 if t < 1 else max(0.8 - 1.2 * (t - 1), -0.3)

    assert astray_after(command, lambda t: command(t - 0.15), seconds=4) is None


def test_short_hiccups_are_forgiven():
    assert astray_after(lambda t: 0.8, lambda t: 0.0 if t % 0.5 < 0.04 else 0.8, seconds=4) is None


def test_a_gap_between_reports_and_a_jump_are_not_judged():
    assert astray_after(lambda t: 0.8, lambda t: 0.0, hz=3) is None
    watch = WheelTrackingMonitor(WheelTrackingConfig())
    for k in range(200):
        if k % 3 == 0:
            watch.reset()
        assert isnan(watch.update(k * 20_000_000, 0.0, 8.0, RADIUS))


def test_stamps_that_stand_or_run_back_are_survived():
    watch = WheelTrackingMonitor(WheelTrackingConfig())
    for stamp in (5, 5, 3, 10**12, 0):
        assert isnan(watch.update(stamp * 10**7, 0.0, 8.0, RADIUS))


@needs_data
def test_the_real_robot_s_wheels_follow_what_they_were_told():
    """273 s of teleoperation, 10 reports a second: steps of up to 1 rad/s and no false alarm."""
    drive = load_robot("x80sv").robot.drive

    def rows(name):
        with gzip.open(Path(DATA) / "x80sv" / f"{name}.csv.gz", "rt") as file:
            return [[float(value) for value in row] for row in list(csv.reader(file))[1:]]

    commands, wrap = rows("cmd_vel"), 32768 * 2 * pi / 756
    watches = WheelTrackingMonitor(WheelTrackingConfig()), WheelTrackingMonitor(WheelTrackingConfig())
    angles, alarms, judged = [0.0, 0.0], [], 0
    for (_, *before), (t, *after) in pairwise(rows("wheel_positions")):
        steps = [b - a - wrap * round((b - a) / wrap) for a, b in zip(before, after)]
        angles = [angles[0] - steps[0], angles[1] + steps[1]]
        v, w = next(((v, w) for at, v, w in reversed(commands) if at <= t), (0.0, 0.0))
        for watch, angle, speed in zip(watches, angles, wheel_speeds(v, w, drive)):
            judged += abs(speed) * drive.wheel_radius > 0.05
            if not isnan(watch.update(round(t * 1e9), angle, speed, drive.wheel_radius)):
                alarms.append(t)
    assert judged > 1000
    assert alarms == []
