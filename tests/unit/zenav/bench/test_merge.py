# SPDX-License-Identifier: Apache-2.0
"""`zenav bench merge`: its cases, its errors against the truth, and when a joint is wrong."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.sim.world_loader import load_world
from shared.geometry import Pose2
from zenav.bench.building_parts import rooms_of
from zenav.bench.merge import MAX_JOINT_M, MergeCase, MergeTrial, cases_of, common_share, fitted, summary

NEAR = MAX_JOINT_M / 2


def trial(first="building:1", second="building:1", **fields):
    return MergeTrial(first, second, 0.3, **fields)


def test_every_building_is_tried_with_itself_its_other_floor_and_the_next_buildings():
    cases = cases_of([1, 2, 3], [30, 50], 1)
    assert sum(case.same for case in cases) == 6
    assert MergeCase("building:2", "building:2/1", 0.3) in cases
    assert MergeCase("building:3", "building:1", 0.3) in cases
    assert len(cases) == len(set(cases)) == 12


@pytest.mark.parametrize(
    ("case", "wrong"),
    [
        (trial(joint_mean_m=NEAR), False),
        (trial(joint_mean_m=3 * NEAR), True),
        (trial(refused="too little in common"), False),
        (trial(second="building:2"), True),
        (trial(second="building:1/1"), True),
        (trial(second="building:2", refused="contradicted"), False),
    ],
)
def test_a_joint_of_strangers_or_at_a_wrong_place_is_wrong_and_a_refusal_is_not(case, wrong):
    assert case.wrongly_joined is wrong
    assert summary([case])["wrongly_joined"] == wrong


@given(st.builds(Pose2, st.floats(-50, 50), st.floats(-50, 50), st.floats(-3.1, 3.1)), st.integers(0, 2**32))
def test_a_rigid_fit_finds_the_motion_between_two_sets_of_poses(world_from_map, seed):
    poses = np.random.default_rng(seed).uniform(-9, 9, (5, 3))
    truth = np.column_stack((world_from_map @ poses[:, :2], poses[:, 2]))
    np.testing.assert_allclose(fitted(poses, truth) @ poses[:, :2], truth[:, :2], atol=1e-6)


def test_the_common_share_counts_keyframes_on_common_ground():
    first, second = np.array([[0, 0, 0], [5, 0, 0.0]]), np.array([[0.5, 0, 0], [9, 0, 0], [5, 0.9, 0], [5, 1.1, 0.0]])
    assert common_share(first, second) == 0.5


def test_two_parts_of_a_building_have_all_rooms_and_share_some():
    world = load_world("building:6")
    first, second = rooms_of(world, 0.0, 0.65), rooms_of(world, 0.35, 1.0)
    assert set(first) | set(second) == set(world.goals)
    assert set(first) & set(second)
    assert set(first) - set(second)


def test_another_floor_has_the_same_walls_and_other_furniture():
    ground, upper = load_world("building:6"), load_world("building:6/1")
    below, above = (
        {polygon.tobytes() for polygon in ground.polygons},
        {polygon.tobytes() for polygon in upper.polygons},
    )
    assert len(below & above) > 20
    assert len(below - above) > 10
    assert load_world("building:6/2").outline().tobytes() != upper.outline().tobytes()
