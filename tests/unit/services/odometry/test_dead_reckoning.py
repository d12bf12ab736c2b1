# SPDX-License-Identifier: Apache-2.0
from math import cos, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.odometry.dead_reckoning import INTEGRATIONS, document_step, exact_step, propagated_covariance
from shared.geometry import Pose2, wrapped

D = 0.283
rolls = st.floats(-1, 1)


def close(a: Pose2, b: Pose2, tolerance=1e-9):
    assert (a.x, a.y) == pytest.approx((b.x, b.y), abs=tolerance)
    assert wrapped(a.yaw - b.yaw) == pytest.approx(0, abs=tolerance)


def repeated(integrate, left, right, n):
    pose = Pose2()
    for _ in range(n):
        pose = pose @ integrate(left / n, right / n, D)[0]
    return pose


@given(rolls, rolls)
def test_exact_is_the_circle_s_closed_form(left, right):
    motion, _ = exact_step(left, right, D)
    turn = (right - left) / D
    if abs(turn) > 1e-3:
        radius = (left + right) / 2 / turn
        close(motion, Pose2(radius * sin(turn), radius * (1 - cos(turn)), wrapped(turn)), 1e-8)
    else:
        assert motion.x == pytest.approx((left + right) / 2, abs=1e-6)


def test_a_whole_circle_comes_back():
    motion, _ = exact_step(2 * pi * (1 - D / 2), 2 * pi * (1 + D / 2), D)
    close(motion, Pose2(0, 0, 0))


@given(rolls, rolls)
def test_exact_in_two_halves_is_exact_at_once(left, right):
    close(repeated(exact_step, left, right, 2), exact_step(left, right, D)[0])


@given(rolls, rolls)
def test_exact_there_and_back_is_nowhere(left, right):
    close(exact_step(left, right, D)[0] @ exact_step(-left, -right, D)[0], Pose2())


@settings(max_examples=20, deadline=None)
@given(rolls, rolls)
def test_the_document_s_way_converges_to_exact_for_small_steps(left, right):
    truth = exact_step(left, right, D)[0]
    coarse, fine = (repeated(document_step, left, right, n) for n in (500, 4000))
    assert fine.distance(truth) <= max(coarse.distance(truth) / 6, 1e-9)
    close(fine, truth, 4e-3)


def test_the_document_s_step():
    motion, _ = document_step(0.10, 0.14, D)
    close(motion, Pose2(0.12, 0.0, np.arctan2(0.04, D)))


@pytest.mark.parametrize("name", INTEGRATIONS)
@given(rolls, rolls)
def test_the_jacobian_is_the_difference_quotient(name, left, right):
    integrate, step = INTEGRATIONS[name], 1e-6
    _, jacobian = integrate(left, right, D)
    for column, (dl, dr) in enumerate(((step, 0.0), (0.0, step))):
        ahead, behind = integrate(left + dl, right + dr, D)[0], integrate(left - dl, right - dr, D)[0]
        quotient = (ahead.x - behind.x, ahead.y - behind.y, wrapped(ahead.yaw - behind.yaw))
        np.testing.assert_allclose(jacobian[:, column], np.array(quotient) / (2 * step), atol=1e-6)


@given(st.floats(-1, 1), st.floats(-1.9e-4, 1.9e-4))
def test_nearly_straight_on_the_jacobian_is_the_arc_s_series(forward, turn):
    """x = f (1 - t^2/6 ..), y = f (t/2 - t^3/24 ..): here a quotient of small differences would lose its digits."""
    left, right = forward - turn * D / 2, forward + turn * D / 2
    f, t = (left + right) / 2, (right - left) / D
    by_travel = np.array([1 - t**2 / 6, t / 2 - t**3 / 24, 0])
    by_turn = np.array([-f * t / 3, f * (1 / 2 - t**2 / 8), 1])
    expected = np.column_stack((by_travel / 2 - by_turn / D, by_travel / 2 + by_turn / D))
    np.testing.assert_allclose(exact_step(left, right, D)[1], expected, rtol=0, atol=1e-12)


@given(rolls, rolls, st.floats(-pi, pi))
def test_covariance_only_grows(left, right, heading):
    before = np.diag([0.01, 0.02, 0.001])
    motion, jacobian = exact_step(left, right, D)
    after = propagated_covariance(before, heading, motion, jacobian, (2e-5 * abs(left), 2e-5 * abs(right)))
    assert np.array_equal(after, after.T)
    assert after[2, 2] >= before[2, 2]
    assert np.linalg.det(after) >= np.linalg.det(before) * (1 - 1e-9)


@given(rolls, rolls, st.floats(-pi, pi))
def test_covariance_is_carried_by_the_motion_s_derivatives(left, right, heading):
    """J P J' with J the difference quotients of the pose after, by the pose before and by each wheel's travel."""
    start, variance, step = np.array([0.3, -0.2, heading]), 1e-2, 1e-6

    def after(values):
        end = Pose2(*values[:3]) @ exact_step(*values[3:], D)[0]
        return np.array([end.x, end.y, end.yaw])

    at = np.array([*start, left, right])
    quotients = np.empty((3, 5))
    for i, ahead in enumerate(step * np.eye(5)):
        x, y, yaw = after(at + ahead) - after(at - ahead)
        quotients[:, i] = np.array([x, y, wrapped(yaw)]) / (2 * step)
    before = np.zeros((5, 5))
    before[:3, :3] = [[0.04, 0.01, 0.02], [0.01, 0.09, -0.03], [0.02, -0.03, 0.05]]
    before[3, 3], before[4, 4] = variance * abs(left), variance * abs(right)
    covariance = propagated_covariance(
        before[:3, :3], heading, *exact_step(left, right, D), (before[3, 3], before[4, 4])
    )
    np.testing.assert_allclose(covariance, quotients @ before @ quotients.T, atol=1e-6)


def test_covariance_is_what_many_noisy_robots_show():
    rng, n_steps, n_robots, variance = np.random.default_rng(4), 20, 4000, 1e-3
    left, right = 0.05, 0.06
    pose, covariance = Pose2(), np.zeros((3, 3))
    for _ in range(n_steps):
        motion, jacobian = exact_step(left, right, D)
        covariance = propagated_covariance(covariance, pose.yaw, motion, jacobian, (variance * left, variance * right))
        pose = pose @ motion
    lefts = left + rng.normal(0, np.sqrt(variance * left), (n_robots, n_steps))
    rights = right + rng.normal(0, np.sqrt(variance * right), (n_robots, n_steps))
    ends = []
    for rolled in zip(lefts, rights):
        end = Pose2()
        for one_left, one_right in zip(*rolled):
            end = end @ exact_step(one_left, one_right, D)[0]
        ends.append((end.x - pose.x, end.y - pose.y, wrapped(end.yaw - pose.yaw)))
    np.testing.assert_allclose(covariance, np.cov(np.array(ends).T), rtol=0.15, atol=2e-4)


def test_covariance_does_not_depend_on_how_often_the_wheels_report():
    ends = []
    for n in (100, 2000):
        pose, covariance = Pose2(yaw=0.4), np.zeros((3, 3))
        for _ in range(n):
            motion, jacobian = exact_step(1.0 / n, 1.4 / n, D)
            covariance = propagated_covariance(covariance, pose.yaw, motion, jacobian, (2e-5 / n, 2.8e-5 / n))
            pose = pose @ motion
        ends.append(covariance)
    np.testing.assert_allclose(ends[0], ends[1], rtol=0.03, atol=1e-9)
