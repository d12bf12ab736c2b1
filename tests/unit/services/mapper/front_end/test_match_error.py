# SPDX-License-Identifier: Apache-2.0
"""Matches are doubted where they are erratic and odometry is even, and nowhere else."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from services.mapper.front_end.match_error import DOUBTED_SIGMA, MatchError
from services.mapper.front_end.odometry_error import OdometryError
from services.mapper.front_end.registration import RegistrationConfig, _widen
from shared.geometry import Pose2
from shared.types import Float64s

STEP = Pose2(0.2, 0.0, 0.0)  # of a scan each 0.6 s
MATCH_SIGMA = 0.01  # m, that the beams claim


def learned(steps: list[Pose2], motions: list[Pose2]) -> MatchError:
    error = MatchError()
    for step, motion in zip(steps, motions, strict=True):
        error.add(step, motion)
    return error


def jumping(seed: int, n: int, sigma: float, sigma_turn: float) -> list[Pose2]:
    """Motions by matches whose poses err independently, m and rad, while the robot drives STEP a scan."""
    off = np.random.default_rng(seed).normal(0, (sigma, sigma, sigma_turn), (n + 1, 3))
    return [Pose2(STEP.x + float(x), float(y), float(yaw)) for x, y, yaw in np.diff(off, axis=0)]


@given(st.integers(0, 100))
def test_matches_that_jump_about_even_odometry_are_doubted(seed: int) -> None:
    error = learned([STEP] * 60, jumping(seed, 60, 0.3, 0.1))
    assert 0.5 * 0.3 < np.sqrt(error.variance) < 4 * 0.3
    assert 0.5 * 0.1 < np.sqrt(error.turn_variance) < 4 * 0.1
    assert error.exceeds(0.02**2, 0.01**2)
    assert error.is_doubtful


@given(st.integers(0, 100))
def test_odometry_keeps_its_weight_beside_such_matches(seed: int) -> None:
    """The fault: each jump counted as odometry's error, and so the next match had more freedom."""
    odometry, config, place, away, weights = OdometryError(), RegistrationConfig(), 0.0, [], []
    for k, off in enumerate(np.random.default_rng(seed).normal(0, 0.3, 80).tolist()):
        prior = odometry.prior(config, Pose2(), STEP, seconds=0.6)
        weight = prior.sigma**2 / (prior.sigma**2 + MATCH_SIGMA**2 + prior.match_variance)
        step = STEP.x + weight * (STEP.x * (k + 1) + off - place - STEP.x)
        odometry.add_match(STEP, Pose2(step, 0.0, 0.0), np.eye(3) / (MATCH_SIGMA**2 + prior.match_variance), 0.6)
        place += step
        away.append(place - STEP.x * (k + 1))
        weights.append(weight)
    assert np.mean(weights[20:]) < 0.6  # 1.00 without a doubt of matches
    assert np.std(away[20:]) < 0.21  # 0.22 to 0.37 without it


def test_a_doubt_ends_where_matches_agree_again() -> None:
    error = learned([STEP] * 260, [*jumping(1, 60, 0.3, 0.1), *[STEP] * 200])
    assert np.sqrt(error.variance) < 0.1
    assert not error.exceeds(0.03**2, 0.02**2)
    assert not learned([STEP] * 60, [STEP] * 60).is_doubtful


@given(st.integers(0, 100))
def test_one_small_difference_changes_nothing(seed: int) -> None:
    """The fault: a turn on the spot with 7 cm of drift, and odometry's errors were not learned for 50 scans."""
    place = seed % 50
    motions = [STEP] * place + [Pose2(STEP.x, 0.07, 0.0)] + [STEP] * 50
    error = learned([STEP] * len(motions), motions)
    assert error.variance == error.turn_variance == 0


@given(st.integers(0, 100))
def test_wheels_that_slip_now_and_then_raise_no_doubt(seed: int) -> None:
    shares = np.random.default_rng(seed).uniform(0, 1, 60)
    assert learned([STEP] * 60, [Pose2(0.2 * share, 0.0, 0.0) for share in shares]).variance == 0


@pytest.mark.parametrize("off", [Pose2(0.1, 0.2, 0.0), Pose2(0.5, 0.0, 0.3)])
def test_an_error_that_stays_is_odometry_s(off: Pose2) -> None:
    error = learned([STEP] * 60, [Pose2(STEP.x + off.x, off.y, off.yaw)] * 60)
    assert error.variance == error.turn_variance == 0


@given(st.integers(0, 100))
def test_odometry_that_is_as_uneven_as_the_matches_raises_no_doubt(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = [Pose2(float(x), 0.0, float(yaw)) for x, yaw in rng.uniform((0, -1), (1, 1), (100, 2))]
    wrong = [Pose2(p.x * float(a), 0.0, p.yaw * float(b)) for p, (a, b) in zip(true, rng.uniform(0.5, 1.5, (100, 2)))]
    assert learned(wrong, true).turn_variance < 0.02**2


@pytest.mark.parametrize("delay", [1, 3, 6])
def test_late_odometry_raises_no_doubt_for_long(delay: int) -> None:
    """A robot stops and goes, and turns: odometry shows it `delay` scans of 0.1 s later."""
    turns = ([0.0] * 20 + [0.1] * 15) * 8
    true = [Pose2(0.05, 0.0, turn) for turn in turns]
    late = [Pose2(0.05, 0.0, turn) for turn in [0.0] * delay + turns[:-delay]]
    assert np.sqrt(learned(late, true).turn_variance) < 0.03


def test_after_scans_that_fit_nothing_the_next_are_doubted() -> None:
    error = MatchError()
    error.add(STEP, STEP)
    error.doubt()
    assert min(error.variance, error.turn_variance) > 0.5 * DOUBTED_SIGMA**2
    assert max(error.variance, error.turn_variance) < DOUBTED_SIGMA**2
    strong = learned([STEP] * 60, jumping(1, 60, 0.3, 0.1))
    before = strong.variance
    strong.doubt()
    assert strong.variance == before


def information(seed: int, weak: float) -> Float64s:
    rng = np.random.default_rng(seed)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    return np.asarray(axes @ np.diag((1e4, 1e5, weak)) @ axes.T)


@settings(max_examples=200)
@given(st.integers(0, 1000), st.sampled_from([1.0, 1e3, 1e6]), st.floats(1e-6, 1.0), st.floats(1e-6, 0.1))
def test_the_variance_is_added_to_that_of_the_beams_and_their_position_stays(
    seed: int, weak: float, variance: float, turn_variance: float
) -> None:
    beams, off = information(seed, weak), np.array((0.1, -0.2, 0.05))
    widened, gradient = beams.copy(), beams @ off
    _widen(widened, gradient, variance, turn_variance)
    covariance = np.linalg.inv(beams) + np.diag((variance, variance, turn_variance))
    assert_allclose(widened @ covariance, np.eye(3), atol=1e-4)
    assert_allclose(covariance @ gradient, off, rtol=1e-3, atol=1e-4)


def test_no_variance_changes_nothing() -> None:
    beams, gradient = information(1, 1e3), np.ones(3)
    widened = beams.copy()
    _widen(widened, gradient, 0.0, 0.0)
    assert (widened == beams).all()
    assert (gradient == 1).all()
