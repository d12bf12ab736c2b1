# SPDX-License-Identifier: Apache-2.0
"""Beams that see the robot itself are left out, by angle and by place."""

from math import pi

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from services.lidar_driver.self_mask import masked_angles, on_robot
from shared.config import Mount

SQUARE = np.array([(0.2, -0.2), (0.2, 0.2), (-0.2, 0.2), (-0.2, -0.2)])
angles = st.floats(-2 * pi, 2 * pi)


@given(angle=angles, begin=angles, width=st.floats(0.01, 6.0))
def test_a_mask_holds_the_angles_from_its_first_counter_clockwise_to_its_second(angle, begin, width):
    end = begin + width
    ahead = (angle - begin) % (2 * pi)
    if min(abs(ahead - width), ahead, 2 * pi - ahead) > 1e-6:
        assert masked_angles(np.array([angle]), ((begin, end),))[0] == (ahead < width)


def test_a_mask_across_the_back_holds_both_sides_of_it():
    at = np.radians([170, 180, -170, 160, -160])
    masks = ((np.radians(165), np.radians(-165)),)
    assert masked_angles(at, masks).tolist() == [True, True, True, False, False]


@given(
    x=st.floats(-0.6, 0.6),
    y=st.floats(-0.6, 0.6),
    yaw=st.floats(-pi, pi),
    angle=angles,
    reach=st.floats(0.02, 3),
    margin=st.floats(0, 0.1),
)
def test_a_beam_sees_the_robot_where_it_ends_in_the_footprint(x, y, yaw, angle, reach, margin):
    end = np.array([x + reach * np.cos(yaw + angle), y + reach * np.sin(yaw + angle)])
    beyond = np.maximum(np.abs(end) - 0.2, 0)
    distance = float(np.hypot(*beyond))  # of a point to a square; 0 inside
    if abs(distance - margin) > 1e-5 and np.min(np.abs(np.abs(end) - 0.2)) > 1e-5:
        seen = on_robot(np.array([reach], np.float32), np.array([angle]), Mount(x=x, y=y, yaw=yaw), SQUARE, margin)
        assert seen[0] == (distance == 0 or distance < margin)


def test_a_beam_without_echo_sees_nothing():
    assert not on_robot(np.array([np.nan], np.float32), np.zeros(1), Mount(), SQUARE, 0.1).any()
