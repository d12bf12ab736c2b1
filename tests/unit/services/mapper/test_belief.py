# SPDX-License-Identifier: Apache-2.0
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from services.mapper.belief import Belief, mean_doubt, moved_by
from services.mapper.registration import Prior
from shared.geometry import Pose2

SURE = np.diag((1e5, 1e5, 1e6))
CORRIDOR = np.diag((0.0, 1e5, 1e6))
NOTHING = np.zeros((3, 3))
STEP = 0.2


def steps(belief, n, information, ahead=0.02, drawn=None):
    for k in range(n):
        belief.take(
            Pose2(STEP * k, 0, 0), Prior(Pose2(STEP * (k + 1), 0, 0), 0.01, 0.01), ahead, information,
            belief.carried if drawn is None else drawn,
        )  # fmt: skip


def test_unseen_steps_add_their_variances_and_what_is_wrong_with_their_length_adds_up():
    belief = Belief()
    steps(belief, 25, CORRIDOR)
    assert_allclose(belief.covariance[0, 0], 25 * 0.01**2 + (25 * 0.02) ** 2, rtol=1e-9)
    assert belief.covariance[1, 1] < 0.004**2


def test_where_the_beams_tell_all_the_covariance_is_theirs():
    belief = Belief()
    steps(belief, 200, SURE)
    expected = np.linalg.inv(SURE + np.diag((1e4, 1e4, 1e4)))
    assert_allclose(np.diag(belief.covariance)[1:], np.diag(expected)[1:], rtol=0.1)
    assert belief.sigma < 0.03, "of 40 m, each a tenth too long"


def test_a_map_drawn_from_an_unsure_place_makes_nobody_sure_and_old_ground_does():
    belief = Belief()
    steps(belief, 25, CORRIDOR)
    unsure = belief.sigma
    for _ in range(40):
        belief.take(Pose2(5, 0, 0), Prior(Pose2(5, 0, 0), 0.01, 0.01), 0.0, SURE, belief.carried)
    assert belief.sigma > 0.95 * unsure
    for _ in range(6):
        belief.take(Pose2(5, 0, 0), Prior(Pose2(5, 0, 0), 0.01, 0.01), 0.0, SURE, NOTHING)
    assert belief.sigma < 0.01


@given(
    st.lists(
        st.tuples(st.floats(-1, 1), st.floats(0, 1e5), st.floats(0, 1e5), st.floats(0, 3), st.floats(0, 0.2)),
        min_size=1, max_size=12,
    )
)  # fmt: skip
def test_it_is_a_covariance_whatever_comes(events):
    belief, pose = Belief(), Pose2()
    for x, a, b, turn, ahead in events:
        axes = np.array(((np.cos(turn), -np.sin(turn), 0.1), (np.sin(turn), np.cos(turn), -0.2), (0.3, 0.0, 1.0)))
        after = pose @ Pose2(x, 0.0, turn)
        belief.take(pose, Prior(after, 0.02, 0.01), ahead, axes @ np.diag((a, b, a)) @ axes.T, belief.carried / 2)
        pose = after
        assert_allclose(belief.covariance, belief.covariance.T, atol=1e-12 * max(belief.covariance.max(), 1))
        assert np.linalg.eigvalsh(belief.covariance)[0] > -1e-9
        assert (np.linalg.eigvalsh(belief.covariance - belief.carried) > -1e-9).all()


def test_the_mean_of_doubts_is_of_this_place_not_of_those_where_they_arose():
    turned = np.diag((0.0, 0.0, 0.1**2))
    mean = mean_doubt(np.array([turned, turned], np.float32), np.array([(0, 0), (0, 0)], np.float32), 3.0, 0.0)
    lever = moved_by(3.0, 0.0)
    assert_allclose(mean, lever @ turned @ lever.T, rtol=1e-6)
    assert_allclose(np.sqrt(mean[1, 1]), 0.3, rtol=1e-6)
    assert mean_doubt(np.zeros((0, 3, 3), np.float32), np.zeros((0, 2), np.float32), 0.0, 0.0) is None
