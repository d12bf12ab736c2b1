# SPDX-License-Identifier: Apache-2.0
"""A robot with half a circle of view comes back the other way and sees the other sides of things: its loop closes."""

from math import hypot, pi

import numpy as np
from hypothesis import assume, given
from hypothesis import strategies as st

from services.mapper.back_end.doubtful_closures import (
    MAX_PATH_M,
    MAX_SURE_OFFSET_M,
    MIN_AGREEING_PATH_M,
    MIN_DRIFT_M,
    DoubtfulClosures,
)
from services.mapper.back_end.loop_closure import Constraint
from services.mapper.back_end.map_parts import MIN_JOINTS
from services.mapper.back_end.pose_graph import PoseGraph, pose_of
from shared.geometry import Pose2
from tests.unit.services.mapper.back_end.test_loop_closure import SURE, DriftingRobot
from tests.unit.services.mapper.rooms import STEP, TURN, box

N_OUT = 60  # steps out, and back
OUT_AND_BACK = [*[Pose2(STEP, 0, 0)] * N_OUT, *[Pose2(0, 0, TURN)] * round(pi / TURN), *[Pose2(STEP, 0, 0)] * N_OUT]
DRIFT = Pose2(0.002, 0.004, 0.001)  # m, m, rad with every keyframe: over a metre after the way back


def field():
    """Thin slabs beside a path along x: 1 m across it, so that most of what is seen is a front or a back."""
    rng = np.random.default_rng(3)
    slabs = [
        box(x, side * y, x + rng.uniform(0.1, 0.3), side * (y + rng.uniform(0.7, 1.3)))
        for x in np.arange(1.0, N_OUT * STEP + 6, 1.5) + rng.uniform(-0.4, 0.4)
        for side, y in ((-1, rng.uniform(0.9, 1.8)), (1, rng.uniform(0.9, 1.8)))
    ]
    return np.array([wall for slab in slabs for wall in slab])


class RobotWithHalfAView(DriftingRobot):
    """Its laser sees what is ahead."""

    def sweep(self):
        origins, ends = super().sweep()
        ends[ends[:, 0] < 0] = np.nan
        return origins, ends


def test_the_way_back_closes_on_the_way_out_though_other_sides_are_seen():
    robot = RobotWithHalfAView(drift=DRIFT, segments=field())
    robot.true = Pose2()
    robot.drives(OUT_AND_BACK)
    way, poses = list(robot.true_at.values()), robot.back_end.graph.poses
    errors = []
    for row in range(N_OUT + 26, len(way)):
        out = min(range(N_OUT), key=lambda k: way[k].distance(way[row]))
        true, found = way[out].inverse() @ way[row], pose_of(poses[out]).inverse() @ pose_of(poses[row])
        errors.append(found.distance(true))
    assert max(errors) < 0.2


N_NODES = 60
SPACING_M = 0.5
OFFSETS = Pose2(0.4, 0.0, 0.0), Pose2(0.0, -0.5, 0.0), Pose2(0.0, 0.0, 0.3)
"""Where closures put the robot; no two of them are one place."""


def path_of_nodes() -> tuple[PoseGraph, list[float]]:
    graph = PoseGraph()
    for k in range(N_NODES):
        node = graph.add_node(Pose2(SPACING_M * k, 0, 0))
        if k:
            graph.add_edge(node - 1, node, Pose2(SPACING_M, 0, 0), SURE, loop=False)
    return graph, [SPACING_M * k for k in range(N_NODES)]


def closure(graph: PoseGraph, j: int, offset: Pose2, is_partial: bool) -> Constraint:
    """A closure of node j to node 0 by which the robot, at the newest node, is off by a motion."""
    newest = graph.pose(N_NODES - 1)
    j_from_newest = graph.pose(j).inverse() @ newest
    return Constraint(0, j, graph.pose(0).inverse() @ newest @ offset @ j_from_newest.inverse(), SURE, is_partial)


closures_in_turn = st.lists(
    st.tuples(st.integers(1, 5), st.sampled_from(OFFSETS), st.booleans()), min_size=1, max_size=25
)


@given(closures_in_turn)
def test_a_partial_closure_counts_once_and_only_where_others_agree_over_some_metres(steps):
    graph, driven = path_of_nodes()
    closures, added, returned, j = DoubtfulClosures(), [], [], 10
    for step, offset, is_partial in steps:
        j = min(j + step, N_NODES - 1)
        new = closure(graph, j, offset, is_partial)
        added.append((new, offset))
        counted = closures.add([new], (), graph, driven[: j + 1])
        moves_far = (graph.pose(0) @ new.i_from_j).distance(graph.pose(j)) > MAX_SURE_OFFSET_M
        assert is_partial or moves_far or any(c is new for c in counted)
        returned += counted
        for one in counted:
            own = next(o for c, o in added if c is one)
            recent = [(c.j, o) for c, o in added if SPACING_M * (j - c.j) <= MAX_PATH_M]
            agreeing = {node for node, o in recent if o is own}
            n_others = sum(o is not own for _, o in recent)
            is_confirmed = len(agreeing) >= MIN_JOINTS and n_others <= sum(o is own for _, o in recent) / 2
            is_long = SPACING_M * (max(agreeing) - min(agreeing)) >= MIN_AGREEING_PATH_M
            assert (one is new and not is_partial and not moves_far) or (is_confirmed and is_long)
    assert len({id(c) for c in returned}) == len(returned)


@given(st.integers(2, 6), st.sampled_from(OFFSETS))
def test_doubtful_closures_that_agree_count_all(step, offset):
    graph, driven = path_of_nodes()
    closures, n_counted, nodes = DoubtfulClosures(), 0, range(20, 41, step)
    for j in nodes:
        counted = closures.add([closure(graph, j, offset, True)], (), graph, driven[: j + 1])
        n_counted += len(counted)
        path = SPACING_M * (j - nodes[0])
        if path >= MIN_AGREEING_PATH_M and (j - nodes[0]) // step + 1 >= MIN_JOINTS:
            assert n_counted == (j - nodes[0]) // step + 1
        else:
            assert n_counted == 0


@given(st.floats(-4.0, 4.0), st.floats(-4.0, 4.0), st.booleans())
def test_a_closure_that_moves_the_robot_far_waits_for_others_over_a_path_that_is_long_for_it(x, y, is_partial):
    graph, driven = path_of_nodes()
    closures, n_counted, offset = DoubtfulClosures(), 0, hypot(x, y)
    assume(offset > MIN_DRIFT_M + 1e-6)
    waits = is_partial or offset > MAX_SURE_OFFSET_M
    min_path = MIN_AGREEING_PATH_M + offset * (offset > MAX_SURE_OFFSET_M)
    for n in range(1, 24):
        n_counted += len(
            closures.add([closure(graph, 20 + n, Pose2(x, y, 0.0), is_partial)], (), graph, driven[: 21 + n])
        )
        assert n_counted == (n if not waits or SPACING_M * (n - 1) >= min_path else 0)


def test_a_closure_that_far_ones_confirmed_counts_at_once():
    graph, driven = path_of_nodes()
    far = [closure(graph, 30, Pose2(9.0, 0.0, 0.0), False)]
    assert DoubtfulClosures().add([], far, graph, driven[:31]) == far
    assert not DoubtfulClosures().add(far, [], graph, driven[:31])


def test_a_closure_that_waited_counts_once_the_graph_moves_to_it():
    graph, driven = path_of_nodes()
    closures, new = DoubtfulClosures(), closure(graph, 30, Pose2(3.0, 0.0, 0.0), False)
    assert not closures.add([new], (), graph, driven[:31])
    graph.move_nodes(20, Pose2(2.9, 0.0, 0.0))
    assert [one is new for one in closures.add([], (), graph, driven[:32])] == [True]
    assert not closures.add([], (), graph, driven[:33])


def test_a_sure_closure_confirms_partial_ones_and_old_ones_confirm_nothing():
    graph, driven = path_of_nodes()
    closures, off = DoubtfulClosures(), OFFSETS[0]
    assert closures.add([closure(graph, 20, off, False)], (), graph, driven[:21])
    assert not closures.add([closure(graph, 24, off, True)], (), graph, driven[:25])
    assert len(closures.add([closure(graph, 28, off, True)], (), graph, driven[:29])) == 2
    assert len(closures.add([closure(graph, 30, off, True)], (), graph, driven[:31])) == 1
    assert not closures.add([closure(graph, 59, off, True)], (), graph, driven)


def test_where_enough_sure_closures_agree_partial_ones_are_not_needed():
    graph, driven = path_of_nodes()
    closures, off = DoubtfulClosures(), OFFSETS[0]
    for j in range(20, 30, 2):
        new = [closure(graph, j, off, False), closure(graph, j + 1, off, True)]
        assert len(closures.add(new, (), graph, driven[: j + 2])) == 1


def test_doubtful_closures_that_show_no_drift_do_not_count():
    graph, driven = path_of_nodes()
    closures = DoubtfulClosures()
    for j in range(20, 50, 2):
        assert not closures.add([closure(graph, j, Pose2(0.15, 0.0, 0.03), True)], (), graph, driven[: j + 1])
