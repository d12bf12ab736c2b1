# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from zenav.slam.odometry_lag import odometry_lag


def heading(t):
    return 1.3 * np.sin(0.7 * t) + 0.6 * np.sin(1.9 * t + 1.0) + 0.1 * t


def tables(lag, rate=20.0, noise=0.0, scans=5.0):
    """Odometry that gives at t + lag the pose of t, and the true poses of the scans."""
    t = np.arange(0, 60, 1 / rate)
    at = np.arange(0.03, 60, 1 / scans)
    rng = np.random.default_rng(1)
    return (
        np.column_stack((t, heading(t - lag) + noise * rng.normal(size=len(t)).cumsum())),
        np.column_stack((at, heading(at) + 0.002 * rng.normal(size=len(at)))),
    )


@given(lag=st.floats(-0.8, 0.8))
def test_a_lag_is_found_whichever_way(lag):
    assert odometry_lag(*tables(lag)) == pytest.approx(lag, abs=0.02)


def test_odometry_that_turns_too_far_and_drifts_hides_nothing():
    odometry, placed = tables(0.3, noise=0.002)
    odometry[:, 1] *= 1.1
    assert odometry_lag(odometry, placed) == pytest.approx(0.3, abs=0.03)


def test_headings_may_wrap():
    odometry, placed = tables(0.2)
    odometry[:, 1], placed[:, 1] = ((table[:, 1] + 2.5 + np.pi) % (2 * np.pi) - np.pi for table in (odometry, placed))
    assert odometry_lag(odometry, placed) == pytest.approx(0.2, abs=0.02)


def test_without_turns_or_scans_nothing_is_told():
    odometry, placed = tables(0.2)
    still = placed * (1, 0)
    assert odometry_lag(odometry * (1, 0), still) is None
    assert odometry_lag(odometry, placed[:5]) is None
    assert odometry_lag(np.zeros((0, 2)), placed) is None


def test_a_lag_beyond_what_is_looked_for_is_not_told_wrongly():
    found = odometry_lag(*tables(1.5))
    assert found is None or abs(found) > 0.8
