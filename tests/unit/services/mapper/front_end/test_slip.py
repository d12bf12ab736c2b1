# SPDX-License-Identifier: Apache-2.0
"""How far a robot can be from where odometry puts it, and how a motion is believed that odometry contradicts."""

from math import hypot

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from services.mapper.back_end.pose_graph import PoseGraph
from services.mapper.back_end.solver.optimize import PoseGraphConfig, optimize
from services.mapper.front_end.slip import SlipBound, widen_where_doubtful
from shared.geometry import Pose2

metres = st.floats(-3, 3)
offs = st.builds(Pose2, metres, metres, st.floats(-3, 3))
ways = st.floats(0, 5)


@given(offs, ways, ways, st.floats(1.01, 3))
def test_farther_off_is_more_surprising_and_more_motion_less(off, path, turn, more):
    assume(hypot(off.x, off.y) + abs(off.yaw) > 1e-3)
    surprise = SlipBound(path, turn).squared_ratio(off, 10.0, 10.0)
    assert SlipBound(path, turn).squared_ratio(Pose2(more * off.x, more * off.y, more * off.yaw), 10.0, 10.0) > surprise
    assert SlipBound(path + more, turn + more).squared_ratio(off, 10.0, 10.0) < surprise
    assert SlipBound(path, turn).squared_ratio(off, 0.0, 0.0) >= surprise


@given(offs, st.floats(0.01, 100), st.floats(0.01, 100), st.floats(0, 1))
def test_the_covariance_grows_by_what_no_slip_explains_and_where_few_beams_agree(off, along, turning, inlier_ratio):
    information = np.diag((along, 2 * along, turning))
    odometry = Pose2(0.3, 0.0, 0.0)
    believed = widen_where_doubtful(information, odometry @ off, off, inlier_ratio)
    d = np.array((off.x, off.y, off.yaw))
    if hypot(off.x, off.y) > 0.4 + 1e-9 or abs(off.yaw) > 0.4 + 1e-9 or inlier_ratio < 0.5:
        assert_allclose(np.linalg.inv(believed), np.linalg.inv(information) + np.outer(d, d), rtol=1e-6, atol=1e-6)
    else:
        assert_allclose(believed, information)


@pytest.mark.parametrize(
    ("odometry", "moved"),
    [
        (Pose2(0.3, 0.0, 0.0), Pose2()),  # both wheels slip
        (Pose2(0.3, 0.0, 0.0), Pose2(0.15, 0.0, 0.3)),  # one does
        (Pose2(2.7, 0.0, 1.0), Pose2(2.0, 0.5, 0.4)),  # scans that come seldom
    ],
)
def test_what_slip_explains_stays_as_sure_as_it_is(odometry, moved):
    information = np.eye(3) * 1e4
    assert widen_where_doubtful(information, moved, odometry.inverse() @ moved, 0.5) is information


@pytest.mark.parametrize(
    ("wrong", "inlier_ratio"),
    [
        (Pose2(1.3, 0.0, 0.0), 1.0),  # the scans saw ground that moved with the robot
        (Pose2(0.6, 0.0, 0.0), 0.25),  # most of a scan saw a new room, and the rest of it fitted at a wrong pose
    ],
)
def test_a_closure_puts_the_error_where_odometry_and_scans_disagreed(wrong, inlier_ratio):
    graph, sure = PoseGraph(), np.diag((1e4, 1e4, 1e5))
    true = [Pose2(0.3 * k, 0.0, 0.0) for k in range(11)]
    matched = [Pose2(0.3, 0.0, 0.0)] * 10
    matched[4] = wrong
    nodes = [graph.add_node(Pose2())]
    for step in matched:
        off, ratio = Pose2(0.3, 0.0, 0.0).inverse() @ step, inlier_ratio if step is wrong else 1.0
        nodes.append(graph.add_node(graph.pose(nodes[-1]) @ step))
        graph.add_edge(nodes[-2], nodes[-1], step, widen_where_doubtful(sure, step, off, ratio), loop=False)
    graph.add_edge(nodes[0], nodes[-1], true[-1], sure, loop=True)
    result = optimize(graph.snapshot(), PoseGraphConfig())
    assert_allclose(result.poses[:, 0], [pose.x for pose in true], atol=0.02)
