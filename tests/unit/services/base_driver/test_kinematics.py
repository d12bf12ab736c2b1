# SPDX-License-Identifier: Apache-2.0
from math import pi

import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.base_driver.kinematics import (
    board_counts,
    body_velocity,
    count_difference,
    max_wheel_speed,
    wheel_angles,
    wheel_speeds,
)
from shared.config import Drive, load_robot

X80 = load_robot("x80sv").robot.drive
speeds = st.floats(-3, 3)
drives = st.builds(
    lambda radius, ratio, distance, counts, direction: X80.model_copy(
        update={
            "wheel_radius": radius,
            "wheel_radius_ratio": ratio,
            "wheel_distance": distance,
            "counts_per_turn": counts,
            "motor_direction": direction,
        }
    ),
    st.floats(0.02, 0.5),
    st.floats(0.8, 1.25),
    st.floats(0.1, 1.5),
    st.integers(16, 100_000),
    st.sampled_from([-1, 1]),
)


def test_the_document_s_example_of_both_wheels_forward():
    # 200 counts/s on both wheels: left -200, right +200 on the board, 0.085 m * 200 * 2 pi / 756 in m/s
    v, w = body_velocity(*wheel_angles(-200, 200, X80), X80)
    assert v == pytest.approx(0.085 * 200 * 2 * pi / 756)
    assert w == 0


def test_the_document_s_equations():
    left, right = wheel_speeds(0.4, 0.5, X80)
    assert left == pytest.approx((2 * 0.4 - 0.5 * 0.283) / (2 * 0.085))
    assert right == pytest.approx((2 * 0.4 + 0.5 * 0.283) / (2 * 0.085))
    assert board_counts(left, right, X80) == pytest.approx((-left * 756 / (2 * pi), right * 756 / (2 * pi)))


def test_a_left_turn_runs_the_right_wheel_faster():
    left, right = wheel_speeds(0.2, 1.0, X80)
    assert right > left


@given(speeds, speeds, drives)
def test_wheel_speeds_and_body_velocity_are_inverse(v, w, drive: Drive):
    assert body_velocity(*wheel_speeds(v, w, drive), drive) == pytest.approx((v, w), abs=1e-9)


@given(drives)
def test_the_radii_have_their_mean_and_their_ratio(drive: Drive):
    assert (drive.left_radius + drive.right_radius) / 2 == pytest.approx(drive.wheel_radius)
    assert drive.right_radius / drive.left_radius == pytest.approx(drive.wheel_radius_ratio)


def test_equal_wheels_have_exactly_the_radius():
    assert (X80.left_radius, X80.right_radius) == (0.085, 0.085)


@given(speeds, speeds, drives)
def test_board_counts_and_wheel_angles_are_inverse(left, right, drive: Drive):
    assert wheel_angles(*board_counts(left, right, drive), drive) == pytest.approx((left, right), abs=1e-12)


@given(speeds, speeds)
def test_the_motor_direction_turns_both_signs(left, right):
    turned = X80.model_copy(update={"motor_direction": -1})
    assert board_counts(left, right, turned) == tuple(-c for c in board_counts(left, right, X80))


@given(st.integers(2, 2**31), st.data())
def test_a_step_is_recovered_across_the_wrap(wrap, data):
    before = data.draw(st.integers(0, wrap - 1))
    step = data.draw(st.integers(-((wrap - 1) // 2), wrap // 2))
    assert count_difference(before, (before + step) % wrap, wrap) == step


def test_the_wrap_itself():
    assert count_difference(32767, 0, 32768) == 1
    assert count_difference(0, 32767, 32768) == -1
    assert count_difference(0, 16384, 32768) == 16384, "half way round counts up"
    assert count_difference(0, 16385, 32768) == -16383


@given(speeds, speeds, drives)
def test_no_wheel_turns_faster_than_the_fastest_within_the_limits(v, w, drive: Drive):
    left, right = wheel_speeds(*drive.clamped(v, w), drive)
    assert max(abs(left), abs(right)) <= max_wheel_speed(drive) * (1 + 1e-12)
    either_way = [wheel_speeds(drive.max_speed, w, drive) for w in (drive.max_turn_rate, -drive.max_turn_rate)]
    assert max_wheel_speed(drive) == pytest.approx(max(max(wheels) for wheels in either_way), rel=1e-12)


@given(speeds, speeds)
def test_clamping_keeps_the_arc_and_the_limits_and_touches_nothing_within(v, w):
    limited_v, limited_w = X80.clamped(v, w)
    assert -X80.max_reverse_speed <= limited_v * (1 - 1e-12) <= X80.max_speed
    assert abs(limited_w) * (1 - 1e-12) <= X80.max_turn_rate
    assert limited_v * w == pytest.approx(v * limited_w, abs=1e-12)
    assert limited_v * v >= 0
    assert limited_w * w >= 0
    if -X80.max_reverse_speed <= v <= X80.max_speed and abs(w) <= X80.max_turn_rate:
        assert (limited_v, limited_w) == (v, w)
    else:
        at_limit = (limited_v / X80.max_speed, -limited_v / X80.max_reverse_speed, abs(limited_w) / X80.max_turn_rate)
        assert max(at_limit) == pytest.approx(1)
