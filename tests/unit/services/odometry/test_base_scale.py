# SPDX-License-Identifier: Apache-2.0
"""The scales of a base's own odometry: what they leave alone, and what they correct."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.odometry.base_scale import BaseScale
from shared.geometry import Pose2, arc
from shared.messages import BaseOdometry

STEPS = st.lists(st.tuples(st.floats(-0.1, 0.1), st.floats(-0.2, 0.2)), min_size=1, max_size=30)


def message(
    stamp: int, pose: Pose2, v: float = 0.0, w: float = 0.0, epoch: int = 1, has_pose: bool = True
) -> BaseOdometry:
    return BaseOdometry(stamp, epoch, has_pose, pose, True, v, 0.0, w, np.zeros(9), np.zeros(9), float("nan"))


def test_scales_of_one_leave_the_message_as_it_is():
    told = message(1, Pose2(1, 2, 3), 0.5, 0.1)
    assert BaseScale(1.0, 1.0).corrected(told) is told


@given(steps=STEPS, distance=st.floats(0.8, 1.25), turn=st.floats(0.8, 1.25))
def test_a_base_that_counts_wrong_is_corrected_to_the_true_path(steps, distance, turn):
    scale = BaseScale(distance, turn)
    true = reported = Pose2()
    corrected = scale.corrected(message(0, reported))
    for i, (forward, bend) in enumerate(steps):
        true @= Pose2(forward, 0.0, bend)
        reported @= Pose2(forward / distance, 0.0, bend / turn)
        corrected = scale.corrected(message(i + 1, reported))
    assert corrected.odom_from_base.distance(true) < 1e-9
    assert corrected.odom_from_base.yaw == pytest.approx(true.yaw, abs=1e-9)


def test_a_new_epoch_begins_where_the_base_begins_it_and_the_twist_is_scaled():
    scale = BaseScale(1.1, 0.9)
    scale.corrected(message(1, Pose2()))
    scale.corrected(message(2, arc(1.0, 0.2)))
    again = scale.corrected(message(3, Pose2(5, 0, 0), 1.0, 1.0, epoch=2))
    assert again.odom_from_base == Pose2(5, 0, 0)
    assert (again.v, again.w) == pytest.approx((1.1, 0.9))
    twist = scale.corrected(message(4, Pose2(), 1.0, 0.0, epoch=2, has_pose=False))
    assert twist.odom_from_base == Pose2()
    assert twist.v == pytest.approx(1.1)
