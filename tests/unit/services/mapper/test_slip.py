# SPDX-License-Identifier: Apache-2.0
"""How far a robot can be from where odometry puts it, and how a motion is believed that odometry contradicts."""

from math import hypot

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from services.mapper.optimisation import PoseGraphConfig, optimised
from services.mapper.pose_graph import PoseGraph
from services.mapper.slip import Slip, widened
from shared.geometry import Pose2

metres = st.floats(-3, 3)
offs = st.builds(Pose2, metres, metres, st.floats(-3, 3))
ways = st.floats(0, 5)


@given(offs, ways, ways, st.floats(1.01, 3))
def test_farther_off_is_more_surprising_and_more_motion_less(off, path, turn, more):
    assume(hypot(off.x, off.y) + abs(off.yaw) > 1e-3)
    surprise = Slip(path, turn).surprise(off, 10.0, 10.0)
    assert Slip(path, turn).surprise(Pose2(more * off.x, more * off.y, more * off.yaw), 10.0, 10.0) > surprise
    assert Slip(path + more, turn + more).surprise(off, 10.0, 10.0) < surprise
    assert Slip(path, turn).surprise(off, 0.0, 0.0) >= surprise


@given(offs, st.floats(0.01, 100), st.floats(0.01, 100))
def test_the_covariance_grows_by_what_no_slip_explains(off, along, turning):
    information = np.diag((along, 2 * along, turning))
    odometry = Pose2(0.3, 0.0, 0.0)
    believed = widened(information, odometry @ off, off)
    d = np.array((off.x, off.y, off.yaw))
    if hypot(off.x, off.y) > 0.4 + 1e-9 or abs(off.yaw) > 0.4 + 1e-9:
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
    assert widened(information, moved, odometry.inverse() @ moved) is information


def test_a_closure_puts_the_error_where_odometry_and_scans_disagreed():
    graph, sure = PoseGraph(), np.diag((1e4, 1e4, 1e5))
    true = [Pose2(0.3 * k, 0.0, 0.0) for k in range(11)]
    matched = [Pose2(0.3, 0.0, 0.0)] * 10
    matched[4] = Pose2(1.3, 0.0, 0.0)  # the scans saw ground that moved with the robot
    nodes = [graph.add(Pose2())]
    for step in matched:
        off = Pose2(0.3, 0.0, 0.0).inverse() @ step
        nodes.append(graph.add(graph.pose(nodes[-1]) @ step))
        graph.connect(nodes[-2], nodes[-1], step, widened(sure, step, off), loop=False)
    graph.connect(nodes[0], nodes[-1], true[-1], sure, loop=True)
    result = optimised(graph.snapshot(), PoseGraphConfig())
    assert_allclose(result.poses[:, 0], [pose.x for pose in true], atol=0.02)
