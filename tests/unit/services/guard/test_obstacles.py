# SPDX-License-Identifier: Apache-2.0
from math import inf, nan, pi

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.guard.obstacles import Obstacles, ObstaclesConfig, is_in_sweep, is_supported
from shared.config import load_robot
from shared.geometry import Pose2
from shared.messages import LaserScan, Odometry, RangeReadings
from shared.odometry_buffer import OdometryBuffer

X80, JACKAL = (load_robot(name).robot for name in ("x80sv_xv11", "jackal"))  # a beam each degree, 0.06 to 5 m
MS = 1_000_000
REACH = 2.0


def odometry(ms, x=0.0, y=0.0, yaw=0.0):
    return Odometry(ms * MS, Pose2(x, y, yaw), 0.0, 0.0, np.zeros(9))


def tracked(robot, *odometries):
    track = OdometryBuffer(robot.drive)
    for message in odometries:
        track.add(message)
    return track


def scan(robot, ms, echoes, scan_time=0.0, range_min=None):
    """A sweep of the robot's laser in which beam i measures echoes[i], everything else nothing."""
    laser = robot.laser
    ranges = np.full(laser.n_beams, nan, np.float32)
    for beam, value in echoes.items():
        ranges[beam % laser.n_beams] = value
    least = laser.range_min if range_min is None else range_min
    return LaserScan(ms * MS, laser.angle_min, laser.angle_increment, scan_time, least, laser.range_max, ranges)


def beam_at(robot, bearing):
    """The beam that looks in a direction of base, for the X80SV's full turn."""
    laser = robot.laser
    return round((bearing - laser.mount.yaw - laser.angle_min) / laser.angle_increment) % laser.n_beams


AHEAD_HALF_WIDTH_RAD = beam_at(X80, 0.0)


DELIVERY = load_robot("delivery").robot


def laser_scan(laser, ms, points=()):
    """A sweep of a standing robot's laser at the origin that sees each point (n, 2) in `base` with three beams."""
    ranges = np.full(laser.n_beams, nan, np.float32)
    in_laser = Pose2(laser.mount.x, laser.mount.y, laser.mount.yaw).inverse() @ np.reshape(points, (-1, 2))
    for x, y in in_laser:
        beam = round((np.arctan2(y, x) - laser.angle_min) / laser.angle_increment)
        for i in range(beam - 1, beam + 2):
            if 0 <= i < laser.n_beams:
                ranges[i] = np.hypot(x, y)
    sweep = laser.angle_min, laser.angle_increment, 0.0, laser.range_min, laser.range_max
    return LaserScan(ms * MS, *sweep, ranges)


def sees(laser, point):
    """Whether a point in `base` lies in a laser's sweep."""
    x, y = (Pose2(laser.mount.x, laser.mount.y, laser.mount.yaw).inverse() @ np.array([point]))[0]
    return abs(np.arctan2(y, x)) <= abs(laser.angle_min) - 0.02


@pytest.mark.parametrize("seed", range(8))
def test_the_points_of_two_lasers_are_those_that_either_one_sees(seed):
    rng = np.random.default_rng(seed)
    angles, reach = 2 * pi * np.arange(12) / 12 + rng.uniform(0, 0.2, 12), rng.uniform(0.9, 1.3, 12)
    points = np.column_stack((reach * np.cos(angles), reach * np.sin(angles)))
    track, obstacles = tracked(DELIVERY, odometry(0)), Obstacles(ObstaclesConfig(), DELIVERY, 2.0)
    for laser in DELIVERY.lasers:
        obstacles.add_scan(laser_scan(laser, 0, points), track, laser=laser)
    kept = obstacles.points(track.odom_from_base, 0)
    for point in points:
        if any(sees(laser, point) for laser in DELIVERY.lasers):
            assert np.hypot(*(kept - point).T).min() < 0.05
    assert all(np.hypot(*(points - point).T).min() < 0.05 for point in kept)


def test_a_remembered_point_is_dropped_by_the_laser_that_looks_there_and_kept_by_the_other_one():
    front, rear = DELIVERY.lasers
    ahead, both = np.array([[1.2, 0.0]]), np.array([[-0.9, 0.9]])
    assert [sees(laser, ahead[0]) for laser in (front, rear)] == [True, False]
    assert [sees(laser, both[0]) for laser in (front, rear)] == [True, True]
    track, obstacles = tracked(DELIVERY, odometry(0)), Obstacles(ObstaclesConfig(), DELIVERY, 2.0)
    obstacles.add_scan(laser_scan(front, 0, np.concatenate([ahead, both])), track, laser=front)
    obstacles.add_scan(laser_scan(rear, 50), track, laser=rear)
    assert len(obstacles.points(track.odom_from_base, 0)) == 6  # the front laser's newest scan counts
    obstacles.add_scan(laser_scan(front, 100), track, laser=front)
    assert not len(obstacles.points(track.odom_from_base, 0))


def seen(obstacles, track, now_ms=0):
    points = obstacles.points(track.odom_from_base, now_ms * MS)
    return points[np.lexsort(points.T)]


def readings(robot, ms, echoes):
    columns = [[s.mount.x, s.mount.y, s.mount.yaw, s.field_of_view] for s in robot.ranges]
    ranges = [echoes.get(i, nan) for i in range(len(columns))]
    return RangeReadings(ms * MS, *np.array(columns, np.float32).T.copy(), np.array(ranges, np.float32))


def test_echoes_lie_where_the_mounted_laser_measured_them():
    obstacles, track = Obstacles(ObstaclesConfig(), X80, REACH), tracked(X80, odometry(0, 3.0, 1.0, 0.5))
    obstacles.add_scan(scan(X80, 0, {AHEAD_HALF_WIDTH_RAD: 1.0, AHEAD_HALF_WIDTH_RAD + 1: 1.0}), track)
    points = obstacles.points(track.odom_from_base, 0)
    step = X80.laser.angle_increment
    np.testing.assert_allclose(points, [[1.13, 0.0], [0.13 + np.cos(step), np.sin(step)]], atol=1e-6)


def test_a_cover_over_the_laser_is_the_robot_and_leaves_nothing_behind():
    obstacles, track = Obstacles(ObstaclesConfig(min_points=1), X80, REACH), tracked(X80, odometry(0))
    cover = {AHEAD_HALF_WIDTH_RAD + k: 0.065 for k in range(-40, 41)}
    obstacles.add_scan(scan(X80, 0, cover | {AHEAD_HALF_WIDTH_RAD + 100: 0.5}), track, covered=True)
    assert len(seen(obstacles, track)) == 1, "what lies outside the outline counts under a cover too"
    obstacles.add_scan(scan(X80, 100, {}), track)
    assert len(seen(obstacles, track)) == 0
    obstacles.add_scan(scan(X80, 200, cover), track)
    assert len(seen(obstacles, track)) > 0, "without a cover a return from there is a contact"


def test_beams_are_put_where_the_robot_was_when_each_was_taken():
    obstacles = Obstacles(ObstaclesConfig(min_points=1), X80, REACH)
    track = tracked(X80, *(odometry(20 * k, 0.01 * k) for k in range(11)))  # 0.5 m/s for 0.2 s
    last = X80.laser.n_beams - 1
    obstacles.add_scan(scan(X80, 0, {0: 1.0, last: 1.0}, scan_time=0.2), track)
    points = obstacles.points(Pose2(), 0)
    # beam 0 looks to the right (the laser is turned by -90 degrees) from x = 0.13, the last from 0.1 m farther on
    np.testing.assert_allclose(points[0], [0.13, -1.0], atol=1e-6)
    angle = -pi / 2 + last * X80.laser.angle_increment
    np.testing.assert_allclose(points[1], [0.23 + np.cos(angle), np.sin(angle)], atol=1e-6)


def test_points_move_with_the_robot_after_the_scan():
    obstacles, track = Obstacles(ObstaclesConfig(), X80, REACH), tracked(X80, odometry(0))
    obstacles.add_scan(scan(X80, 0, {AHEAD_HALF_WIDTH_RAD: 1.0, AHEAD_HALF_WIDTH_RAD + 1: 1.0}), track)
    np.testing.assert_allclose(obstacles.points(Pose2(0.2, 0, 0), 0)[0], [0.93, 0.0], atol=1e-6)


@pytest.mark.parametrize("value", [nan, 0.0, 0.059, 5.1, 100.0, 2.5])
def test_what_is_no_measurement_or_far_is_no_point(value):
    obstacles, track = Obstacles(ObstaclesConfig(), X80, REACH), tracked(X80, odometry(0))
    obstacles.add_scan(scan(X80, 0, {AHEAD_HALF_WIDTH_RAD: value, AHEAD_HALF_WIDTH_RAD + 1: value}), track)
    assert len(seen(obstacles, track)) == 0


# --- noise ----------------------------------------------------------------------------------------------------------


def test_a_lone_beam_is_noise_and_two_neighbours_are_not():
    obstacles, track = Obstacles(ObstaclesConfig(), X80, REACH), tracked(X80, odometry(0))
    obstacles.add_scan(scan(X80, 0, {AHEAD_HALF_WIDTH_RAD: 0.5, 100: 0.7}), track)
    assert len(seen(obstacles, track)) == 0
    obstacles.add_scan(scan(X80, 100, {AHEAD_HALF_WIDTH_RAD: 0.5, AHEAD_HALF_WIDTH_RAD + 2: 0.52, 100: 1.4}), track)
    assert len(seen(obstacles, track)) == 2


def test_a_thin_leg_that_each_scan_hits_once_is_an_obstacle():
    obstacles, track = Obstacles(ObstaclesConfig(), X80, REACH), tracked(X80, odometry(0))
    obstacles.add_scan(scan(X80, 0, {AHEAD_HALF_WIDTH_RAD: 0.8}), track)
    track.add(odometry(200, 0.1))
    obstacles.add_scan(scan(X80, 200, {AHEAD_HALF_WIDTH_RAD: 0.7}), track)
    np.testing.assert_allclose(seen(obstacles, track), [[0.83, 0.0]], atol=1e-6)


def test_neighbours_across_a_full_turn_s_seam_support_each_other():
    obstacles, track = Obstacles(ObstaclesConfig(), X80, REACH), tracked(X80, odometry(0))
    obstacles.add_scan(scan(X80, 0, {0: 0.5, -1: 0.5}), track)
    assert len(seen(obstacles, track)) == 2


ends = st.lists(st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)) | st.just((nan, nan)), min_size=2, max_size=12)


@given(ends, st.lists(st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3)), max_size=5), st.integers(1, 4))
def test_support_is_the_brute_force_count(points, before, least):
    points, before = np.array(points), np.array(before).reshape(-1, 2)
    n = len(points)

    def near(a, b):
        return np.hypot(*(a - b)) <= 0.1

    neighbours = [
        1
        + sum(
            near(points[i], points[(i + way * shift) % n])
            for shift in range(1, min(least, n // 2) + 1)
            for way in (-1, 1)
        )
        for i in range(n)
    ]
    expected = [
        not np.isnan(points[i, 0])
        and (neighbours[i] >= least or neighbours[i] + sum(near(points[i], b) for b in before) >= least)
        for i in range(n)
    ]
    assert is_supported(points, before, np.full(n, 0.1), least).tolist() == expected


# --- memory ---------------------------------------------------------------------------------------------------------


def test_what_leaves_the_field_of_view_is_remembered_for_a_while():
    """A Jackal's laser does not look behind it."""
    obstacles = Obstacles(ObstaclesConfig(memory=5.0), JACKAL, REACH)
    track = tracked(JACKAL, odometry(0))
    side = round((2.0 - JACKAL.laser.angle_min) / JACKAL.laser.angle_increment)
    wall = {side + k: 0.8 for k in range(3)}
    obstacles.add_scan(scan(JACKAL, 0, wall), track)
    assert len(seen(obstacles, track)) == 3
    track.add(odometry(100, yaw=-0.5))
    obstacles.add_scan(scan(JACKAL, 100, {}), track)
    assert len(seen(obstacles, track)) == 3, "turned away from it: it is still there"
    obstacles.add_scan(scan(JACKAL, 5200, {}), track)
    assert len(seen(obstacles, track)) == 0, "but not for ever"


def test_what_the_laser_looks_at_and_does_not_see_is_gone():
    obstacles, track = Obstacles(ObstaclesConfig(), X80, REACH), tracked(X80, odometry(0))
    obstacles.add_scan(scan(X80, 0, {AHEAD_HALF_WIDTH_RAD: 0.5, AHEAD_HALF_WIDTH_RAD + 1: 0.5}), track)
    obstacles.add_scan(scan(X80, 200, {}), track)
    assert len(seen(obstacles, track)) == 0


def test_what_is_too_near_to_be_measured_stays_as_long_as_the_robot_does():
    obstacles, track = Obstacles(ObstaclesConfig(), X80, REACH), tracked(X80, odometry(0))
    obstacles.add_scan(scan(X80, 0, {AHEAD_HALF_WIDTH_RAD: 0.35, AHEAD_HALF_WIDTH_RAD + 1: 0.35}, range_min=0.3), track)
    track.add(odometry(200, 0.1))
    for ms in range(200, 30_000, 200):
        obstacles.add_scan(scan(X80, ms, {AHEAD_HALF_WIDTH_RAD: 0.0}, range_min=0.3), track)
    points = seen(obstacles, track)
    assert len(points) == 2
    assert points[:, 0] == pytest.approx(0.38, abs=1e-3)
    track.add(odometry(30_000, 0.0))
    obstacles.add_scan(scan(X80, 30_000, {}, range_min=0.3), track)
    assert len(seen(obstacles, track)) == 0, "measurable again, and nothing there"


def test_memory_and_scans_are_bounded():
    rng = np.random.default_rng(1)
    obstacles, track = Obstacles(ObstaclesConfig(), JACKAL, REACH), tracked(JACKAL, odometry(0))
    for k in range(15):
        track.add(odometry(20 * k + 20, yaw=0.1 * k))
        ranges = rng.uniform(0.2, 1.9, 5000).astype(np.float32)
        sweep = LaserScan((20 * k + 20) * MS, -1.0, 2.0 / 5000, 0.0, 0.1, 30.0, ranges)
        obstacles.add_scan(sweep, track)
    assert len(obstacles.points(track.odom_from_base, 0)) <= 1440 + 500


def test_forgetting_drops_everything():
    obstacles, track = Obstacles(ObstaclesConfig(), X80, REACH), tracked(X80, odometry(0))
    obstacles.add_scan(scan(X80, 0, {AHEAD_HALF_WIDTH_RAD: 0.5, AHEAD_HALF_WIDTH_RAD + 1: 0.5}), track)
    obstacles.add_ranges(readings(X80, 0, {8: 0.3}), track)
    assert len(seen(obstacles, track)) == 4
    obstacles.clear()
    assert len(seen(obstacles, track)) == 0


@pytest.mark.parametrize(("first", "step", "n"), [(-2.0, 0.01, 401), (0.0, 2 * pi / 360, 360), (3.0, -0.01, 250)])
@given(st.floats(-2 * pi, 2 * pi))
def test_the_laser_looks_where_it_has_a_beam(first, step, n, bearing):
    sweep = LaserScan(0, first, step, 0.1, 0.1, 5.0, np.ones(n, np.float32))
    beams = first + step * np.arange(n)
    gap = np.abs((beams - bearing + pi) % (2 * pi) - pi).min()
    if abs(gap - abs(step) / 2) > 1e-6:
        assert is_in_sweep(sweep, np.array([bearing]))[0] == (gap < abs(step) / 2)


# --- range sensors --------------------------------------------------------------------------------------------------


def test_an_infrared_echo_is_a_narrow_arc_before_its_sensor():
    obstacles, track = Obstacles(ObstaclesConfig(), X80, REACH), tracked(X80, odometry(0, 1.0, 2.0, 1.0))
    obstacles.add_ranges(readings(X80, 0, {8: 0.3}), track)
    np.testing.assert_allclose(seen(obstacles, track), [[-0.4859, -0.0075], [-0.4859, 0.0075]], atol=1e-5)


def test_an_ultrasonic_echo_may_come_from_anywhere_on_its_arc():
    obstacles, track = Obstacles(ObstaclesConfig(), X80, REACH), tracked(X80, odometry(0))
    obstacles.add_ranges(readings(X80, 0, {1: 0.6}), track)
    points = seen(obstacles, track) - [0.1915, 0.0]
    np.testing.assert_allclose(np.hypot(*points.T), 0.6, atol=1e-6)
    bearings = np.sort(np.arctan2(points[:, 1], points[:, 0]))
    assert (bearings[0], bearings[-1]) == pytest.approx((-0.2618, 0.2618), abs=1e-4)
    assert np.diff(bearings).max() * 0.6 <= 0.1


def test_an_echo_that_the_laser_sees_too_is_left_to_the_laser():
    obstacles, track = Obstacles(ObstaclesConfig(), X80, REACH), tracked(X80, odometry(0))
    obstacles.add_scan(scan(X80, 0, {AHEAD_HALF_WIDTH_RAD + k: 0.66 for k in range(2)}), track)  # 0.79 m ahead
    obstacles.add_ranges(readings(X80, 0, {1: 0.6}), track)  # 0.7915 m ahead
    assert len(seen(obstacles, track)) == 2
    obstacles.add_ranges(readings(X80, 50, {1: 0.4}), track)  # glass, or something low, before it
    assert len(seen(obstacles, track)) > 2


def test_an_echo_goes_when_its_sensor_no_longer_hears_it():
    obstacles, track = Obstacles(ObstaclesConfig(), X80, REACH), tracked(X80, odometry(0))
    obstacles.add_ranges(readings(X80, 0, {4: 0.3}), track)
    assert len(seen(obstacles, track)) == 2
    obstacles.add_ranges(readings(X80, 100, {}), track)
    assert len(seen(obstacles, track)) == 0


def test_an_echo_that_came_too_near_for_its_sensor_stays():
    obstacles, track = Obstacles(ObstaclesConfig(), X80, REACH), tracked(X80, odometry(0))
    obstacles.add_ranges(readings(X80, 0, {4: 0.12}), track)
    track.add(odometry(100, 0.05))
    for ms in range(100, 9000, 100):
        obstacles.add_ranges(readings(X80, ms, {}), track)
    assert len(seen(obstacles, track, 9000)) == 2
    track.add(odometry(9000, -0.2))
    obstacles.add_ranges(readings(X80, 9000, {}), track)
    assert len(seen(obstacles, track, 9000)) == 0


def test_echoes_of_silent_sensors_are_forgotten_in_time():
    obstacles, track = Obstacles(ObstaclesConfig(memory=5.0), X80, REACH), tracked(X80, odometry(0))
    obstacles.add_ranges(readings(X80, 0, {4: 0.3}), track)
    assert len(seen(obstacles, track, 5000)) == 2
    assert len(seen(obstacles, track, 5001)) == 0


# --- track ----------------------------------------------------------------------------------------------------------


def test_the_track_interpolates_across_the_turn_of_pi():
    track = tracked(X80, odometry(0, yaw=3.1), odometry(100, yaw=-3.1))
    x, y, yaw = track.poses(np.array([0.05]), 0)[0]
    assert (x, y, yaw % (2 * pi)) == pytest.approx((0, 0, pi), abs=1e-9)


def test_beyond_its_ends_the_track_stands():
    track = tracked(X80, odometry(100, 1.0), odometry(120, 1.01))
    np.testing.assert_allclose(track.poses(np.array([-1.0, 9.0]), 0)[:, 0], [1.0, 1.01])


@pytest.mark.parametrize(
    ("after", "continues"),
    [
        (odometry(20, 0.02), True),
        (odometry(20, 0.14), False),  # 2 * 0.8 m/s * 0.02 s + 0.1 m
        (odometry(20, yaw=0.25), True),
        (odometry(20, yaw=0.3), False),
        (odometry(-20, 0.0), False),
        (odometry(5000, 3.0), True),
    ],
)
def test_odometry_that_jumped_begins_a_new_track(after, continues):
    track = OdometryBuffer(X80.drive)
    assert track.add(odometry(0))
    assert track.add(after) is continues
    assert track.odom_from_base == after.odom_from_base
    if not continues:
        np.testing.assert_allclose(
            track.poses(np.array([-inf]), 0)[0], [after.odom_from_base.x, 0, track.odom_from_base.yaw]
        )
