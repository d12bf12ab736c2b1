# SPDX-License-Identifier: Apache-2.0
"""Rollouts keep the drive's limits and follow exact arcs."""

from math import cos, sin

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.local_ctrl.rollout import (
    Limits,
    Motion,
    SentCommand,
    arc_step,
    limits_of,
    predicted_motion,
    speed_after,
    turn_rate_after,
)
from shared.config import load_robot
from shared.geometry import Pose2, arc

LIMITS = Limits(-0.3, 0.8, 2.0, 0.8, 1.2, 4.0)
MS = 1_000_000

speeds = st.floats(-0.3, 0.8)
targets = st.floats(-3, 3)
rates = st.floats(-2, 2)
steps = st.floats(0.005, 0.2)


@settings(deadline=None)
@given(speeds, targets, steps)
def test_speed_keeps_the_limits_and_never_passes_the_target(v: float, target: float, dt: float) -> None:
    after = speed_after(v, target, LIMITS, dt)
    assert LIMITS.v_min <= after <= LIMITS.v_max
    slower = abs(after) < abs(v)
    assert abs(after - v) <= (LIMITS.braking if slower else LIMITS.acceleration) * dt + 1e-12
    goal = min(max(target, LIMITS.v_min), LIMITS.v_max)
    assert min(v, goal) - 1e-12 <= after <= max(v, goal) + 1e-12


@settings(deadline=None)
@given(speeds, targets, steps)
def test_speed_comes_to_its_target(v: float, target: float, dt: float) -> None:
    for _ in range(1000):
        v = speed_after(v, target, LIMITS, dt)
    assert v == min(max(target, LIMITS.v_min), LIMITS.v_max)


@settings(deadline=None)
@given(rates, targets, steps)
def test_turn_rate_keeps_the_limits(w: float, target: float, dt: float) -> None:
    after = turn_rate_after(w, target, LIMITS, dt)
    assert abs(after) <= LIMITS.w_max
    assert abs(after - w) <= LIMITS.turn_acceleration * dt + 1e-12


@settings(deadline=None)
@given(speeds, st.floats(-20, 20), steps, st.integers(1, 60))
def test_steps_of_a_constant_command_are_the_closed_arc(v: float, w: float, dt: float, n: int) -> None:
    x, y, yaw = 0.0, 0.0, 0.0
    for _ in range(n):
        chord, cosine, sine, half = arc_step(v, w, dt)
        x += chord * (cos(yaw) * cosine - sin(yaw) * sine)
        y += chord * (sin(yaw) * cosine + cos(yaw) * sine)
        yaw += 2 * half
    closed = arc(v * n * dt, w * n * dt)
    assert (x, y) == pytest.approx((closed.x, closed.y), abs=1e-8)
    assert yaw == pytest.approx(w * n * dt, abs=1e-9)


@settings(deadline=None)
@given(speeds, rates, st.integers(0, 500))
def test_without_commands_the_prediction_keeps_the_twist(v: float, w: float, milliseconds: int) -> None:
    start = Pose2(1.0, 2.0, 0.5)
    after = predicted_motion(Motion(start, v, w), LIMITS, [], 0, milliseconds * MS, 50 * MS)
    there = start @ arc(v * milliseconds / 1000, w * milliseconds / 1000)
    assert (after.v, after.w) == (v, w)
    assert (after.pose.x, after.pose.y) == pytest.approx((there.x, there.y), abs=1e-8)


def test_a_command_acts_when_the_delay_is_over_and_not_before() -> None:
    commands = [SentCommand(100 * MS, 0.8, 0.0)]
    before = predicted_motion(Motion(Pose2(), 0.0, 0.0), LIMITS, commands, 0, 150 * MS, 50 * MS)
    after = predicted_motion(Motion(Pose2(), 0.0, 0.0), LIMITS, commands, 0, 250 * MS, 50 * MS)
    assert before.v == 0.0
    assert after.v == pytest.approx(0.8 * 0.1)
    assert after.pose.x == pytest.approx(0.5 * 0.8 * 0.1**2, rel=0.25)


def test_the_newest_command_that_acts_replaces_the_older() -> None:
    commands = [SentCommand(0, 0.8, 0.0), SentCommand(100 * MS, 0.0, 1.0)]
    after = predicted_motion(Motion(Pose2(), 0.0, 0.0), LIMITS, commands, 0, 2_000 * MS, 0)
    assert (after.v, after.w) == (0.0, 1.0)


def test_the_configuration_lowers_the_drive_s_speeds_and_never_raises_them() -> None:
    drive = load_robot("x80sv").robot.drive
    assert limits_of(drive, 0.5, 0.1)[:2] == (-0.1, 0.5)
    assert limits_of(drive, 9.0, 9.0)[:2] == (-drive.max_reverse_speed, drive.max_speed)
