# SPDX-License-Identifier: Apache-2.0
from itertools import pairwise
from math import cos, exp, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from services.base_driver.kinematics import board_counts, count_difference
from services.sim.drive import (
    Battery,
    DriveTruth,
    arc_pose,
    battery_voltage,
    encoder_counts,
    next_slip,
    true_wheels,
    wheel_speed,
    wheel_targets,
)
from shared.geometry import Pose2, arc
from tests.unit.services.sim.scenes import PERFECT, START, X80SV, drive, simulator, told


@settings(deadline=None)
@given(st.floats(-20, 20), st.floats(-20, 20), st.sampled_from([-1, 1]))
def test_wheel_targets_invert_the_base_drivers_equations(left, right, direction):
    wired = X80SV.drive.model_copy(update={"motor_direction": direction})
    assert_allclose(wheel_targets(*board_counts(left, right, wired), wired), (left, right), atol=1e-9)


@settings(deadline=None)
@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(0.01, 1))
def test_a_wheel_nears_its_target_as_a_first_order_lag_does(speed, target, lag):
    stepped = speed
    for _ in range(40):
        stepped = wheel_speed(stepped, target, lag, 1e9, 0.005)
    assert_allclose(stepped, target + (speed - target) * exp(-0.2 / lag), atol=1e-9)


@settings(deadline=None)
@given(st.floats(-50, 50), st.floats(-50, 50), st.floats(0, 1), st.floats(1, 100))
def test_no_wheel_accelerates_over_its_limit_or_past_its_target(speed, target, lag, limit):
    after = wheel_speed(speed, target, lag, limit, 0.005)
    assert abs(after - speed) <= limit * 0.005 + 1e-12
    assert min(speed, target) - 1e-12 <= after <= max(speed, target) + 1e-12


@settings(deadline=None)
@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3), st.floats(-1, 1), st.floats(-3, 3))
def test_a_step_is_an_exact_arc(x, y, yaw, forward, turn):
    pose = Pose2(x, y, yaw) @ arc(forward, turn)
    assert_allclose(arc_pose(x, y, yaw, forward, turn)[:2], (pose.x, pose.y), atol=1e-9)


def test_slip_has_its_standard_deviation_and_stays_alike_for_its_time():
    wheels = true_wheels(X80SV.drive, DriveTruth(slip=0.03, slip_time=0.1), 0.005)
    slips = np.zeros(60_000)
    for k, draw in enumerate(np.random.default_rng(0).standard_normal(len(slips) - 1)):
        slips[k + 1] = next_slip(slips[k], draw, wheels)
    assert_allclose(slips.std(), 0.03, rtol=0.05)
    assert_allclose(np.corrcoef(slips[:-20], slips[20:])[0, 1], exp(-1), atol=0.05)


@settings(deadline=None)
@given(st.floats(-1e4, 1e4), st.floats(-0.5, 0.5), st.integers(0, 32767))
def test_encoders_count_whole_steps_and_return_to_0_at_the_wrap(angle, further, first):
    before, after = (encoder_counts(a, first, X80SV.drive) for a in (angle, angle + further))
    assert 0 <= before < 32768
    assert abs(count_difference(before, after, 32768) - further * 756 / (2 * pi)) <= 1 + 1e-6


@pytest.mark.parametrize(("v", "w"), [(0.5, 0.0), (0.4, 0.8), (0.0, 1.5), (-0.3, -0.5)])
def test_a_perfect_drive_follows_the_closed_form(v, w):
    service = simulator("empty", **PERFECT)
    truths = told(drive(service, 5.0, v, w), "sim/truth")
    start, last = truths[0], truths[-1]
    dt = (last.stamp - start.stamp) * 1e-9
    wanted = start.world_from_base @ arc(v * dt, w * dt)
    assert_allclose((last.world_from_base.x, last.world_from_base.y), (wanted.x, wanted.y), atol=1e-6)
    assert_allclose((cos(last.world_from_base.yaw), sin(last.world_from_base.yaw)), (cos(wanted.yaw), sin(wanted.yaw)))
    assert_allclose((last.v, last.w), (v, w), atol=1e-5)
    assert_allclose(last.distance - start.distance, abs(v) * dt, rtol=1e-4)


@pytest.mark.parametrize(("v", "w"), [(0.6, 0.0), (0.3, -1.0)])
def test_the_left_encoder_counts_down_forward_and_both_tell_the_wheels_way(v, w):
    service = simulator("empty", **PERFECT)
    reports = told(drive(service, 40.0, v, w), "hardware/board")
    turned = [0, 0]
    for before, after in pairwise(reports):
        turned[0] += count_difference(before.left_counts, after.left_counts, 32768)
        turned[1] += count_difference(before.right_counts, after.right_counts, 32768)
    dt = (reports[-1].stamp - reports[0].stamp) * 1e-9
    wheel = 756 / (2 * pi * 0.085)
    assert_allclose(turned, (-(v - w * 0.1415) * wheel * dt, (v + w * 0.1415) * wheel * dt), atol=1.5)
    assert_allclose((reports[-1].left_speed, reports[-1].right_speed), np.array(turned) / dt, atol=0.6)


def test_systematic_errors_bend_the_way_as_their_definition_says():
    errors = {"radius_error": 0.01, "distance_error": 0.02, "slip": 0.0, "motor_lag": 0.0, "wheel_acceleration": 50}
    straight = told(drive(simulator("empty", drive=errors), 5.0, 0.5, 0.0), "sim/truth")[-1]
    assert_allclose(straight.v, 0.5, rtol=1e-6)
    assert_allclose(straight.w, 0.5 * 0.01 / (0.283 * 1.02), rtol=1e-6)
    turning = told(drive(simulator("empty", drive=errors), 5.0, 0.0, 1.0), "sim/truth")[-1]
    assert_allclose(turning.w, 1 / 1.02, rtol=1e-6)


@pytest.mark.parametrize("forward", [True, False])
def test_skid_steering_turns_farther_in_a_curve_than_its_distance_on_the_spot_says(forward):
    errors = {"turn_slip": 0.4728, "distance_error": 0.0, "radius_error": 0.0, "slip": 0.0, "motor_lag": 0.0}
    sign = 1 if forward else -1
    turned = []
    for v, w in ((0.0, 1.0), (0.1415 * 4, 1.0), (0.5, 0.1)):  # about itself; a curve of 4 half distances; a wide one
        simulated = simulator("empty", drive=errors | {"wheel_acceleration": 50})
        turned.append(told(drive(simulated, 5.0, sign * v, w), "sim/truth")[-1].w / w)
    assert_allclose(turned[0], 1.0, rtol=1e-6)
    assert_allclose(turned[1], 1.4728 / (1 + 0.4728 / (1 + 0.0538 * 2)), rtol=1e-4)
    assert 1.0 < turned[1] < turned[2] < 1.4728


def test_without_skid_steering_the_distance_is_the_same_in_every_curve():
    errors = {"turn_slip": 0.0, "distance_error": 0.0, "radius_error": 0.0, "slip": 0.0, "motor_lag": 0.0}
    for v, w in ((0.0, 1.0), (0.5, 0.5)):
        simulated = simulator("empty", drive=errors | {"wheel_acceleration": 50})
        assert_allclose(told(drive(simulated, 5.0, v, w), "sim/truth")[-1].w, w, rtol=1e-6)


def test_a_command_stands_for_ever_or_for_its_life():
    for life, moves in ((None, True), (0.25, False)):
        service = simulator("empty", drive={"command_life": life})
        list(drive(service, 0.1, 0.5, 0.0))
        speeds = []
        for _ in range(100):
            service.now += 20_000_000
            speeds += told(list(service.tick()), "sim/truth")
        assert (abs(speeds[-1].v) > 0.4) == moves
        assert abs(next(t for t in speeds if t.stamp >= START + 320_000_000).v) > 0.1


def test_the_battery_falls_with_use_and_with_load():
    battery = Battery()
    assert battery_voltage(battery, 0.0, 0.0) == battery.full
    assert battery_voltage(battery, 1.0, 1.0) > battery_voltage(battery, 1.1, 1.0) > battery_voltage(battery, 1.1, 5.0)
    assert battery_voltage(battery, 1e6, 0.0) == battery.empty
    reports = told(drive(simulator("empty"), 20.0, 0.5, 0.0), "hardware/board")
    assert reports[100].battery > reports[-1].battery > 12.5
    assert reports[5].currents.min() > reports[-1].currents.max() > 0.0
