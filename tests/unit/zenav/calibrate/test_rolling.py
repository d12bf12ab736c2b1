# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.config import load_robot
from shared.geometry import Pose2, arc, wrapped
from shared.messages import WheelState
from zenav.calibrate.rolling import WheelGeometry, WheelTravel, composed_poses, relative_poses

WHEELS = WheelGeometry(0.084, 0.086, 0.29)
MS = 1_000_000
angles = st.lists(st.tuples(st.floats(-2, 2), st.floats(-2, 2)), min_size=1, max_size=20)
poses = st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-3, 3))


def rolled(steps, ms=20) -> WheelTravel:
    ends = np.concatenate((np.zeros((1, 2)), np.cumsum(np.array(steps, float).reshape(-1, 2), axis=0)))
    return WheelTravel(np.arange(len(ends)) * ms * MS, ends[:, 0], ends[:, 1], np.zeros(len(ends), bool))


def same(row, pose: Pose2) -> None:
    assert row[:2] == pytest.approx((pose.x, pose.y), abs=1e-9)
    assert wrapped(row[2] - pose.yaw) == pytest.approx(0, abs=1e-9)


@given(angles)
def test_the_wheels_carry_the_robot_along_their_arcs(steps):
    pose = Pose2()
    for left, right in steps:
        left, right = left * WHEELS.left_radius, right * WHEELS.right_radius
        pose = pose @ arc((left + right) / 2, (right - left) / WHEELS.distance)
    same(rolled(steps).poses(WHEELS)[-1], pose)


@given(angles, st.lists(st.integers(-50, 500), max_size=8))
def test_more_samples_change_no_way(steps, ms):
    once = rolled(steps)
    more = once.with_samples(np.array(ms, np.int64) * MS)
    assert np.all(np.diff(more.stamps) > 0)
    index = np.searchsorted(more.stamps, once.stamps)
    before, after = once.poses(WHEELS), more.poses(WHEELS)
    np.testing.assert_allclose(after[index] - after[index[0]], before, atol=1e-9)


@given(poses, poses)
def test_between_undoes_composed(a, b):
    rows_a, rows_b = np.array([a]), np.array([b])
    np.testing.assert_allclose(relative_poses(rows_a, composed_poses(rows_a, rows_b)), rows_b, atol=1e-9)
    same(composed_poses(rows_a, rows_b)[0], Pose2(*a) @ Pose2(*b))


def test_a_new_epoch_goes_on_where_the_last_one_ended_and_its_motion_is_unknown():
    states = [WheelState(k * 20 * MS, 1, k, k, 0, 0) for k in range(3)]
    states += [WheelState((k + 3) * 20 * MS, 2, 50 + k, 60 + k, 0, 0) for k in range(3)]
    found = WheelTravel.of(states)
    assert found.left.tolist() == [0, 1, 2, 2, 3, 4]
    assert found.right.tolist() == [0, 1, 2, 2, 3, 4]
    stamps = found.stamps
    assert found.is_known(stamps[[0, 3]], stamps[[2, 5]]).all()
    assert not found.is_known(stamps[[0, 2, 1]], stamps[[3, 3, 5]]).any()


def test_nothing_is_known_across_a_gap_or_outside():
    states = [WheelState(ms * MS, 1, ms / 100, ms / 100, 0, 0) for ms in (0, 20, 40, 900, 920)]
    found = WheelTravel.of(states)
    begin, end = np.array([0, 0, 900, -20, 900]) * MS, np.array([40, 900, 920, 20, 940]) * MS
    assert found.is_known(begin, end).tolist() == [True, False, True, False, False]
    more = found.with_samples(np.array([500 * MS]))
    assert not more.is_known(np.array([40 * MS]), np.array([500 * MS]))[0]


def test_configured_wheels_are_the_drive_s():
    drive = load_robot("x80sv").robot.drive.model_copy(update={"wheel_radius_ratio": 1.02})
    wheels = WheelGeometry.of(drive)
    assert (wheels.radius, wheels.ratio, wheels.distance) == pytest.approx((0.085, 1.02, 0.283))
