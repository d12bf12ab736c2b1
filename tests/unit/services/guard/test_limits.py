# SPDX-License-Identifier: Apache-2.0
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.guard.limits import ramped_velocity
from shared.config import load_robot

DRIVE = load_robot("x80sv").robot.drive  # 0.8 m/s^2, braking 1.2 m/s^2, 4 rad/s^2
speeds = st.floats(-0.8, 0.8)
turns = st.floats(-2, 2)
times = st.floats(0, 0.5)


@given(speeds, turns, speeds, turns, times)
def test_no_change_exceeds_the_accelerations(v, w, wanted_v, wanted_w, elapsed):
    next_v, next_w = ramped_velocity((v, w), (wanted_v, wanted_w), elapsed, DRIVE)
    assert abs(next_w - w) <= DRIVE.max_turn_acceleration * elapsed + 1e-12
    gained = max(0.0, abs(next_v) - abs(v)) if next_v * v >= 0 else abs(next_v)
    lost = max(0.0, abs(v) - abs(next_v)) if next_v * v >= 0 else abs(v)
    assert gained / DRIVE.max_acceleration + lost / DRIVE.max_braking <= elapsed + 1e-9


@given(speeds, turns, speeds, turns, times)
def test_it_goes_towards_what_is_wanted_and_not_beyond(v, w, wanted_v, wanted_w, elapsed):
    next_v, next_w = ramped_velocity((v, w), (wanted_v, wanted_w), elapsed, DRIVE)
    assert min(v, wanted_v) - 1e-12 <= next_v <= max(v, wanted_v) + 1e-12
    assert min(w, wanted_w) - 1e-12 <= next_w <= max(w, wanted_w) + 1e-12


@given(speeds, turns, speeds, turns)
def test_in_time_it_arrives(v, w, wanted_v, wanted_w):
    assert ramped_velocity((v, w), (wanted_v, wanted_w), 10.0, DRIVE) == pytest.approx((wanted_v, wanted_w), abs=1e-12)


@given(speeds, turns, times, times)
def test_two_steps_are_one(v, wanted_v, a, b):
    if v == 0:
        return
    halfway = ramped_velocity((v, 0.0), (wanted_v, 0.0), a, DRIVE)
    assert ramped_velocity(halfway, (wanted_v, 0.0), b, DRIVE)[0] == pytest.approx(
        ramped_velocity((v, 0.0), (wanted_v, 0.0), a + b, DRIVE)[0], abs=1e-9
    )


@given(speeds, turns, times)
def test_from_standstill_the_arc_is_kept(wanted_v, wanted_w, elapsed):
    v, w = ramped_velocity((0.0, 0.0), (wanted_v, wanted_w), elapsed, DRIVE)
    assert v * wanted_w == pytest.approx(w * wanted_v, abs=1e-12)


@given(speeds, turns, speeds, turns, times)
def test_forward_and_backward_are_alike(v, w, wanted_v, wanted_w, elapsed):
    next_v, next_w = ramped_velocity((v, w), (wanted_v, wanted_w), elapsed, DRIVE)
    assert ramped_velocity((-v, -w), (-wanted_v, -wanted_w), elapsed, DRIVE) == pytest.approx(
        (-next_v, -next_w), abs=1e-15
    )


@pytest.mark.parametrize(
    ("before", "wanted", "elapsed", "after"),
    [
        ((0.0, 0.0), (0.8, 0.0), 0.1, (0.08, 0.0)),
        ((0.0, 0.0), (0.1, 2.0), 0.1, (0.02, 0.4)),
        ((0.0, 0.0), (0.8, 0.5), 0.25, (0.2, 0.125)),
        ((0.4, 0.0), (0.8, 0.0), 0.1, (0.48, 0.0)),
        ((0.4, 0.0), (0.0, 0.0), 0.1, (0.28, 0.0)),
        ((0.4, 0.0), (0.35, 0.0), 0.1, (0.35, 0.0)),
        ((0.12, 0.0), (-0.3, 0.0), 0.2, (-0.08, 0.0)),
        ((-0.12, 0.0), (0.3, 0.0), 0.2, (0.08, 0.0)),
        ((0.4, 1.0), (0.4, -1.0), 0.1, (0.4, 0.6)),
        ((0.4, 0.0), (0.8, 1.0), 0.0, (0.4, 0.0)),
    ],
)
def test_examples(before, wanted, elapsed, after):
    assert ramped_velocity(before, wanted, elapsed, DRIVE) == pytest.approx(after)
