# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.config import load_robot
from shared.geometry import Pose2, arc, wrapped
from shared.messages import Odometry
from shared.odometry_buffer import CAPACITY, EXTRAPOLATION_S, OdometryBuffer

DRIVE = load_robot("x80sv").robot.drive
START_NS = 1_790_000_000_000_000_007  # as a clock of the wall gives it


def messages(twists, dt=0.02):
    """Odometry each dt s, with each twist (m/s, rad/s) for one step."""
    pose, found = Pose2(), []
    for i, (v, w) in enumerate(twists):
        found.append(Odometry(START_NS + round(i * dt * 1e9), pose, v, w, np.zeros(9)))
        pose = pose @ arc(v * dt, w * dt)
    return found


def filled(sent):
    buffer = OdometryBuffer(DRIVE)
    for odometry in sent:
        assert buffer.add(odometry)
    return buffer


twists = st.lists(st.tuples(st.floats(-0.5, 0.5), st.floats(-1.0, 1.0)), min_size=2, max_size=40)


@given(twists, st.lists(st.floats(0.0, 1.0), min_size=1, max_size=8))
def test_poses_lie_on_the_line_between_the_messages_around_them(twists, shares):
    sent = messages(twists)
    buffer, length = filled(sent), (sent[-1].stamp - START_NS) * 1e-9
    for share, (x, y, yaw) in zip(shares, buffer.poses(length * np.array(shares), START_NS)):
        i = min(int(share * (len(sent) - 1)), len(sent) - 2)
        part = share * (len(sent) - 1) - i
        a, b = (odometry.odom_from_base for odometry in sent[i : i + 2])
        assert (x, y) == pytest.approx(((1 - part) * a.x + part * b.x, (1 - part) * a.y + part * b.y), abs=1e-6)
        assert wrapped(yaw - a.yaw) == pytest.approx(part * wrapped(b.yaw - a.yaw), abs=1e-6)


def test_the_yaw_runs_through_whole_turns():
    sent = messages([(0.0, 1.0)] * 400, dt=0.02)  # 8 rad
    assert len(sent) > CAPACITY
    buffer = filled(sent)
    length = 0.02 * (CAPACITY - 1)
    seconds = np.linspace(0.0, length, 50)
    yaws = buffer.poses(seconds, sent[-CAPACITY].stamp)[:, 2]
    assert yaws - yaws[0] == pytest.approx(seconds, abs=1e-6)


@pytest.mark.parametrize("n", [1, 2, CAPACITY, CAPACITY + 1, 2 * CAPACITY - 1, 2 * CAPACITY, 3 * CAPACITY + 5])
def test_the_newest_messages_are_kept_however_many_came(n):
    sent = messages([(0.4, 0.3)] * n)
    buffer, kept = filled(sent), sent[-CAPACITY:]
    seconds = np.array([(odometry.stamp - START_NS) * 1e-9 for odometry in kept])
    poses = buffer.poses(seconds, START_NS)
    assert poses[:, :2] == pytest.approx(np.array([(o.odom_from_base.x, o.odom_from_base.y) for o in kept]), abs=1e-6)
    assert buffer.covers(kept[0].stamp, kept[-1].stamp)
    assert not buffer.covers(kept[0].stamp - 200_000_000, kept[-1].stamp)
    assert not buffer.covers(kept[0].stamp, kept[-1].stamp + 300_000_000)


def test_the_newest_twist_goes_on_for_a_tenth_of_a_second():
    sent = messages([(0.4, 0.5)] * 3)
    end, last = (sent[-1].stamp - START_NS) * 1e-9, sent[-1].odom_from_base
    poses = filled(sent).poses(end + np.array([EXTRAPOLATION_S, 5.0]), START_NS)
    expected = last @ arc(0.4 * EXTRAPOLATION_S, 0.5 * EXTRAPOLATION_S)
    for x, y, yaw in poses:
        assert (x, y, yaw) == pytest.approx((expected.x, expected.y, expected.yaw), abs=1e-6)


@pytest.mark.parametrize(
    "another", [Pose2(1.0), Pose2(0.0, 0.0, 1.0)], ids=["elsewhere", "turned"]
)  # one 20 ms later, beyond the drive's limits
def test_a_step_beyond_the_drives_limits_begins_again(another):
    sent = messages([(0.1, 0.0)] * 20)
    buffer, after = filled(sent), sent[-1].stamp + 20_000_000
    assert not buffer.add(Odometry(after, another, 0.0, 0.0, np.zeros(9)))
    assert not buffer.covers(sent[0].stamp, after)
    x, y, yaw = buffer.poses(np.array([-1.0]), after)[0]
    assert (x, y, yaw) == (another.x, another.y, another.yaw)
    assert buffer.add(Odometry(after + 20_000_000, another, 0.0, 0.0, np.zeros(9)))


def test_stamps_that_go_back_begin_again():
    sent = messages([(0.1, 0.0)] * 20)
    assert not filled(sent).add(sent[0])


def test_without_a_message_nothing_is_covered():
    buffer = OdometryBuffer(DRIVE)
    assert not buffer.covers(0, 0)
    assert buffer.odom_from_base == Pose2()
