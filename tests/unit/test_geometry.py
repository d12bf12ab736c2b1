# SPDX-License-Identifier: Apache-2.0
"""Laws of planar rigid motion."""

from math import cos, pi, sin

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from shared.geometry import Pose2, arc, interpolated, wrapped, wrapped_all

coordinates = st.floats(-100, 100)
poses = st.builds(Pose2, coordinates, coordinates, st.floats(-10, 10))
points = st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=8).map(np.array)


def array(pose: Pose2) -> list[float]:
    return [pose.x, pose.y, cos(pose.yaw), sin(pose.yaw)]


@given(poses, poses, points)
def test_composing_is_applying_twice(a_from_b, b_from_c, in_c):
    assert_allclose((a_from_b @ b_from_c) @ in_c, a_from_b @ (b_from_c @ in_c), atol=1e-9)


@given(poses)
def test_a_pose_and_its_inverse_cancel(pose):
    assert_allclose(array(pose @ pose.inverse()), array(Pose2()), atol=1e-9)
    assert_allclose(array(pose.inverse() @ pose), array(Pose2()), atol=1e-9)


@given(poses, poses, poses)
def test_composition_is_associative(a, b, c):
    assert_allclose(array((a @ b) @ c), array(a @ (b @ c)), atol=1e-9)


@given(st.floats(-1e4, 1e4))
def test_wrapped_is_the_same_direction_within_half_a_turn(angle):
    assert -pi <= wrapped(angle) < pi
    assert_allclose([cos(wrapped(angle)), sin(wrapped(angle))], [cos(angle), sin(angle)], atol=1e-9)
    assert_allclose(wrapped_all(np.array([angle]))[0], wrapped(angle), atol=1e-12)


@given(st.floats(-5, 5), st.floats(-3, 3))
def test_half_an_arc_twice_is_the_arc(forward, turn):
    half = arc(forward / 2, turn / 2)
    assert_allclose(array(half @ half), array(arc(forward, turn)), atol=1e-9)


@given(st.floats(0.1, 5), st.floats(0.01, 3))
def test_an_arc_stays_on_its_circle(forward, turn):
    radius = forward / turn
    end = arc(forward, turn)
    assert_allclose(np.hypot(end.x, end.y - radius), radius, rtol=1e-9)


@given(poses, poses)
def test_interpolation_begins_and_ends_at_its_poses(a, b):
    assert_allclose(array(interpolated(a, b, 0.0)), array(a), atol=1e-9)
    assert_allclose(array(interpolated(a, b, 1.0)), array(b), atol=1e-9)
