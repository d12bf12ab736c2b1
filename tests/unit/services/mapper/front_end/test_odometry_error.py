# SPDX-License-Identifier: Apache-2.0
"""The standard deviation of odometry, against the truth, at any scan rate."""

from math import exp, sqrt

import numpy as np
import pytest

from services.mapper.front_end.odometry_error import OdometryError
from services.mapper.front_end.registration import RegistrationConfig
from shared.geometry import Pose2

N_SEEDS = 30
SECONDS = 12
SPEED, SLIP, SLIP_TIME = 1.0, 0.04, 0.2  # m/s; m/s, standard deviation of odometry's speed; s, its correlation time
MATCH = 0.005  # m, standard deviation of a match by its information
MATCH_TIME = 0.05  # s, correlation time of the errors of matches: they use the same points
INFORMATION = np.diag((1 / MATCH**2, 1 / MATCH**2, 1 / 0.003**2))


def sigma_and_error(seed: int, hz: int, match_error: float, match_time: float) -> tuple[float, float]:
    """Odometry's sigma a second, m/s, and the pose's error, m rms, of a drive whose matches feed back into the sigma.

    match_error: m, true standard deviation of a match.  match_time: s, correlation time of its errors.
    """
    rng, config, error, dt = np.random.default_rng(seed), RegistrationConfig(), OdometryError(), 1 / hz
    pose, true, slip, match_off = Pose2(), 0.0, 0.0, 0.0
    n_parts, keep = round(100 / hz), exp(-0.01 / SLIP_TIME)
    keep_match = exp(-dt / match_time)
    sigmas, offs = [], []
    for k in range(SECONDS * hz):
        for draw in rng.normal(size=n_parts):
            slip = keep * slip + sqrt(1 - keep**2) * SLIP * draw
            true += (SPEED + slip) * 0.01
        match_off = keep_match * match_off + sqrt(1 - keep_match**2) * match_error * rng.normal()
        step = Pose2(SPEED * dt, 0, 0)
        error.add_step(step, dt)
        prior = error.prior(config, pose, error.scaled_step(step), seconds=dt)
        weight = prior.sigma**2 / (prior.sigma**2 + MATCH**2)
        expected = prior.map_from_base.x
        matched = Pose2(expected + weight * (true + match_off - expected), 0, 0)
        error.add_match(step, pose.inverse() @ matched, INFORMATION, dt)
        pose = matched
        if k >= SECONDS * hz // 4:
            sigmas.append(prior.sigma / config.trust / dt)
            offs.append(pose.x - true)
    return float(np.median(sigmas)), float(np.sqrt(np.mean(np.square(offs))))


@pytest.mark.parametrize("hz", [5, 10, 20, 50])
@pytest.mark.parametrize("match_time", [1e-6, MATCH_TIME], ids=["independent", "alike"])
def test_the_sigma_of_odometry_is_its_error_at_any_scan_rate(hz, match_time):
    """The fault: at 50 Hz the errors of matches raised the sigma, which gave the next match more freedom."""
    sigma, _ = np.median([sigma_and_error(seed, hz, MATCH, match_time) for seed in range(N_SEEDS)], axis=0)
    assert SLIP < sigma < 2 * SLIP
    sigma, off = np.median([sigma_and_error(seed, hz, 2 * MATCH, match_time) for seed in range(N_SEEDS)], axis=0)
    assert sigma < 3.6 * SLIP, "matches with twice the error of their covariance, as among thin posts"
    assert off < 2 * MATCH, "m: not worse than the matches alone"


@pytest.mark.parametrize("seconds", [1e-9, 0.0009, 0.0012])
def test_a_step_with_an_impossible_stamp_has_the_sigma_of_a_whole_one(seconds):
    """30 % of the scans of the log intel are stamped 1 ms after the one before, 5 cm farther on."""
    config, error, step = RegistrationConfig(), OdometryError(), Pose2(0.055, 0, 0.01)
    whole = error.prior(config, Pose2(), step, seconds=0.1)
    burst = error.prior(config, Pose2(), step, seconds=seconds)
    assert (burst.sigma, burst.sigma_turn) == (whole.sigma, whole.sigma_turn)
    assert error.prior(config, Pose2(), step, seconds=0.02).sigma < whole.sigma


def test_errors_that_prove_to_be_those_of_matches_are_forgotten():
    """Some matches among plants were wrong before they were doubted, and odometry was taken for bad."""
    config, error, step = RegistrationConfig(), OdometryError(), Pose2(0.2, 0.0, 0.0)
    rng = np.random.default_rng(2)

    def drive(sigma: float, n: int) -> float:
        """The sigma after n steps by odometry that errs this much, m and a fifth of it in rad."""
        for off, side, turn in rng.normal(0, sigma, (n, 3)):
            error.add_match(Pose2(0.2 + off, side, turn / 5), step, INFORMATION, 0.6)
        return error.prior(config, Pose2(), step).sigma

    before, after = drive(0.02, 300), drive(0.2, 10)
    assert after > 2 * before
    error.add_match(step, step, INFORMATION / 100, 0.6)
    assert drive(0.0, 0) == after, "a corridor, or a scan with few beams"
    error.match_error.doubt()
    error.add_match(step, step, INFORMATION / 100, 0.6)
    assert drive(0.0, 0) < 1.5 * before
