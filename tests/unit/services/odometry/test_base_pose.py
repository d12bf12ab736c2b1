# SPDX-License-Identifier: Apache-2.0
"""Odometry of a base that does its own: passed through, continuous over restarts, with its covariance."""

from math import pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.odometry.dead_reckoning import DeadReckoningConfig
from services.odometry.service import OdometryService
from shared.config import load_robot
from shared.geometry import Pose2
from shared.messages import BaseOdometry

ROBOT = load_robot("turtlebot3_burger").robot
MS = 1_000_000
NOTHING = np.zeros(9)


def service():
    return OdometryService(DeadReckoningConfig(), ROBOT)


def message(ms, pose=None, twist=None, epoch=1, covariance=NOTHING, twist_covariance=NOTHING):
    v, w = twist or (0.0, 0.0)
    has_pose, has_twist = pose is not None, twist is not None
    covariances = covariance, twist_covariance
    return BaseOdometry(ms * MS, epoch, has_pose, pose or Pose2(), has_twist, v, 0.0, w, *covariances, 12.0)


def fed(odometry, *messages):
    out = [publication.message for one in messages for publication in odometry.base_odometry(one)]
    return out[-1] if out else None


def same(pose, x, y, yaw):
    assert (pose.x, pose.y, pose.yaw) == pytest.approx((x, y, yaw), abs=1e-9)


def test_a_pose_is_passed_through_with_its_covariance_and_twist():
    given_covariance = np.diag([0.01, 0.02, 0.03]).ravel()
    out = fed(
        service(),
        message(0, Pose2(1.0, 2.0, 0.5), (0.1, 0.2)),
        message(20, Pose2(1.1, 2.1, 0.6), (0.3, 0.4), covariance=given_covariance),
    )
    same(out.odom_from_base, 1.1, 2.1, 0.6)
    assert (out.v, out.w, out.stamp) == (0.3, 0.4, 20 * MS)
    np.testing.assert_allclose(out.covariance, given_covariance)


def test_a_restarted_base_continues_the_pose_and_its_covariance_grows_from_there():
    odometry = service()
    covariance = np.diag([0.01, 0.01, 0.04]).ravel()
    before = fed(odometry, message(0, Pose2()), message(20, Pose2(1.0, 0.0, pi / 2), covariance=covariance))
    after = fed(odometry, message(40, Pose2(0.0, 0.0, 0.0), epoch=2))
    assert after.odom_from_base == before.odom_from_base
    np.testing.assert_allclose(after.covariance, before.covariance)
    moved = fed(odometry, message(60, Pose2(2.0, 0.0, 0.0), epoch=2, covariance=np.diag([0.1, 0.2, 0.3]).ravel()))
    same(moved.odom_from_base, 1.0, 2.0, pi / 2)
    square = moved.covariance.reshape(3, 3)
    assert square[0, 0] == pytest.approx(0.01 + 0.04 * 2.0**2 + 0.2)  # by the heading at the restart; then turned
    assert square[1, 1] == pytest.approx(0.01 + 0.1)
    assert square[2, 2] == pytest.approx(0.04 + 0.3)


def test_a_pose_without_a_twist_gives_the_speed_of_its_steps():
    out = fed(service(), message(0, Pose2()), message(100, Pose2(0.02, 0.0, 0.05)))
    assert (out.v, out.w) == pytest.approx((0.2, 0.5))


def test_a_twist_alone_is_integrated_with_its_covariance():
    odometry = service()
    covariance = np.diag([0.01, 0.0, 0.04]).ravel()
    steps = [message(20 * k, twist=(0.5, 0.0), twist_covariance=covariance) for k in range(51)]
    out = fed(odometry, *steps)
    same(out.odom_from_base, 0.5, 0.0, 0.0)
    square = out.covariance.reshape(3, 3)
    assert square[0, 0] == pytest.approx(50 * 0.01 * 0.02**2)
    assert square[2, 2] == pytest.approx(50 * 0.04 * 0.02**2)


def test_after_a_long_pause_a_twist_is_no_motion():
    out = fed(service(), message(0, twist=(0.5, 0.0)), message(5000, twist=(0.5, 0.0)))
    same(out.odom_from_base, 0.0, 0.0, 0.0)


def test_an_unknown_covariance_grows_with_the_travel():
    out = fed(service(), message(0, Pose2()), *(message(20 * k, Pose2(0.01 * k, 0.0, 0.0)) for k in range(1, 101)))
    square = out.covariance.reshape(3, 3)
    assert square[0, 0] == pytest.approx(2e-5 / 2, rel=0.01)  # two wheels, 1 m each
    assert square[2, 2] == pytest.approx(2 * 2e-5 / 0.160**2, rel=0.01)


def test_old_repeated_and_late_messages_are_ignored():
    odometry = service()
    odometry.now = 5_000 * MS
    fed(odometry, message(0, Pose2()), message(20, Pose2(0.1, 0.0, 0.0)))
    assert fed(odometry, message(20, Pose2(9.0, 0.0, 0.0)), message(10, Pose2(9.0, 0.0, 0.0))) is None
    fed(odometry, message(40, Pose2(), epoch=3))
    assert fed(odometry, message(60, Pose2(9.0, 0.0, 0.0), epoch=1)) is None
    same(fed(odometry, message(80, Pose2(0.1, 0.0, 0.0), epoch=3)).odom_from_base, 0.2, 0.0, 0.0)


poses = st.builds(Pose2, st.floats(-5, 5), st.floats(-5, 5), st.floats(-3, 3))


@given(st.lists(st.tuples(poses, st.booleans()), min_size=1, max_size=12))
def test_however_often_the_base_restarts_each_step_within_an_epoch_is_its_own(steps):
    odometry, epoch, ms = service(), 1, 0
    last = fed(odometry, message(0, steps[0][0])).odom_from_base
    before = steps[0][0]
    for pose, restarts in steps[1:]:
        ms, epoch = ms + 20, epoch + restarts
        out = fed(odometry, message(ms, pose, epoch=epoch)).odom_from_base
        expected = Pose2() if restarts else before.inverse() @ pose
        step = last.inverse() @ out
        assert (step.x, step.y) == pytest.approx((expected.x, expected.y), abs=1e-6)
        last, before = out, pose
