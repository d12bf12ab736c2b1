# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from math import hypot, pi

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from services.mapper.front_end.deskew import remove_twist
from services.mapper.front_end.odometry_error import OdometryError, ScaleEstimate
from services.mapper.front_end.registration import Prior, RegistrationConfig
from services.mapper.front_end.submap import REGISTRARS
from services.mapper.front_end.surface_normals import sweep_normals
from shared.geometry import Pose2, wrapped
from tests.unit.services.mapper.rooms import CORRIDOR, ROOM, sweep

START = Pose2()
WEAK = {"sigma": 1.0, "sigma_turn": 1.0}


def points_at(segments, pose, **arguments):
    origins, ends = sweep(segments, pose, **arguments)
    normals = sweep_normals(origins, ends)
    seen = ~np.isnan(ends[:, 0])
    return ends[seen], normals[seen]


def mapped(segments, kind="line", poses=(START,)):
    registrar = REGISTRARS[kind](RegistrationConfig(), 8.0)
    for pose in poses:
        points, normals = points_at(segments, pose)
        registrar.add_points(pose @ points, Pose2(0, 0, pose.yaw) @ normals)
    return registrar


@pytest.fixture(scope="module")
def room():
    return mapped(ROOM, poses=(Pose2(), Pose2(1, 0, 0), Pose2(-1, 1, 0), Pose2(0, -1, 0)))


@settings(max_examples=60)
@given(st.floats(-0.25, 0.25), st.floats(-0.25, 0.25), st.floats(-0.25, 0.25), st.integers(0, 1000))
def test_a_known_motion_is_recovered(room, x, y, yaw, seed):
    points, normals = points_at(ROOM, Pose2(x, y, yaw), noise=0.01, seed=seed)
    match = room.register(points, normals, Pose2(), Prior(Pose2(), **WEAK))
    assert hypot(match.map_from_base.x - x, match.map_from_base.y - y) < 0.02
    assert abs(wrapped(match.map_from_base.yaw - yaw)) < 0.01
    assert match.inlier_ratio > 0.9


@settings(max_examples=40)
@given(st.floats(-0.05, 0.05), st.floats(-0.1, 0.1), st.integers(0, 1000))
def test_the_twist_that_odometry_missed_is_estimated_from_the_shape_of_the_sweep(room, twist, yaw, seed):
    """De-skewed as if the robot had turned by `twist` rad less during the sweep: its first beams are off the most."""
    origins, ends = sweep(ROOM, Pose2(0.1, -0.05, yaw), noise=0.01, seed=seed)
    back = np.linspace(1, 0, len(ends))
    (ends,) = remove_twist(back, -twist, ends)
    normals = sweep_normals(origins, ends)
    seen = ~np.isnan(ends[:, 0])
    prior = Prior(Pose2(0.1, -0.05, yaw - twist), 0.05, 0.1, skew=1.0)
    straight = room.register(ends[seen], normals[seen], prior.map_from_base, prior, back[seen])
    bent = room.register(ends[seen], normals[seen], prior.map_from_base, prior)
    assert abs(straight.twist - twist) < 0.008
    assert abs(wrapped(straight.map_from_base.yaw - yaw)) < 0.008
    if abs(twist) > 0.02:
        assert abs(wrapped(bent.map_from_base.yaw - yaw)) > 2 * abs(wrapped(straight.map_from_base.yaw - yaw))
    assert bent.twist == 0


def test_people_in_the_room_do_not_move_the_pose(room):
    points, normals = points_at(ROOM, Pose2(0.1, 0.05, 0.05), noise=0.01)
    points, normals = points.copy(), normals.copy()
    points[60:90] *= 0.5  # somebody stands in a twelfth of the beams
    normals[60:90] = 0
    match = room.register(points, normals, Pose2(), Prior(Pose2(), **WEAK))
    assert match.map_from_base.distance(Pose2(0.1, 0.05, 0)) < 0.03
    assert not match.inliers[62:88].any()


def test_in_a_corridor_the_prior_decides_along_and_the_beams_across():
    registrar = mapped(CORRIDOR)
    points, normals = points_at(CORRIDOR, Pose2(0.3, 0.05, 0.02), noise=0.01)
    prior = Prior(Pose2(0.3, 0.0, 0.0), 0.03, 0.02)
    match = registrar.register(points, normals, prior.map_from_base, prior)
    assert abs(match.map_from_base.x - 0.3) < 0.03
    assert abs(match.map_from_base.y - 0.05) < 0.01
    assert abs(match.map_from_base.yaw - 0.02) < 0.01


def test_a_handful_of_beams_does_not_move_the_robot_along_a_corridor_that_all_others_leave_open():
    registrar = mapped(CORRIDOR)
    registrar.add_points(np.column_stack((np.full(5, 3.0), np.linspace(-0.4, 0.4, 5))), np.zeros((5, 2)))
    points, normals = points_at(CORRIDOR, Pose2(), noise=0.01)
    others = np.column_stack((np.full(5, 2.8), np.linspace(-0.4, 0.4, 5)))  # bags, carried 0.2 m
    points, normals = np.concatenate((points, others)), np.concatenate((normals, np.zeros((5, 2))))
    match = registrar.register(points, normals, Pose2(), Prior(Pose2(), 0.03, 0.02))
    assert abs(match.map_from_base.x) < 0.03
    assert match.information[0, 0] < 200  # 0.07 m
    wide = registrar.register(points, normals, Pose2(), Prior(Pose2(), 1.0, 0.5))
    assert wide.map_from_base.x > 0.12, "where nothing else is known they are what there is"


def test_the_information_shows_the_direction_that_a_corridor_hides():
    points, normals = points_at(CORRIDOR, Pose2(), noise=0.01)
    along, across = np.sort(np.linalg.eigvalsh(mapped(CORRIDOR).evaluate(points, normals, Pose2()).information[:2, :2]))
    assert across > 50 * along
    room_points = points_at(ROOM, Pose2())
    low, high = np.linalg.eigvalsh(mapped(ROOM).evaluate(*room_points, Pose2()).information[:2, :2])
    assert high < 5 * low


def test_no_points_leave_the_pose_to_the_prior(room):
    prior = Prior(Pose2(0.4, 0.1, 0.2), 0.1, 0.1)
    match = room.register(np.zeros((0, 2)), np.zeros((0, 2)), prior.map_from_base, prior)
    assert match.map_from_base.distance(prior.map_from_base) < 1e-9
    assert match.inlier_ratio == 0


@pytest.mark.parametrize("kind", ["line", "kiss"])
def test_the_same_input_gives_the_same_bytes_twice(kind):
    def run():
        registrar = mapped(ROOM, kind)
        out = []
        for k in range(6):
            points, normals = points_at(ROOM, Pose2(0.03 * k, 0.01 * k, 0.02 * k), noise=0.01, seed=k)
            match = registrar.register(points, normals, Pose2(0.03 * k, 0, 0), Prior(Pose2(0.03 * k, 0, 0), 0.05, 0.05))
            out.append((match.map_from_base, match.information.tobytes(), match.inliers.tobytes()))
            registrar.add_points(match.map_from_base @ points, Pose2(0, 0, match.map_from_base.yaw) @ normals)
        return out

    first = run()
    assert first == run()
    assert first[-1][0].distance(Pose2(0.15, 0.05, 0)) < 0.05


def test_kiss_lets_the_prior_decide_along_a_corridor():
    registrar = mapped(CORRIDOR, "kiss")
    points, normals = points_at(CORRIDOR, Pose2(0.3, 0.05, 0.02), noise=0.01)
    prior = Prior(Pose2(0.3, 0.0, 0.0), 0.03, 0.02)
    match = registrar.register(points, normals, Pose2(0.15, 0.0, 0.0), prior)
    assert abs(match.map_from_base.x - 0.3) < 0.03
    assert abs(match.map_from_base.y - 0.05) < 0.02
    assert abs(match.map_from_base.yaw - 0.02) < 0.01


def test_kiss_believes_odometry_as_far_as_it_is_doubted():
    registrar = mapped(ROOM, "kiss")
    points, normals = points_at(ROOM, Pose2(), noise=0.01)
    off = Pose2(0.1, 0, 0)
    found = [registrar.register(points, normals, off, Prior(off, s, s)).map_from_base.x for s in (1e-4, 0.005, 0.5)]
    assert found[0] > 0.09
    assert found[0] > found[1] > found[2]
    assert abs(found[2]) < 0.03


@given(st.floats(-pi, pi), st.floats(0.01, 1.0), st.floats(0.001, 1.0), st.floats(0, 2), st.floats(0, 2))
def test_the_distance_from_a_prior_is_counted_in_its_deviations(yaw, sigma, sigma_turn, n_off, n_turn):
    prior = Prior(Pose2(3.0, -2.0, yaw), sigma, sigma_turn)
    pose = prior.map_from_base @ Pose2(0.6 * n_off * sigma, -0.8 * n_off * sigma, n_turn * sigma_turn)
    assert_allclose(prior.squared_sigmas(pose), n_off**2 + n_turn**2, rtol=1e-6, atol=1e-9)


def test_a_match_counts_as_little_as_it_is_doubted():
    registrar = mapped(ROOM)
    points, normals = points_at(ROOM, START @ Pose2(0.1, 0.0, 0.0))
    certain = Prior(START, 0.02, 0.01)
    doubted = replace(certain, match_variance=0.1**2, match_turn_variance=0.05**2)
    matches = [registrar.register(points, normals, START, prior) for prior in (certain, doubted)]
    offs = [START.distance(match.map_from_base) for match in matches]
    assert offs[0] > 0.08
    assert offs[1] < 0.02  # odometry's 2 cm against 10 cm
    sigmas = [np.sqrt(np.diag(np.linalg.inv(match.information))) for match in matches]
    assert (sigmas[0] < 0.02).all()
    assert (sigmas[1] >= (0.1, 0.1, 0.05)).all()


def test_kiss_searches_within_the_sigma_of_odometry():
    registrar = mapped(ROOM, "kiss")
    thresholds = [registrar.threshold(Prior(Pose2(), s, s / 10)) for s in (0.001, 0.1, 0.2, 10.0)]
    assert thresholds == sorted(thresholds)
    assert thresholds[1] < thresholds[2]
    assert thresholds[0] >= 0.1, "m, the spacing of the package's map"
    assert 3 * thresholds[-1] <= RegistrationConfig().gate


@pytest.mark.parametrize("kind", ["line", "kiss"])
@pytest.mark.parametrize("gate", [0.4, 0.6])
def test_a_wall_farther_off_than_the_gate_draws_no_scan(kind, gate):
    """All that the scan sees is one straight wall, which the map has 0.1 m within the gate, or beyond it."""
    wall = np.column_stack((np.full(60, 2.0), np.linspace(-3, 3, 60)))
    normals = np.tile((-1.0, 0.0), (60, 1))
    for off in (gate - 0.1, gate + 0.1):
        registrar = REGISTRARS[kind](RegistrationConfig(gate=gate, final_gate=gate), 8.0)
        registrar.add_points(wall + np.array((off, 0)), normals)
        moved = registrar.register(wall, normals, START, Prior(START, **WEAK)).map_from_base.x
        assert moved == pytest.approx(off if off < gate else 0.0, abs=0.05)


@pytest.mark.parametrize("kind", ["line", "kiss"])
def test_removed_points_are_matched_no_more(kind):
    """The points of a second, similar room 0.3 m beside the true one are removed."""
    registrar = mapped(ROOM, kind)
    n = registrar.map.n
    points, normals = points_at(ROOM, Pose2())
    registrar.add_points(points + np.array((0.3, 0.3)), normals)
    removed = np.arange(registrar.map.n) >= n
    at = Pose2(0.3, 0.3, 0)
    biased = registrar.register(points, normals, at, Prior(at, **WEAK)).map_from_base
    registrar.remove_points(removed)
    free = registrar.register(points, normals, at, Prior(at, **WEAK)).map_from_base
    assert biased.distance(at) < 0.1
    assert free.distance(Pose2()) < 0.05


@pytest.mark.parametrize("twist", [-0.05, 0.05])
def test_the_twist_of_kiss_is_the_sweeps_share_of_the_turn_that_odometry_missed(twist):
    registrar = mapped(ROOM, "kiss", (Pose2(), Pose2(1, 0, 0), Pose2(-1, 1, 0), Pose2(0, -1, 0)))
    origins, ends = sweep(ROOM, Pose2(0.1, -0.05, 0.05), noise=0.01)
    back = np.linspace(1, 0, len(ends))
    (ends,) = remove_twist(back, -twist, ends)
    normals = sweep_normals(origins, ends)
    seen = ~np.isnan(ends[:, 0])
    prior = Prior(Pose2(0.1, -0.05, 0.05 - twist), 0.05, 0.1, skew=1.0)
    straight = registrar.register(ends[seen], normals[seen], prior.map_from_base, prior, back[seen])
    bent = registrar.register(ends[seen], normals[seen], prior.map_from_base, prior)
    assert abs(straight.twist - twist) < 0.6 * abs(twist), "half of it shows in the turn of the whole sweep"
    assert abs(straight.map_from_base.yaw - 0.05) < 0.8 * abs(bent.map_from_base.yaw - 0.05)
    assert bent.twist == 0


def test_kiss_without_points_leaves_the_pose_to_the_prior():
    prior = Prior(Pose2(0.4, 0.1, 0.2), 0.1, 0.1)
    for registrar in (mapped(ROOM, "kiss"), mapped(ROOM, "kiss", ())):
        match = registrar.register(np.zeros((0, 2)), np.zeros((0, 2)), Pose2(), prior)
        assert match.map_from_base.distance(prior.map_from_base) < 1e-9


@given(st.floats(0.85, 1.15), st.integers(0, 1000))
def test_a_wrong_scale_is_learned_and_slips_are_not(gain, seed):
    rng = np.random.default_rng(seed)
    scale = ScaleEstimate(0.05)
    for _ in range(300):
        measured = rng.uniform(0.05, 0.3)
        scale.add(measured, -measured if rng.random() < 0.1 else gain * measured + 0.002 * rng.normal())
    assert abs(scale.value - gain) < 0.02


def test_a_scale_without_a_motion_is_one_and_uncertain():
    scale = ScaleEstimate(0.05)
    assert scale.value == 1.0
    sigma = scale.sigma
    for _ in range(100):
        scale.add(0.2, 0.21)
    assert scale.sigma < sigma / 5


def test_the_prior_is_wide_when_odometry_is_wrong_and_narrow_when_it_is_right():
    config, sure = RegistrationConfig(), np.eye(3) * 1e5
    step = Pose2(0.1, 0, 0)

    def sigma(off):
        error = OdometryError()
        for _ in range(60):
            error.add_match(step, Pose2(0.1 + off, 0, 0), sure)
        return error.prior(config, Pose2(), step).sigma

    assert sigma(0.0) < OdometryError().prior(config, Pose2(), step).sigma < sigma(0.2)


def test_a_match_in_a_corridor_changes_no_error_of_odometry():
    error = OdometryError()
    before = error.position.recent
    error.add_match(Pose2(0.1, 0, 0), Pose2(0.5, 0, 0), np.diag((1.0, 1e5, 1e5)))
    assert error.position.recent == before


def test_the_sigma_of_odometry_a_second_does_not_depend_on_the_scan_rate():
    config, sure = RegistrationConfig(), np.eye(3) * 1e5
    rng = np.random.default_rng(0)
    jitter = rng.normal(0, 0.004, (400, 3)) * (1, 1, 0.5)  # m, m, rad that each match is off, whatever the rate
    sigmas = {}
    for hz in (20, 50):
        error, at = OdometryError(), Pose2()
        for k, off in enumerate(jitter):
            true = Pose2(k / hz, 0, 0)
            matched = true @ Pose2(*off)
            error.add_match(Pose2(1 / hz, 0, 0), at.inverse() @ matched, sure, 1 / hz)
            at = matched
        prior = error.prior(config, Pose2(), Pose2(1 / hz, 0, 0), seconds=1 / hz)
        sigmas[hz] = hz * prior.sigma, hz * prior.sigma_turn
    assert sigmas[50] == pytest.approx(sigmas[20], rel=0.3)


@pytest.mark.parametrize("seconds", [1e-9, 0.02, 0.1, 2.0])
def test_the_sigma_of_a_step_is_positive_and_not_over_that_of_a_long_one(seconds):
    config, error = RegistrationConfig(), OdometryError()
    prior = error.prior(config, Pose2(), Pose2(), seconds=seconds)
    assert 0 < prior.sigma <= error.prior(config, Pose2(), Pose2()).sigma
    assert 0 < prior.sigma_turn <= error.prior(config, Pose2(), Pose2()).sigma_turn
