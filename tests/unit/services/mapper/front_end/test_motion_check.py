# SPDX-License-Identifier: Apache-2.0
"""Scans and odometry that disagree are detected, and slip is no disagreement."""

import pytest

from services.mapper.front_end.motion_check import MIN_DISAGREEMENT_S, MIN_LOST_S, WINDOW_S, MotionCheck
from shared.geometry import Pose2


def check_after(step: Pose2, moved: Pose2, seconds: float, rate: float) -> MotionCheck:
    check = MotionCheck()
    for _ in range(round(seconds * rate)):
        check.add(step, moved, 1 / rate)
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
def test_motions_that_no_slip_explains_disagree_within_a_second_and_are_lost_in_two(rate, by_odometry, by_match):
    a, b = (Pose2(p.x / rate, p.y / rate, p.yaw / rate) for p in (by_odometry, by_match))
    assert not check_after(a, b, MIN_DISAGREEMENT_S / 2, rate).disagrees
    assert check_after(a, b, WINDOW_S + MIN_DISAGREEMENT_S + 4 / rate, rate).disagrees
    assert not check_after(a, b, MIN_DISAGREEMENT_S + WINDOW_S, rate).is_lost
    assert check_after(a, b, WINDOW_S + MIN_LOST_S + 8 / rate, rate).is_lost


@pytest.mark.parametrize("share", [0.75, 0.9, 1.1, 1.3])
def test_a_wheel_that_slips_by_a_quarter_is_no_disagreement(share):
    step = Pose2(0.08, 0, 0.05)
    assert check_after(step, Pose2(share * step.x, 0, share * step.yaw), 10, 10).seconds == 0


def test_when_they_agree_again_the_disagreement_ends():
    check = check_after(Pose2(0.05, 0, 0), Pose2(), 2, 10)
    assert check.disagrees
    for _ in range(10):
        check.add(Pose2(0.05, 0, 0), Pose2(0.05, 0, 0), 0.1)
    assert not check.disagrees
    assert check.seconds == 0


def test_one_scan_after_a_long_pause_is_no_disagreement():
    assert not check_after(Pose2(2, 0, 0), Pose2(), 8, 0.25).disagrees
