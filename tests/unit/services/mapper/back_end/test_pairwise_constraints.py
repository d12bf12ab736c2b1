# SPDX-License-Identifier: Apache-2.0
"""Keyframes matched one by one with others that saw the same walls."""

from math import hypot

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from services.mapper.back_end.keyframe import Keyframe, Sweep
from services.mapper.back_end.map_parts import MIN_GAP_SIGMA_M
from services.mapper.back_end.pairwise_constraints import PairwiseConfig, find_pairwise_constraints
from services.mapper.back_end.pose_graph import PoseGraph
from services.mapper.front_end.registration import RegistrationConfig
from services.mapper.front_end.surface_normals import sweep_normals, usable_beams
from shared.geometry import Pose2, wrapped
from tests.unit.services.mapper.rooms import ROOM, box, sweep

FIRST = Pose2(-0.5, 0.5, 0.2)
ELSEWHERE = np.array([*box(20, 20, 23, 22), *box(20.5, 20.2, 21.0, 20.6)])


def keyframe(place, segments=ROOM, seed=0):
    origins, ends = sweep(segments, place, noise=0.01, seed=seed)
    normals = sweep_normals(origins, ends)
    found = Sweep(origins, ends, normals, np.zeros(len(ends))).only(usable_beams(origins, ends) | normals.any(axis=1))
    return Keyframe.of(seed, place, origins, ends, found.points, found.normals, ends[:0])


def tied(places, believed, segments=None, sigma=0.01, **config):
    """The ties of the last keyframe to all others, in a graph that believes them to be elsewhere."""
    segments = segments or [ROOM] * len(places)
    graph = PoseGraph()
    for pose in believed:
        graph.add_node(pose)
    keyframes = [keyframe(place, seen, seed) for seed, (place, seen) in enumerate(zip(places, segments))]
    covariances = np.tile(np.diag((sigma**2, sigma**2, 1e-6)), (len(places), 1, 1))
    settings_ = PairwiseConfig(partner_stride=1, **config)
    snapshot = graph.snapshot()
    return list(
        find_pairwise_constraints(snapshot, covariances, keyframes, len(places) - 2, RegistrationConfig(), settings_)
    )


offsets = st.tuples(st.floats(-0.06, 0.06), st.floats(-0.06, 0.06), st.floats(-0.03, 0.03))


@settings(deadline=None, max_examples=25)
@given(there=st.tuples(st.floats(-1.0, 1.0), st.floats(-0.8, 1.5), st.floats(-3.1, 3.1)), off=offsets)
def test_a_tie_is_the_way_between_two_places_wherever_the_graph_believed_them_to_be(there, off):
    second = FIRST @ Pose2(*there) if hypot(there[0], there[1]) < 1.2 else Pose2(0.5, 1.0, there[2])
    (tie,) = tied([FIRST, second], [FIRST, second @ Pose2(*off)])
    assert (tie.i, tie.j) == (0, 1)
    rest = (FIRST.inverse() @ second).inverse() @ tie.i_from_j
    assert hypot(rest.x, rest.y) < 0.01
    assert abs(wrapped(rest.yaw)) < 0.006
    assert np.linalg.eigvalsh(tie.information).min() > 1


def test_who_saw_nothing_of_the_same_is_not_tied():
    assert tied([FIRST, Pose2(21.0, 21.0, 0.2)], [FIRST, FIRST], [ROOM, ELSEWHERE]) == []


def test_a_match_far_from_where_the_graph_believes_it_is_left_to_the_loops():
    near, far = Pose2(0.05, 0.0, 0.0), Pose2(0.6, 0.0, 0.0)
    second = Pose2(0.5, 0.8, 0.4)
    assert len(tied([FIRST, second], [FIRST, second @ near])) == 1
    for tie in tied([FIRST, second], [FIRST, second @ far]):
        rest = (FIRST.inverse() @ second @ far).inverse() @ tie.i_from_j
        assert hypot(rest.x, rest.y) < PairwiseConfig().max_correspondence


def test_only_what_is_surely_near_is_tied_and_not_more_than_wanted():
    places = [Pose2(0.2 * k - 1.0, 0.5, 0.1 * k) for k in range(9)]
    ties = tied(places, places, n_partners=3)
    assert len(ties) == 3
    assert len({tie.i for tie in ties}) == 3
    assert {tie.j for tie in ties} == {8}
    assert len(tied(places, places, sigma=0.2)) == 4
    assert tied(places, places, sigma=MIN_GAP_SIGMA_M) == []
    assert all(places[tie.i].distance(places[8]) < 0.7 for tie in tied(places, places, max_distance=0.7))


def test_the_same_keyframes_draw_the_same_lots():
    places = [Pose2(0.2 * k - 1.0, 0.5, 0.1 * k) for k in range(9)]
    first, second = tied(places, places), tied(places, places)
    assert [tie.i for tie in first] == [tie.i for tie in second]
    assert all((a.information == b.information).all() for a, b in zip(first, second))
