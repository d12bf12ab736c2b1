# SPDX-License-Identifier: Apache-2.0
from math import pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared.config import UserError
from zenav.calibrate.hand_eye import closed_form, intervals, predicted_motion, residuals, solve, uncertain_values
from zenav.calibrate.rolling import WheelGeometry, WheelTravel, composed_poses, relative_poses
from zenav.calibrate.scan_track import ScanTrack

BELIEVED, MOUNT = WheelGeometry(0.085, 0.085, 0.283), np.array((0.13, 0.0, -pi / 2))
TRUE, PLACE = WheelGeometry(0.084, 0.0862, 0.291), np.array((0.11, 0.025, -1.5))
SIGMAS = np.array((0.003, 0.003, 0.0015))
DT = 0.02  # s between wheel states; a scan is every fifth


def driven(legs, wheels=TRUE, mount=PLACE, noise=0.0, slip=0.0, seed=0):
    """Wheels and scans of a robot that drives legs (seconds, m/s, rad/s), turned into angles by its true wheels."""
    rng = np.random.default_rng(seed)
    v = np.concatenate([np.full(round(s / DT), v) for s, v, _ in legs])
    w = np.concatenate([np.full(round(s / DT), w) for s, _, w in legs])
    ways = np.column_stack((v - w * wheels.distance / 2, v + w * wheels.distance / 2)) * DT
    angles = ways / (wheels.left_radius, wheels.right_radius)
    really = ways + rng.normal(size=ways.shape) * np.sqrt(slip * np.abs(ways))
    stamps = np.arange(len(ways) + 1) * round(DT * 1e9)
    rolled = WheelTravel(stamps, *(np.concatenate(([0], np.cumsum(a))) for a in angles.T), np.zeros(len(stamps), bool))
    moved = WheelTravel(
        stamps, *(np.concatenate(([0], np.cumsum(a))) for a in (really / wheels[:2]).T), np.zeros(len(stamps), bool)
    )
    laser = composed_poses(moved.poses(wheels), mount)[::5]
    laser = relative_poses(np.broadcast_to(laser[0], laser.shape), laser) + noise * SIGMAS * rng.normal(
        size=laser.shape
    )
    return rolled, ScanTrack(stamps[::5], laser, np.ones(len(laser), bool))


MIXED = [(4, 0.3, 0.0), (2, 0.0, 1.0), (3, 0.3, 0.3), (2, 0.0, -1.0), (4, 0.25, 0.0), (3, 0.2, -0.5), (3, 0.0, 1.2)] * 4


def wheels_near(solution, wheels, rel):
    assert tuple(solution.wheels) == pytest.approx(tuple(wheels), rel=rel)


wheels = st.builds(WheelGeometry, st.floats(0.08, 0.09), st.floats(0.08, 0.09), st.floats(0.26, 0.31))
mounts = st.tuples(st.floats(-0.2, 0.2), st.floats(-0.1, 0.1), st.floats(-pi, pi)).map(np.array)


@given(wheels, mounts)
@settings(max_examples=20)
def test_without_noise_the_closed_form_is_exact(wheels, mount):
    rolled, track = driven(MIXED, wheels, mount)
    found = closed_form(intervals(rolled, track))
    assert found is not None
    assert tuple(found[0]) == pytest.approx(tuple(wheels), rel=1e-6)
    np.testing.assert_allclose(found[1][:2], mount[:2], atol=1e-6)
    assert np.cos(found[1][2] - mount[2]) == pytest.approx(1, abs=1e-9)


@given(wheels, mounts)
@settings(max_examples=5)
def test_wheels_and_any_mount_are_found_from_what_is_believed(wheels, mount):
    rolled, track = driven(MIXED, wheels, mount)
    found = solve(intervals(rolled, track), BELIEVED, MOUNT)
    wheels_near(found, wheels, 1e-4)
    np.testing.assert_allclose(found.mount[:2], mount[:2], atol=1e-4)
    assert np.cos(found.mount[2] - mount[2]) == pytest.approx(1, abs=1e-7)


def test_errors_under_noise_and_slip_are_as_large_as_the_standard_deviations_say():
    off = []
    for seed in range(12):
        rolled, track = driven(MIXED, noise=1.0, slip=2e-5, seed=seed)
        found = solve(intervals(rolled, track), BELIEVED, MOUNT)
        values = np.array((*found.wheels, *found.mount)) - np.array((*TRUE, *PLACE))
        off.append(values / found.sigmas)
        assert (found.wheels.ratio - TRUE.ratio) / found.sigma_ratio == pytest.approx(0, abs=4)
        assert (found.wheels.radius - TRUE.radius) / found.sigma_radius == pytest.approx(0, abs=4)
        assert found.slip == pytest.approx(2e-5, rel=0.6)
        assert not uncertain_values(found)
    rms = np.sqrt(np.mean(np.square(off), axis=0))
    assert np.all((rms > 0.3) & (rms < 1.7)), rms


def test_a_few_pieces_of_nonsense_do_not_spoil_the_rest():
    rolled, track = driven(MIXED, noise=1.0)
    for i, jump in ((200, (0.5, 0.0, 0.0)), (400, (0.0, -0.2, 0.3)), (500, (0.0, 0.0, 3.0))):
        track.poses[i:] = composed_poses(np.broadcast_to(jump, track.poses[i:].shape), track.poses[i:])
    found = solve(intervals(rolled, track), BELIEVED, MOUNT)
    wheels_near(found, TRUE, 0.004)
    np.testing.assert_allclose(found.mount, PLACE, atol=0.004)


def test_no_other_wheels_and_mount_fit_better_than_what_is_found():
    rolled, track = driven(MIXED, noise=1.0)
    pieces = intervals(rolled, track)
    found = solve(pieces, BELIEVED, MOUNT)
    best = np.mean(found.residuals[:, :2] ** 2)
    assert best < np.mean(residuals(pieces, BELIEVED, MOUNT)[:, :2] ** 2)
    assert best < 1.05 * np.mean(residuals(pieces, TRUE, PLACE)[:, :2] ** 2)


def test_what_is_predicted_is_what_the_laser_does():
    rolled, track = driven(MIXED)
    pieces = intervals(rolled, track)
    np.testing.assert_allclose(predicted_motion(pieces, TRUE, PLACE), pieces.laser, atol=1e-9)


@pytest.mark.parametrize(
    ("legs", "lacks"),
    [
        ([(30, 0.3, 0.0)], "turns by 0 degrees"),
        ([(20, 0.0, 1.0), (20, 0.0, -1.0)], "straight on for 0.0 m"),
        ([(3, 0.0, 3.0), (5, 0.3, 0.0)], r"straight on for 1\.[0-9] m"),
    ],
)
def test_a_drive_that_lacks_something_is_refused_with_what_it_lacks(legs, lacks):
    with pytest.raises(UserError, match=lacks) as refused:
        intervals(*driven(legs))
    assert "record again" in refused.value.hint


def test_one_arc_for_ever_tells_nothing():
    with pytest.raises(UserError, match="every piece of it moves alike"):
        solve(intervals(*driven([(120, 0.3, 0.2)])), BELIEVED, MOUNT)


def test_wheels_that_count_backwards_are_named():
    rolled, track = driven(MIXED)
    turned = rolled._replace(left=-rolled.left)
    with pytest.raises(UserError, match="the left wheel counts backwards"):
        solve(intervals(turned, track), BELIEVED, MOUNT)


def test_pieces_where_the_scans_or_the_wheels_are_unknown_do_not_count():
    rolled, track = driven(MIXED)
    track.good[100:200] = False
    track.poses[100:200] = 7.0
    broken = rolled.broken.copy()
    broken[2000] = True
    pieces = intervals(rolled._replace(broken=broken), track)
    np.testing.assert_allclose(predicted_motion(pieces, TRUE, PLACE), pieces.laser, atol=1e-9)
    begin, end = pieces.path.stamps[pieces.begin], pieces.path.stamps[pieces.end]
    assert not np.any((begin < rolled.stamps[2000]) & (end >= rolled.stamps[2000]))
