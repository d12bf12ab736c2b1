# SPDX-License-Identifier: Apache-2.0
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from services.mapper.front_end.pose_covariance import PoseCovariance, lever_matrix, mean_covariance
from services.mapper.front_end.registration import Prior
from shared.geometry import Pose2

SURE = np.diag((1e5, 1e5, 1e6))
CORRIDOR = np.diag((0.0, 1e5, 1e6))
NOTHING = np.zeros((3, 3))
STEP = 0.2


def steps(estimate, n, information, scale_sigma=0.02, matched=None):
    for k in range(n):
        estimate.update(
            Pose2(STEP * k, 0, 0), Prior(Pose2(STEP * (k + 1), 0, 0), 0.01, 0.01), scale_sigma, information,
            estimate.map_covariance if matched is None else matched,
        )  # fmt: skip


def test_unmatched_steps_add_their_variances_and_errors_of_scale_add_up():
    estimate = PoseCovariance()
    steps(estimate, 25, CORRIDOR)
    assert_allclose(estimate.covariance[0, 0], 25 * 0.01**2 + (25 * 0.02) ** 2, rtol=1e-9)
    assert estimate.covariance[1, 1] < 0.004**2


def test_where_the_beams_determine_all_directions_the_covariance_is_theirs():
    estimate = PoseCovariance()
    steps(estimate, 200, SURE)
    expected = np.linalg.inv(SURE + np.diag((1e4, 1e4, 1e4)))
    assert_allclose(np.diag(estimate.covariance)[1:], np.diag(expected)[1:], rtol=0.1)
    assert estimate.sigma < 0.03, "of 40 m, each a tenth too long"


def test_a_map_from_an_uncertain_pose_reduces_no_covariance_and_old_ground_does():
    estimate = PoseCovariance()
    steps(estimate, 25, CORRIDOR)
    unsure = estimate.sigma
    for _ in range(40):
        estimate.update(Pose2(5, 0, 0), Prior(Pose2(5, 0, 0), 0.01, 0.01), 0.0, SURE, estimate.map_covariance)
    assert estimate.sigma > 0.95 * unsure
    for _ in range(6):
        estimate.update(Pose2(5, 0, 0), Prior(Pose2(5, 0, 0), 0.01, 0.01), 0.0, SURE, NOTHING)
    assert estimate.sigma < 0.01


@given(
    st.lists(
        st.tuples(st.floats(-1, 1), st.floats(0, 1e5), st.floats(0, 1e5), st.floats(0, 3), st.floats(0, 0.2)),
        min_size=1, max_size=12,
    )
)  # fmt: skip
def test_the_result_of_any_steps_is_a_covariance(events):
    estimate, pose = PoseCovariance(), Pose2()
    for x, a, b, turn, ahead in events:
        axes = np.array(((np.cos(turn), -np.sin(turn), 0.1), (np.sin(turn), np.cos(turn), -0.2), (0.3, 0.0, 1.0)))
        after = pose @ Pose2(x, 0.0, turn)
        estimate.update(
            pose, Prior(after, 0.02, 0.01), ahead, axes @ np.diag((a, b, a)) @ axes.T, estimate.map_covariance / 2
        )
        pose = after
        assert_allclose(estimate.covariance, estimate.covariance.T, atol=1e-12 * max(estimate.covariance.max(), 1))
        assert np.linalg.eigvalsh(estimate.covariance)[0] > -1e-9
        assert (np.linalg.eigvalsh(estimate.covariance - estimate.map_covariance) > -1e-9).all()


def test_the_mean_covariance_is_that_of_the_given_position():
    turned = np.diag((0.0, 0.0, 0.1**2))
    mean = mean_covariance(np.array([turned, turned], np.float32), np.array([(0, 0), (0, 0)], np.float32), 3.0, 0.0)
    lever = lever_matrix(3.0, 0.0)
    assert_allclose(mean, lever @ turned @ lever.T, rtol=1e-6)
    assert_allclose(np.sqrt(mean[1, 1]), 0.3, rtol=1e-6)
    assert mean_covariance(np.zeros((0, 3, 3), np.float32), np.zeros((0, 2), np.float32), 0.0, 0.0) is None
