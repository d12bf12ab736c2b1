# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from services.mapper.odometry_track import KEPT, OdometryConfig, OdometryTrack
from shared.geometry import Pose2, arc
from shared.messages import Odometry
from tests.unit.services.mapper.rooms import ROBOT, SECOND

HUNDREDTH = SECOND // 100


def track():
    return OdometryTrack(OdometryConfig(), ROBOT.drive)


def told(stamp, pose, v=0.0, w=0.0):
    return Odometry(stamp, pose, v, w, np.zeros(9))


def close(a, b, tolerance=1e-9):
    d = a.inverse() @ b
    return abs(d.x) < tolerance and abs(d.y) < tolerance and abs(d.yaw) < tolerance


@given(st.lists(st.tuples(st.floats(0, 0.006), st.floats(-0.03, 0.03)), min_size=2, max_size=60), st.integers(0, 58))
def test_a_restarted_odometry_moves_nothing(steps, restart):
    """A drive with and without a publisher that starts again at 0 in its middle: the same motion but for a step."""
    whole, broken = track(), track()
    pose, again = Pose2(40, -30, 1), Pose2(40, -30, 1)
    lost = Pose2()
    for i, (forward, turn) in enumerate(steps):
        before = pose
        pose = pose @ arc(forward, turn)
        again = again @ arc(forward, turn)
        if i == restart:
            again, lost = Pose2(), before.inverse() @ pose
        whole.add(told((i + 1) * HUNDREDTH, pose))
        broken.add(told((i + 1) * HUNDREDTH, again))
    end = len(steps) * HUNDREDTH
    motion = whole.at(HUNDREDTH).inverse() @ whole.at(end)
    found = broken.at(HUNDREDTH).inverse() @ broken.at(end)
    slack = abs(lost.x) + abs(lost.y) + 0.5 * abs(lost.yaw)
    assert abs(motion.x - found.x) + abs(motion.y - found.y) <= 3 * slack + 1e-9
    assert close(broken.odom_from_start(end) @ broken.at(end), again)


def test_between_samples_the_motion_is_interpolated_and_after_the_last_the_twist_goes_on():
    found = track()
    found.add(told(SECOND, Pose2(1, 1, 0)))
    found.add(told(SECOND + 2 * HUNDREDTH, Pose2(1.01, 1, 0), v=0.5))
    assert close(found.at(SECOND + HUNDREDTH), Pose2(0.005, 0, 0))
    assert close(found.at(SECOND + 12 * HUNDREDTH), Pose2(0.06, 0, 0))


def test_extrapolation_ends():
    found = track()
    found.add(told(SECOND, Pose2(), v=0.5))
    assert found.at(1000 * SECOND).x == pytest.approx(0.5 * OdometryConfig().timeout)


def test_the_motion_during_a_sweep_ends_at_the_origin_and_turns_without_a_seam():
    found = track()
    for i in range(40):
        found.add(told(SECOND + i * HUNDREDTH, Pose2(0, 0, 2.9 + 0.02 * i)))
    times, rows = found.during(SECOND + 5 * HUNDREDTH, SECOND + 25 * HUNDREDTH)
    assert_allclose(rows[-1], 0, atol=1e-12)
    assert_allclose(rows[:, 2], 2.0 * times, atol=1e-9)
    assert times[0] == pytest.approx(-0.2)


def test_a_message_of_the_past_is_refused_and_one_of_the_same_time_replaces():
    found = track()
    found.add(told(SECOND, Pose2()))
    found.add(told(2 * SECOND, Pose2(0.1, 0, 0)))
    assert not found.add(told(SECOND, Pose2(9, 9, 0)))
    assert found.add(told(2 * SECOND, Pose2(0.2, 0, 0)))
    assert found.at(2 * SECOND).x == pytest.approx(0.2)
    assert len(found.samples) == 2


def test_the_memory_is_bounded():
    found = track()
    for i in range(3 * KEPT):
        found.add(told(i * HUNDREDTH, Pose2(0.001 * i, 0, 0)))
    assert len(found.samples) <= KEPT
    assert found.at(3 * KEPT * HUNDREDTH).x == pytest.approx(0.001 * (3 * KEPT - 1))
