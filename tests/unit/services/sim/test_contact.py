# SPDX-License-Identifier: Apache-2.0
from math import hypot, pi

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from services.sim.contact import (
    disc_touches_world,
    offset_polygon,
    touches_people,
    touches_world,
    transform_polygon,
)
from services.sim.dynamics import move_until_contact
from services.sim.rays import cast_ray, index_grid, index_shapes
from services.sim.world import World
from shared.geometry import Pose2
from shared.polygon import contains
from shared.polygon_kernels import distance_to_polygon
from tests.unit.services.sim.scenes import JACKAL, X80SV

L_SHAPE = np.array([[-0.3, -0.2], [0.4, -0.2], [0.4, 0.0], [0.0, 0.0], [0.0, 0.3], [-0.3, 0.3]])
footprints = st.sampled_from([X80SV.corners, JACKAL.corners, L_SHAPE])
spots = st.floats(-1, 1)
poses = st.tuples(spots, spots, st.floats(-pi, pi))


def surface(corners, n=400):
    """Points (m, 2) all over the area and the edge of a polygon."""
    after = np.roll(corners, -1, axis=0)
    edge = np.concatenate([a + np.linspace(0, 1, 60)[:, None] * (b - a) for a, b in zip(corners, after)])
    low, high = corners.min(axis=0), corners.max(axis=0)
    grid = np.stack(np.meshgrid(*(np.linspace(a, b, int(n**0.5)) for a, b in zip(low, high))), -1).reshape(-1, 2)
    return np.concatenate((edge, grid[contains(corners, grid)]))


@settings(deadline=None)
@given(footprints, poses, spots, spots, spots, spots)
@example(L_SHAPE, (0.0, 0.0, 1e-268), 0.42, 0.0, 0.6, 0.0)  # products of its coordinates underflow
def test_a_touched_segment_is_one_that_comes_within_the_footprint(corners, pose, ax, ay, bx, by):
    at = transform_polygon(corners, *pose)
    cells = index_shapes(np.array([[ax, ay, bx, by]]), np.zeros((0, 3)), 0.1)
    line = np.array([ax, ay]) + np.linspace(0, 1, 200)[:, None] * np.array([bx - ax, by - ay])
    if min(distance_to_polygon(transform_polygon(offset_polygon(corners, -1e-6), *pose), *p) for p in line) == 0:
        assert touches_world(at, cells)
    elif min(distance_to_polygon(at, *p) for p in line) > hypot(bx - ax, by - ay) / 199:
        assert not touches_world(at, cells)


@settings(deadline=None)
@given(footprints, poses, spots, spots, st.floats(0.01, 0.5))
def test_a_touched_disc_is_nearer_than_its_radius(corners, pose, x, y, r):
    at = transform_polygon(corners, *pose)
    points = surface(at)
    nearest = 0.0 if contains(at, np.array([[x, y]]))[0] else np.hypot(*(points - (x, y)).T).min()
    assert abs(distance_to_polygon(at, x, y) - nearest) < 0.02
    if abs(nearest - r) > 0.02:
        cells = index_shapes(np.zeros((0, 4)), np.array([[x, y, r]]), 0.1)
        assert touches_world(at, cells) == touches_people(at, np.array([[x, y, r]])) == (nearest < r)


@settings(deadline=None)
@given(footprints, poses, st.integers(0, 2**32))
def test_a_touched_map_has_a_solid_cell_under_the_footprint(corners, pose, seed):
    solid = np.random.default_rng(seed).random((20, 20)) < 0.05
    cells = index_grid(np.zeros((0, 4)), np.zeros((0, 3)), solid, -1.0, -1.0, 0.1)

    def covers_solid(outline):
        place = np.floor((surface(transform_polygon(outline, *pose), 2500) + 1.0) / 0.1).astype(int)
        place = place[((place >= 0) & (place < 20)).all(axis=1)]
        return solid[place[:, 1], place[:, 0]].any()

    if covers_solid(offset_polygon(corners, -1e-6)):
        assert touches_world(transform_polygon(corners, *pose), cells)
    if not covers_solid(offset_polygon(corners, 0.02)):
        assert not touches_world(transform_polygon(corners, *pose), cells)


@settings(deadline=None)
@given(spots, spots, st.floats(0.05, 0.4), spots, spots, st.floats(0.05, 0.3))
def test_a_disc_touches_a_square_and_a_disc_where_it_comes_near(x, y, r, cx, cy, size):
    square = np.array([[cx - size, cy - size], [cx + size, cy - size], [cx + size, cy + size], [cx - size, cy + size]])
    cells = World("w", (-2, -2, 2, 2), Pose2(), (square,)).cells
    edges = min(
        hypot(x - min(max(x, a[0]), b[0]), y - min(max(y, a[1]), b[1]))
        for a, b in ((np.minimum(p, q), np.maximum(p, q)) for p, q in zip(square, np.roll(square, -1, axis=0)))
    )
    if abs(edges - r) > 1e-6:
        assert disc_touches_world(x, y, r, cells) == (edges < r)
    round_ = index_shapes(np.zeros((0, 4)), np.array([[cx, cy, size]]), 0.1)
    if abs(hypot(x - cx, y - cy) - r - size) > 1e-6:
        assert disc_touches_world(x, y, r, round_) == (hypot(x - cx, y - cy) < r + size)


@settings(deadline=None)
@given(footprints, st.floats(0.001, 0.05))
def test_a_grown_footprint_keeps_its_edges_at_the_margin(corners, margin):
    larger = offset_polygon(corners, margin)
    middles = (larger + np.roll(larger, -1, axis=0)) / 2
    assert_allclose([distance_to_polygon(corners, *p) for p in middles], margin, atol=1e-9)


walls = st.lists(
    st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1)).filter(
        lambda s: hypot(s[2] - s[0], s[3] - s[1]) > 0.05
    ),
    max_size=4,
)
motions = st.lists(st.tuples(st.floats(-0.02, 0.02), st.floats(-0.06, 0.06)), min_size=5, max_size=60)


@settings(max_examples=150, deadline=None)
@given(walls, motions, footprints)
def test_no_motion_leads_into_what_stands_there(lines, steps, corners):
    cells = index_shapes(np.array(lines, float).reshape(-1, 4), np.array([[0.9, 0.9, 0.2]]), 0.1)
    nobody = np.array([[-0.8, 0.8, 0.15]])
    x = y = yaw = 0.0
    if touches_world(transform_polygon(corners, x, y, yaw), cells) or touches_people(corners, nobody):
        return
    for forward, turn in steps:
        x, y, yaw, _ = move_until_contact(x, y, yaw, forward, turn, corners, cells, nobody)
        at = transform_polygon(corners, x, y, yaw)
        assert not touches_world(at, cells)
        assert not touches_people(at, nobody)


def test_a_robot_against_a_wall_stands_0_1_mm_off_and_may_turn_and_leave():
    cells = index_shapes(np.array([[1.0, -2.0, 1.0, 2.0]]), np.zeros((0, 3)), 0.1)
    nobody = np.zeros((0, 3))
    x = y = yaw = 0.0
    for _ in range(200):
        x, y, yaw, blocked = move_until_contact(x, y, yaw, 0.01, 0.0, X80SV.corners, cells, nobody)
    assert blocked
    assert 0.7999 < x < 0.8
    assert cast_ray(cells, x + 0.2, 0.0, 1.0, 0.0, 1.0) < 1e-4
    _, _, turned, _ = move_until_contact(x, y, yaw, 0.0, -0.02, X80SV.corners, cells, nobody)
    assert turned != 0.0
    back, _, _, blocked = move_until_contact(x, y, yaw, -0.01, 0.0, X80SV.corners, cells, nobody)
    assert not blocked
    assert_allclose(back, x - 0.01)
