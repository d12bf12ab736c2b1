# SPDX-License-Identifier: Apache-2.0
from math import inf, pi

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from pydantic import ValidationError

from services.guard.protective_field import (
    TOUCHING_M,
    FieldConfig,
    distances_and_directions,
    safe_speed,
    times_to_contact,
)
from shared.config import load_robot
from shared.geometry import arc
from shared.polygon import contains, signed_distances

X80, JACKAL = (load_robot(name).robot for name in ("x80sv", "jackal"))
L_SHAPE = np.array([(-0.2, -0.3), (0.5, -0.3), (0.5, -0.1), (0.1, -0.1), (0.1, 0.2), (-0.2, 0.2)])
OUTLINES = {"octagon": X80.corners, "rectangle": JACKAL.corners, "l_shape": L_SHAPE}
FIELD = FieldConfig()
DRIVE = X80.drive

outlines = st.sampled_from(list(OUTLINES.values()))
speeds = st.sampled_from([0.0, 0.05, 0.3, 0.8, -0.3]) | st.floats(-0.3, 0.8)
turns = st.sampled_from([0.0, 0.5, -2.0, 1e-6]) | st.floats(-2, 2)
clouds = arrays(np.float64, st.tuples(st.integers(1, 8), st.just(2)), elements=st.floats(-1.2, 1.2))
near_clouds = arrays(np.float64, (6, 2), elements=st.floats(-0.5, 0.5))


def outside(points, corners):
    return points[signed_distances(corners, points) > 1e-3]


def distances_at(points, corners, v, w, times):
    """Signed distances (t, n) to the outline after each time (s) at (v, w)."""
    moved = [arc(v * t, w * t).inverse() @ points for t in times]
    return signed_distances(corners, np.concatenate(moved)).reshape(len(times), len(points))


def front(distance, corners=X80.corners, n=3):
    """A short wall straight ahead, `distance` m before the outline."""
    return np.column_stack((np.full(n, corners[:, 0].max() + distance), np.linspace(-0.05, 0.05, n)))


@given(clouds, outlines)
def test_distances_are_the_brute_force_minimum_over_the_outline(points, corners):
    edges = np.roll(corners, -1, axis=0) - corners
    outline = np.concatenate([corners + share * edges for share in np.linspace(0, 1, 2001)])
    brute = np.array([np.hypot(*(outline - point).T).min() for point in points])
    distance, outward = distances_and_directions(points, corners)
    np.testing.assert_allclose(np.abs(distance), brute, atol=1e-3)
    clear = np.abs(distance) > 1e-9
    assert np.array_equal(distance[clear] < 0, contains(corners, points)[clear])
    np.testing.assert_allclose(np.hypot(*outward.T), 1.0)
    # the way out ends on the outline
    np.testing.assert_allclose(signed_distances(corners, points - distance[:, None] * outward), 0, atol=1e-9)


@settings(max_examples=100, deadline=None)
@given(clouds, outlines, speeds, turns, st.sampled_from([0.0, 0.02, 0.1]))
def test_contact_is_where_small_steps_find_it(points, corners, v, w, margin):
    assume(abs(v) + abs(w) > 1e-3)
    points = outside(points, corners)
    times = times_to_contact(points, corners, v, w, margin, 0.03)
    start = signed_distances(corners, points)
    limits = np.clip(start - TOUCHING_M, 0.0, margin)
    judged = start > TOUCHING_M  # of what touches, the direction decides: its own test
    clock = np.arange(0, min(2 * pi / max(abs(w), 0.1), 1.5), 0.004 / (abs(v) + abs(w) * 0.6))
    gaps = distances_at(points, corners, v, w, clock)
    # before the contact nothing comes nearer than the limit, but for what a flat arc taken as a line leaves out
    early = (gaps < limits - 0.0005) & (clock[:, None] < times)
    assert not early[:, judged].any()
    met = np.flatnonzero(judged & np.isfinite(times))
    at_contact = [distances_at(points[[i]], corners, v, w, times[[i]])[0, 0] for i in met]
    np.testing.assert_allclose(at_contact, limits[met], atol=0.0005)


@settings(max_examples=150, deadline=None)
@given(clouds, outlines, speeds, turns)
def test_braking_from_the_permitted_speed_the_outline_reaches_no_point(points, corners, v, w):
    points = outside(points, corners)
    share = safe_speed(points, corners, v, w, DRIVE, FIELD).share
    assert 0 <= share <= 1
    if share == 0 or not len(points):
        return
    start = signed_distances(corners, points)
    creeps = share * abs(v) <= FIELD.creep_speed + 1e-9 and share * abs(w) <= FIELD.creep_turn_rate + 1e-9
    kept = np.minimum(start - TOUCHING_M, 0.0 if creeps else FIELD.side_margin)
    braking = share * max(abs(v) / DRIVE.max_braking, abs(w) / DRIVE.max_turn_acceleration)
    clock = np.linspace(0, FIELD.reaction + braking, 60)
    slowing = np.maximum(clock - FIELD.reaction, 0)
    lost = slowing**2 / (2 * braking) if braking > 0 else 0
    travelled = share * (np.minimum(clock, FIELD.reaction) + slowing - lost)
    assert np.all(distances_at(points, corners, v, w, travelled) >= np.maximum(kept, 0) - 1e-6)


@settings(max_examples=150, deadline=None)
@given(near_clouds, outlines, speeds, turns)
def test_the_permitted_speed_is_the_greatest(points, corners, v, w):
    """A little more, and the margin beyond the stopping distance would not be free."""
    points = outside(points, corners)
    config = FIELD.model_copy(update={"min_speed": 0.0, "creep_speed": 0.0})
    share = safe_speed(points, corners, v, w, DRIVE, config).share
    if share == 1:
        return
    contact = times_to_contact(points, corners, v, w, config.side_margin, config.self_mask)
    rim = np.maximum(np.hypot(v - w * points[:, 1], w * points[:, 0]), abs(v))
    free = contact - config.stop_margin / rim
    braking = max(abs(v) / DRIVE.max_braking, abs(w) / DRIVE.max_turn_acceleration)

    def stops(at):
        return at * config.reaction + at**2 * braking / 2

    assert stops(share) <= max(free.min(), 0) + 1e-9
    assert stops(share + 1e-3) > free.min()


@given(clouds, clouds, outlines, speeds, turns)
def test_more_points_never_permit_more(points, more, corners, v, w):
    both = np.concatenate([points, more])
    assert (
        safe_speed(both, corners, v, w, DRIVE, FIELD).share
        <= safe_speed(points, corners, v, w, DRIVE, FIELD).share + 1e-12
    )


@given(clouds, outlines, speeds, turns)
def test_left_and_right_are_alike(points, corners, v, w):
    mirror = np.array([1.0, -1.0])
    mirrored = safe_speed(points * mirror, (corners * mirror)[::-1].copy(), v, -w, DRIVE, FIELD)
    assert mirrored.share == pytest.approx(safe_speed(points, corners, v, w, DRIVE, FIELD).share, abs=1e-6)


@given(st.floats(0.03, 1.5), st.floats(0.03, 1.5), st.floats(0.05, 0.8))
def test_nearer_never_permits_more(a, b, v):
    near, far = sorted((a, b))
    shares = [safe_speed(front(d), X80.corners, v, 0.0, DRIVE, FIELD).share for d in (near, far)]
    assert shares[0] <= shares[1]


@given(st.floats(0.05, 0.8), st.floats(0.05, 2))
def test_in_front_of_a_wall_the_speed_is_the_textbook_s(v, distance):
    """v^2 / (2 b) + v t = what is free before the margins."""
    free = distance - FIELD.side_margin - FIELD.stop_margin
    b, t = DRIVE.max_braking, FIELD.reaction
    speed = min(v, b * (np.sqrt(t * t + 2 * max(free, 0) / b) - t))
    assume(abs(speed - FIELD.min_speed) > 1e-6)
    expected = 0.0 if speed < FIELD.min_speed else speed
    assert v * safe_speed(front(distance), X80.corners, v, 0.0, DRIVE, FIELD).share == pytest.approx(expected, abs=1e-9)


def test_the_contact_s_distance_is_told():
    permit = safe_speed(front(0.3), X80.corners, 0.8, 0.0, DRIVE, FIELD)
    assert permit.travel == pytest.approx(0.3 - FIELD.side_margin)
    assert safe_speed(front(0.3), X80.corners, -0.3, 0.0, DRIVE, FIELD).travel == inf


@pytest.mark.parametrize("distance", [0.0005, 0.003, 0.01, 0.019, 0.06])
def test_away_from_a_near_wall_is_free_and_towards_it_is_not(distance):
    ahead = front(distance)
    assert safe_speed(ahead, X80.corners, 0.3, 0.0, DRIVE, FIELD).share == 0
    assert safe_speed(ahead, X80.corners, -0.3, 0.0, DRIVE, FIELD).share == 1
    assert safe_speed(-ahead, X80.corners, -0.3, 0.0, DRIVE, FIELD).share == 0
    assert safe_speed(-ahead, X80.corners, 0.3, 0.0, DRIVE, FIELD).share == 1


@pytest.mark.parametrize("depth", [0.001, 0.01, 0.029])
def test_out_of_a_shallow_overlap_is_free_and_deeper_is_not(depth):
    overlap = front(-depth)
    assert safe_speed(overlap, X80.corners, 0.1, 0.0, DRIVE, FIELD).share == 0
    assert safe_speed(overlap, X80.corners, -0.1, 0.0, DRIVE, FIELD).share == 1


def test_beside_something_close_the_robot_creeps_along_and_never_fast():
    """What stands out by less than the side margin into the lane is passed slowly; what stands in the way is not."""
    beside = np.array([[0.15, X80.corners[:, 1].max() + 0.01]])
    for v in (0.8, 0.1, -0.3):
        points = beside if v > 0 else -beside
        share = safe_speed(points, X80.corners, v, 0.0, DRIVE, FIELD).share
        assert abs(v) * share == pytest.approx(min(abs(v), FIELD.creep_speed))
    in_the_way = beside - (0.0, 0.02)
    assert safe_speed(in_the_way, X80.corners, 0.8, 0.0, DRIVE, FIELD).share == 0


def test_turning_beside_something_close_is_for_whom_it_does_not_come_nearer():
    circle = 0.2 * np.column_stack((np.cos(np.arange(64) * pi / 32), np.sin(np.arange(64) * pi / 32)))
    beside = np.array([[0.0, 0.21]])
    assert safe_speed(beside, circle, 0.0, 0.5, DRIVE, FIELD).share == 1
    assert safe_speed(beside, X80.corners, 0.0, 0.5, DRIVE, FIELD).share == 0, "its corners reach 0.217 m"


def test_the_robot_s_own_body_is_no_obstacle():
    body = front(-0.031)
    assert safe_speed(body, X80.corners, 0.5, 0.0, DRIVE, FIELD).share == 1
    assert safe_speed(np.zeros((1, 2)), X80.corners, 0.5, 0.5, DRIVE, FIELD).share == 1


def test_along_a_wall_is_free():
    wall = np.column_stack((np.linspace(-1, 1, 200), np.full(200, X80.corners[:, 1].max() + FIELD.side_margin + 0.006)))
    assert safe_speed(wall, X80.corners, 0.8, 0.0, DRIVE, FIELD).share == 1
    assert safe_speed(wall, X80.corners, 0.8, 0.5, DRIVE, FIELD).share < 0.8


def test_turning_sweeps_the_corners():
    """A rectangle's corner meets a post beside it; an octagon almost does not notice."""
    post = np.array([[0.0, 0.27]])
    half = JACKAL.corners
    contact = times_to_contact(post, half, 0.0, 1.0, 0.0, 0.03)
    # seen from the robot the post turns right, on a circle of 0.27 m that meets the left side, y = 0.208, at asin
    assert contact[0] == pytest.approx(pi / 2 - np.arcsin(0.208 / 0.27))
    assert safe_speed(post, half, 0.0, 1.5, JACKAL.drive, FIELD).share > 0
    close = np.array([[0.0, 0.24]])
    assert safe_speed(close, half, 0.0, 1.5, JACKAL.drive, FIELD).share < 1
    assert safe_speed(close, X80.corners, 0.0, 1.5, DRIVE, FIELD).share == 1


def test_nothing_near_permits_everything():
    assert safe_speed(np.empty((0, 2)), X80.corners, 0.8, 1.0, DRIVE, FIELD).share == 1
    assert safe_speed(front(3.0), X80.corners, 0.8, 0.0, DRIVE, FIELD).share == 1
    assert safe_speed(front(0.0), X80.corners, 0.0, 0.0, DRIVE, FIELD).share == 1


@pytest.mark.parametrize(("distance", "share"), [(0.073, 0), (0.076, 1)])
def test_a_slowed_robot_stands_rather_than_crawls(distance, share):
    """3 mm free beyond the margins permit 0.0144 m/s, under `min_speed`; 6 mm permit 0.027 m/s."""
    permit = safe_speed(front(distance), X80.corners, 0.5, 0.0, DRIVE, FIELD)
    assert (permit.share > 0) is bool(share)


def test_a_command_slower_than_slowest_is_left_alone():
    assert safe_speed(front(0.5), X80.corners, 0.005, 0.0, DRIVE, FIELD).share == 1


@pytest.mark.parametrize("name", ["creep_speed", "creep_turn_rate"])
def test_without_a_creep_speed_no_contact_could_be_left(name):
    with pytest.raises(ValidationError, match="greater than 0"):
        FieldConfig.model_validate({name: 0.0})
