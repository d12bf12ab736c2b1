# SPDX-License-Identifier: Apache-2.0
from math import pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from services.mapper.front_end.deskew import deskew, redeskew
from shared.config import Mount
from shared.geometry import Pose2, interpolated
from shared.messages import LaserScan

angles = st.floats(-3, 3)
small = st.floats(-0.5, 0.5)


def scan_of(ranges, angle_min=-1.0, increment=0.02, scan_time=0.2):
    return LaserScan(0, angle_min, increment, scan_time, 0.1, 20.0, np.array(ranges, np.float32))


@given(small, small, angles, st.floats(-1, 1), st.floats(-1, 1), st.floats(-2, 2), st.booleans())
def test_a_beam_lands_where_the_moving_laser_saw_it(x, y, yaw, dx, dy, turn, clockwise):
    """The chain by hand, beam by beam: end_from_base(t) @ base_from_laser @ the point on the beam."""
    n, mount = 30, Mount(x=x, y=y, yaw=yaw)
    increment = -0.05 if clockwise else 0.05
    ranges = np.linspace(1, 5, n, dtype=np.float32)
    times, poses = np.array((-0.2, 0.0)), np.array(((-dx, -dy, -turn), (0.0, 0.0, 0.0)))
    origins, ends = deskew(scan_of(ranges, -1.0, increment), mount, times, poses)
    for i in range(n):
        back = 1 - i / (n - 1)
        laser = Pose2(-dx * back, -dy * back, -turn * back) @ Pose2(x, y, yaw)
        beam = -1.0 + i * increment
        point = ranges[i] * np.array([[np.cos(beam), np.sin(beam)]])
        assert_allclose(origins[i], (laser.x, laser.y), atol=1e-9)
        assert_allclose(ends[i], (laser @ point.astype(float))[0], atol=1e-6)


def test_a_robot_at_rest_sees_the_plain_polar_picture():
    ranges = np.full(360, 2.0)
    _, ends = deskew(scan_of(ranges, 0.0, 2 * pi / 360), Mount(), np.array((-0.2, -0.1, 0.0)), np.zeros((3, 3)))
    assert_allclose(np.hypot(*ends.T), 2.0)
    assert_allclose(ends[90], (0, 2), atol=1e-12)


@pytest.mark.parametrize("r", [np.nan, 0.0, 0.05, 20.0, 25.0])
def test_what_is_no_measurement_has_no_end(r):
    _, ends = deskew(scan_of([1.0, r, 2.0]), Mount(), np.array((-0.2, 0.0)), np.zeros((2, 3)))
    assert np.isnan(ends[1]).all()
    assert not np.isnan(ends[[0, 2]]).any()


def test_a_sweep_de_skewed_with_a_wrong_motion_is_corrected_by_the_right_one():
    scan = LaserScan(0, -3.0, 0.02, 0.1, 0.05, 8.0, np.linspace(1, 3, 300).astype(np.float32))
    assumed, true, share = Pose2(0.3, 0.0, 0.2), Pose2(0.1, 0.02, -0.1), 0.5

    def deskewed_with(motion):
        back = [interpolated(Pose2(), motion.inverse(), share * k / 20) for k in range(20, -1, -1)]
        poses = np.array([(p.x, p.y, p.yaw) for p in back])
        return deskew(scan, Mount(x=0.1, y=0.0, yaw=0.2), np.linspace(-0.1, 0, 21), poses)

    remaining = share * np.linspace(1, 0, 300)
    for bent, straight in zip(deskewed_with(assumed), deskewed_with(true)):
        assert_allclose(redeskew(bent, assumed, true, remaining), straight, atol=1e-9)
