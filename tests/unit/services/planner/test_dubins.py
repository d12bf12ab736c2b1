# SPDX-License-Identifier: Apache-2.0
from math import cos, hypot, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.planner.dubins import N_WORDS, dubins_word, pose_after

coordinates, angles = st.floats(-8, 8), st.floats(-pi, pi)
poses = st.tuples(coordinates, coordinates, angles).map(np.array)


def ways(start, end, radius, any_heading=False):
    """(length, end pose) of each way."""
    for i in range(N_WORDS):
        pieces = np.zeros((3, 2))
        if dubins_word(i, start, end, radius, any_heading, pieces):
            pose = start.copy()
            for curvature, length in pieces:
                pose_after(pose.copy(), curvature, length, pose)
            assert (pieces[:, 1] >= 0).all()
            assert (np.abs(pieces[:, 0]) <= 1 / radius + 1e-12).all()
            yield pieces[:, 1].sum(), pose


@settings(deadline=None)
@given(poses, poses, st.sampled_from([0.3, 1.0, 2.5]))
def test_every_way_ends_in_the_pose_and_one_is_as_short_as_the_distance_allows(start, end, radius):
    found = list(ways(start, end, radius))
    assert found
    for length, pose in found:
        assert pose[:2] == pytest.approx(end[:2], abs=1e-6)
        assert (cos(pose[2]), sin(pose[2])) == pytest.approx((cos(end[2]), sin(end[2])), abs=1e-6)
        assert length >= hypot(*(end - start)[:2]) - 1e-6
    shortest = min(length for length, _ in found)
    assert shortest <= hypot(*(end - start)[:2]) + 7 * pi * radius


@settings(deadline=None)
@given(poses, poses)
def test_there_is_as_long_as_back_with_the_headings_turned_round(start, end):
    turned = [np.add(pose, (0, 0, pi)) for pose in (end, start)]
    there, back = (min(length for length, _ in ways(*ends, 1.0)) for ends in ((start, end), turned))
    assert there == pytest.approx(back, abs=1e-5) or abs(there - back) > pi  # at a jump either side is right


@settings(deadline=None)
@given(poses, poses)
def test_where_the_heading_does_not_matter_no_way_is_longer_than_with_any_heading(start, end):
    free = [(length, pose) for length, pose in ways(start, end, 1.0, any_heading=True)]
    for _, pose in free:
        assert pose[:2] == pytest.approx(end[:2], abs=1e-6)
    if free:
        headings = np.linspace(-pi, pi, 24, endpoint=False)
        best = min(length for yaw in headings for length, _ in ways(start, np.array([*end[:2], yaw]), 1.0))
        assert min(length for length, _ in free) <= best + 1e-6 or hypot(*(end - start)[:2]) < 4
