# SPDX-License-Identifier: Apache-2.0
"""Where scans stop fitting, the map continues in a new part. Several closures that agree join it to the rest."""

from dataclasses import replace
from math import pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.mapper.back_end.map_parts import (
    MAX_SAME_PLACE_M,
    MAX_SAME_PLACE_RAD,
    MIN_JOINTS,
    OdometryGap,
    gap_information,
    is_joint,
    joined_nodes,
    largest_consistent_group,
)
from services.mapper.back_end.pose_graph import PoseGraph
from shared.geometry import Pose2, wrapped
from shared.messages import Localization
from tests.unit.services.mapper.hardships import DARK, broken, course, longest_wrong
from tests.unit.services.mapper.rooms import LAP, RING, START, RoomDrive, laps

places = st.builds(Pose2, st.floats(-2, 2), st.floats(-2, 2), st.floats(-pi, pi))


@given(st.lists(places, max_size=8))
def test_closures_that_agree_are_near_one_of_them_and_no_group_is_larger(poses):
    found = largest_consistent_group(poses)
    near = [
        [a.distance(b) <= MAX_SAME_PLACE_M and abs(wrapped(a.yaw - b.yaw)) <= MAX_SAME_PLACE_RAD for b in poses]
        for a in poses
    ]
    sizes = [sum(row) for row in near]
    assert len(found) == max(sizes, default=0)
    assert not poses or any(sorted(found) == [k for k, is_near in enumerate(row) if is_near] for row in near)


@given(st.integers(0, 20), st.integers(0, 20), st.booleans())
def test_a_joint_needs_several_closures_a_majority_and_more_of_them_far_from_odometry(n, others, expected):
    if is_joint(n, others, expected):
        assert n >= MIN_JOINTS
        assert n > others
        assert is_joint(n + 1, others, expected)
        assert is_joint(n, others, True)


@given(st.floats(0, 50), st.floats(0, 50), st.floats(0.1, 10), st.floats(0.1, 10))
def test_the_longer_the_way_without_scans_the_less_odometry_tells(path, turn, further, more):
    here, there = gap_information(path, turn), gap_information(path + further, turn + more)
    assert (np.diag(there) < np.diag(here)).all()


def test_a_gap_joins_nothing_and_a_closure_that_is_believed_does():
    graph = PoseGraph()
    nodes = [graph.add_node(Pose2(k, 0, 0)) for k in range(4)]
    step = Pose2(1, 0, 0)
    graph.add_edge(nodes[0], nodes[1], step, np.eye(3), loop=False)
    graph.add_edge(nodes[1], nodes[2], step, np.eye(3), loop=True)
    graph.add_edge(nodes[2], nodes[3], step, np.eye(3), loop=False)
    gaps = frozenset({(nodes[1], nodes[2])})
    assert joined_nodes(graph.snapshot(), gaps).tolist() == [True, True, False, False]
    assert joined_nodes(graph.snapshot(), frozenset()).all()
    graph.add_edge(nodes[0], nodes[3], Pose2(3, 0, 0), np.eye(3), loop=True)
    assert joined_nodes(graph.snapshot(), gaps).all()


def round_the_ring(n: int = 2 * LAP) -> RoomDrive:
    driven = RoomDrive(RING, noise=0.01)
    driven.true = START
    for motion, _ in zip(laps(), range(n)):
        driven.step(motion)
    return driven


def test_an_optimum_that_comes_before_the_first_keyframe_of_a_part_moves_the_part_too():
    driven = round_the_ring()
    back_end = driven.mapper.back_end
    before = back_end.map_from_local
    order = back_end.optimization_arguments()
    back_end.begin_part(OdometryGap(Pose2(0.5, 0, 0), 0.5, 0.0))
    from services.mapper.back_end.solver.optimize import optimize

    back_end.apply(optimize(*order))
    assert back_end.n_in_part == 0
    assert back_end.map_from_local.distance(before) < 0.2


def test_a_part_that_closures_join_lies_where_it_belongs_and_keeps_all_keyframes():
    driven = round_the_ring()
    mapper = driven.mapper
    n = len(mapper.back_end.keyframes)
    front_end = mapper.front_end
    motion = mapper.back_end.keyframes[-1].local_from_base.inverse() @ front_end.local_from_base
    wrong = motion @ Pose2(0.7, -0.4, 0.1)  # odometry was off while no scan fitted
    mapper.back_end.begin_part(OdometryGap(wrong, 1.0, 1.0))
    front_end.start(mapper.back_end.keyframes[-1].local_from_base @ wrong)
    states = []
    for step, _ in zip(laps(), range(LAP)):
        driven.step(step)
        states.append(driven.poses[-1].state)
    assert mapper.back_end.is_joined
    assert mapper.back_end.n_joints == 1
    assert driven.error.distance(Pose2()) < 0.1
    assert Localization.GOOD not in states[:3], "nothing is sure before it is joined"
    assert states[-1] is Localization.GOOD
    assert len(mapper.back_end.keyframes) >= n - 5, "nothing is discarded"


def test_what_an_unjoined_part_sees_changes_nothing_that_was_mapped():
    driven = round_the_ring()
    driven.publish_map()
    mapper = driven.mapper
    before = mapper.slam.grid.all_tiles(0)
    known = dict(zip(zip(before.rows.tolist(), before.columns.tolist()), before.cells))
    mapper.back_end.begin_part(OdometryGap(Pose2(1.5, 0.8, 0.6), 1.0, 1.0))
    mapper.front_end.start(mapper.front_end.local_from_base @ Pose2(1.5, 0.8, 0.6))
    none_closes = {"min_inlier_ratio": 2.0}
    mapper.back_end.closure_config = mapper.back_end.closure_config.model_copy(update=none_closes)
    mapper.slam.localizer.config = mapper.slam.localizer.config.model_copy(update=none_closes)
    for step, _ in zip(laps(), range(40)):
        driven.step(step)
        driven.publish_map()
    assert not mapper.back_end.is_joined
    after = mapper.slam.grid.all_tiles(0)
    turned = 0
    for row, column, cells in zip(after.rows.tolist(), after.columns.tolist(), after.cells):
        was = known.get((row, column))
        if was is not None:
            turned += int(((was >= 65) & (cells >= 0) & (cells < 35)).sum())
    walls = sum(int((cells >= 65).sum()) for cells in known.values())
    assert turned < 0.01 * walls


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("name", ["laser off for 10 s", "odometry that jumps 0.8 m"])
def test_a_pose_that_a_gap_or_a_jump_made_wrong_is_not_good_and_ends_right(name, seed):
    row = broken(seed)[name]
    driven = course(row)
    assert longest_wrong(driven, row.laser.rate) <= 1.0
    assert driven.away[-1] < 0.1


@pytest.mark.parametrize("name", ["wheels that slip on a ramp", "200 m of corridor that repeats"])
def test_what_slip_bent_is_straight_again_after_the_way_back(name):
    assert course(broken(0)[name]).away[-1] < 0.1


@pytest.mark.parametrize("seed", [0, 1])
def test_who_sees_little_is_seldom_sure_and_not_when_wrong(seed):
    row = broken(seed)["60 degrees of view, 2 m"]
    assert longest_wrong(course(row), row.laser.rate) <= 1.0


def test_a_laser_that_is_off_while_the_robot_drives_costs_no_sureness_afterwards():
    driven = course(replace(broken(0)["laser off for 10 s"]))
    assert driven.good[-20:].all()
    assert driven.away[DARK.start + 60 :].max() < 0.3
