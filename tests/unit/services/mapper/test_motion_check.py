# SPDX-License-Identifier: Apache-2.0
"""Scans and odometry that disagree are noticed, and slip is not taken for that."""

import pytest

from services.mapper.motion_check import AT_ODDS_S, LOST_S, WINDOW, MotionCheck
from shared.geometry import Pose2


def disagreed_for(step: Pose2, moved: Pose2, seconds: float, rate: float) -> MotionCheck:
    check = MotionCheck()
    for _ in range(round(seconds * rate)):
        check.take(step, moved, 1 / rate)
    return check


@pytest.mark.parametrize("rate", [5, 10, 40])
@pytest.mark.parametrize(
    ("by_odometry", "by_match"),
    [
        (Pose2(0.5, 0, 0), Pose2()),  # a laser that shows the same again
        (Pose2(), Pose2(0.5, 0, 0)),  # odometry that stands still
        (Pose2(0.4, 0, 0), Pose2(-0.4, 0, 0)),
        (Pose2(0, 0, 1.0), Pose2()),
    ],
)
def test_motions_that_no_slip_explains_are_at_odds_within_a_second_and_lost_in_two(rate, by_odometry, by_match):
    a, b = (Pose2(p.x / rate, p.y / rate, p.yaw / rate) for p in (by_odometry, by_match))
    assert not disagreed_for(a, b, AT_ODDS_S / 2, rate).at_odds
    assert disagreed_for(a, b, WINDOW + AT_ODDS_S + 4 / rate, rate).at_odds
    assert not disagreed_for(a, b, AT_ODDS_S + WINDOW, rate).is_lost
    assert disagreed_for(a, b, WINDOW + LOST_S + 8 / rate, rate).is_lost


@pytest.mark.parametrize("share", [0.75, 0.9, 1.1, 1.3])
def test_a_wheel_that_slips_by_a_quarter_is_not_at_odds(share):
    step = Pose2(0.08, 0, 0.05)
    assert disagreed_for(step, Pose2(share * step.x, 0, share * step.yaw), 10, 10).seconds == 0


def test_when_they_agree_again_they_are_not_at_odds():
    check = disagreed_for(Pose2(0.05, 0, 0), Pose2(), 2, 10)
    assert check.at_odds
    for _ in range(10):
        check.take(Pose2(0.05, 0, 0), Pose2(0.05, 0, 0), 0.1)
    assert not check.at_odds
    assert check.seconds == 0


def test_one_scan_after_a_long_pause_is_not_enough_to_be_at_odds():
    assert not disagreed_for(Pose2(2, 0, 0), Pose2(), 8, 0.25).at_odds
