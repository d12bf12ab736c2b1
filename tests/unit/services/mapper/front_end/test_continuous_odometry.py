# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from services.mapper.front_end.continuous_odometry import MAX_SAMPLES, ContinuousOdometry, OdometryConfig
from shared.geometry import Pose2, arc
from shared.messages import Odometry
from shared.types import NS_PER_S
from tests.unit.services.mapper.rooms import ROBOT

HUNDREDTH = NS_PER_S // 100


def continuous_odometry():
    return ContinuousOdometry(OdometryConfig(), ROBOT.drive)


def message(stamp, pose, v=0.0, w=0.0):
    return Odometry(stamp, pose, v, w, np.zeros(9))


def close(a, b, tolerance=1e-9):
    d = a.inverse() @ b
    return abs(d.x) < tolerance and abs(d.y) < tolerance and abs(d.yaw) < tolerance


@given(st.lists(st.tuples(st.floats(0, 0.006), st.floats(-0.03, 0.03)), min_size=2, max_size=60), st.integers(0, 58))
def test_a_restarted_odometry_moves_nothing(steps, restart):
    """A drive with and without a publisher that starts again at 0 in its middle: the same motion but for a step."""
    whole, broken = continuous_odometry(), continuous_odometry()
    pose, again = Pose2(40, -30, 1), Pose2(40, -30, 1)
    lost = Pose2()
    for i, (forward, turn) in enumerate(steps):
        before = pose
        pose = pose @ arc(forward, turn)
        again = again @ arc(forward, turn)
        if i == restart:
            again, lost = Pose2(), before.inverse() @ pose
        whole.add(message((i + 1) * HUNDREDTH, pose))
        broken.add(message((i + 1) * HUNDREDTH, again))
    end = len(steps) * HUNDREDTH
    motion = whole.start_from_base(HUNDREDTH).inverse() @ whole.start_from_base(end)
    odometry = broken.start_from_base(HUNDREDTH).inverse() @ broken.start_from_base(end)
    slack = abs(lost.x) + abs(lost.y) + 0.5 * abs(lost.yaw)
    assert abs(motion.x - odometry.x) + abs(motion.y - odometry.y) <= 3 * slack + 1e-9
    assert close(broken.odom_from_start(end) @ broken.start_from_base(end), again)


def test_between_samples_the_motion_is_interpolated_and_after_the_last_the_twist_goes_on():
    odometry = continuous_odometry()
    odometry.add(message(NS_PER_S, Pose2(1, 1, 0)))
    odometry.add(message(NS_PER_S + 2 * HUNDREDTH, Pose2(1.01, 1, 0), v=0.5))
    assert close(odometry.start_from_base(NS_PER_S + HUNDREDTH), Pose2(0.005, 0, 0))
    assert close(odometry.start_from_base(NS_PER_S + 12 * HUNDREDTH), Pose2(0.06, 0, 0))


def test_extrapolation_ends():
    odometry = continuous_odometry()
    odometry.add(message(NS_PER_S, Pose2(), v=0.5))
    assert odometry.start_from_base(1000 * NS_PER_S).x == pytest.approx(0.5 * OdometryConfig().timeout)


def test_the_motion_during_a_sweep_ends_at_the_origin_and_turns_without_a_seam():
    odometry = continuous_odometry()
    for i in range(40):
        odometry.add(message(NS_PER_S + i * HUNDREDTH, Pose2(0, 0, 2.9 + 0.02 * i)))
    times, rows = odometry.motion_during(NS_PER_S + 5 * HUNDREDTH, NS_PER_S + 25 * HUNDREDTH)
    assert_allclose(rows[-1], 0, atol=1e-12)
    assert_allclose(rows[:, 2], 2.0 * times, atol=1e-9)
    assert times[0] == pytest.approx(-0.2)


def test_a_message_of_the_past_is_refused_and_one_of_the_same_time_replaces():
    odometry = continuous_odometry()
    odometry.add(message(NS_PER_S, Pose2()))
    odometry.add(message(2 * NS_PER_S, Pose2(0.1, 0, 0)))
    assert not odometry.add(message(NS_PER_S, Pose2(9, 9, 0)))
    assert odometry.add(message(2 * NS_PER_S, Pose2(0.2, 0, 0)))
    assert odometry.start_from_base(2 * NS_PER_S).x == pytest.approx(0.2)
    assert len(odometry.samples) == 2


def test_the_memory_is_bounded_and_no_motion_is_lost():
    odometry = continuous_odometry()
    for i in range(3 * MAX_SAMPLES):
        odometry.add(message(i * HUNDREDTH, Pose2(0.001 * i, 0, 0)))
    assert len(odometry.samples) <= MAX_SAMPLES
    assert odometry.start_from_base(3 * MAX_SAMPLES * HUNDREDTH).x == pytest.approx(0.001 * (3 * MAX_SAMPLES - 1))
    for i in (0, 1, 1001, MAX_SAMPLES, 2 * MAX_SAMPLES + 1):  # also where the last scan came, minutes ago
        assert odometry.start_from_base(i * HUNDREDTH).x == pytest.approx(0.001 * i)
