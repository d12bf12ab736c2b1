# SPDX-License-Identifier: Apache-2.0
from math import pi

import numpy as np
import pytest

from services.base_driver.encoders import MAX_ANGLE_RAD, EncoderConfig, Encoders
from services.base_driver.kinematics import max_wheel_speed
from shared.config import load_robot
from shared.messages import BoardReport

DRIVE = load_robot("x80sv").robot.drive
RAD = 2 * pi / 756


def report(seconds, left, right, speed=0.0):
    nothing = np.empty(0, np.float32)
    counts = left % 32768, right % 32768
    return BoardReport(round(seconds * 1e9), *counts, speed, speed, nothing, nothing, 7.2, np.zeros(2, np.float32))


def turned(*reports):
    encoders = Encoders(EncoderConfig(), DRIVE)
    for one in reports:
        encoders.update(one, one.stamp)
    return encoders


@pytest.mark.parametrize("elapsed", [0.02, 0.1, 0.5])
@pytest.mark.parametrize("sign", [1, -1])
def test_twice_the_fastest_wheel_is_the_most_that_counts_as_motion(elapsed, sign):
    most = int(2 * max_wheel_speed(DRIVE) * (elapsed + 0.02) / RAD)
    kept = turned(report(1, 0, 0), report(1 + elapsed, 0, sign * most))
    assert (kept.n_jumps, kept.left) == (0, 0)
    assert kept.right == pytest.approx(sign * most * RAD)
    jumped = turned(report(1, 0, 0), report(1 + elapsed, sign * (most + 1), 3))
    assert (jumped.n_jumps, jumped.left, jumped.right) == (1, 0, 0)


def test_a_longer_gap_allows_no_more():
    most = int(2 * max_wheel_speed(DRIVE) * 0.52 / RAD)
    assert turned(report(1, 0, 0), report(61, most, 0)).n_jumps == 0
    assert turned(report(1, 0, 0), report(61, most + 1, 0)).n_jumps == 1


def test_counters_that_are_back_at_zero_after_a_pause_are_a_jump_and_not_motion():
    n = 300  # 0.2 m
    assert turned(report(1, -n, n), report(1.6, 0, 0)).n_jumps == 1
    for reports in (
        (report(1, -n, n), report(1.4, 0, 0)),  # no pause
        (report(1, -n, n), report(1.6, 0, n)),
        (report(1, -20, 20), report(1.6, 0, 0)),
    ):
        assert turned(*reports).n_jumps == 0


def test_counting_goes_on_after_a_jump():
    encoders = turned(report(1, 0, 0), report(1.02, 9000, 9000), report(1.04, 8990, 9010))
    assert (encoders.left, encoders.right) == pytest.approx((10 * RAD, 10 * RAD))


def test_any_speed_of_the_board_is_within_the_message_s_bounds():
    encoders = Encoders(EncoderConfig(), DRIVE)
    (state,) = encoders.update(report(1, 0, 0, speed=1e6), 10**9)
    assert (state.left_speed, state.right_speed) == (-1000, 1000)
    (state,) = encoders.update(report(2, 0, 0, speed=-1e6), 2 * 10**9)
    assert (state.left_speed, state.right_speed) == (1000, -1000)


def test_the_epoch_is_when_the_first_report_came_and_a_restart_begins_another():
    encoders = Encoders(EncoderConfig(), DRIVE)
    assert encoders.update(report(1, 5, 5), 1_234)[0].epoch == 1_234
    assert encoders.update(report(2, 5, 9), 9_999)[0].epoch == 1_234
    encoders.restart()
    (state,) = encoders.update(report(0.5, 100, 100), 500)
    assert (state.epoch, state.left, state.right) == (500, 0, 0)


@pytest.mark.parametrize("sign", [1, -1])
def test_an_epoch_ends_beyond_900_000_rad(sign):
    encoders = turned(report(1, 0, 0))
    encoders.left = sign * 900_000.0
    assert len(encoders.update(report(1.02, 0, 0), 10**10)) == 1
    assert len(encoders.update(report(1.04, -sign, 0), 10**10)) == 2
    assert MAX_ANGLE_RAD == 900_000


@pytest.mark.parametrize("now", [5, 10**12])
def test_a_new_epoch_is_later_than_the_old_one(now):
    encoders = turned(report(1, 0, 0))
    encoders.right = -MAX_ANGLE_RAD
    old, new = encoders.update(report(1.02, 0, -1), now)
    assert new.epoch == max(now, old.epoch + 1)
    assert (new.left, new.right, new.stamp) == (0, 0, old.stamp)
