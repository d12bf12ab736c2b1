# SPDX-License-Identifier: Apache-2.0
from math import cos, hypot, inf, pi, sin

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from services.sim.rays import SOLID, cast_ray, index_grid, index_shapes
from services.sim.world import Raster, World
from shared.geometry import Pose2
from shared.polygon_kernels import distance_to_segment

coordinates = st.floats(-8, 8).map(lambda v: round(v, 3))
ends = st.tuples(coordinates, coordinates, coordinates, coordinates)
segments = st.lists(ends.filter(lambda s: hypot(s[2] - s[0], s[3] - s[1]) > 0.01), max_size=12)
circles = st.lists(st.tuples(coordinates, coordinates, st.floats(0.02, 1.5)), max_size=8)
angles = st.one_of(st.floats(-7, 7).map(lambda a: round(a, 9)), st.sampled_from([k * pi / 4 for k in range(-8, 9)]))


def brute_force(lines, discs, ox, oy, angle):
    """Nearest intersection by solving each 2 x 2 system alone."""
    c, s = cos(angle), sin(angle)
    hits = [inf]
    for ax, ay, bx, by in lines:
        system = np.array([[c, ax - bx], [s, ay - by]])
        if abs(np.linalg.det(system)) > 1e-9:
            t, u = np.linalg.solve(system, [ax - ox, ay - oy])
            if t >= 0 and 0 <= u <= 1:
                hits.append(t)
    for x, y, r in discs:
        if hypot(x - ox, y - oy) <= r:
            hits.append(0.0)
            continue
        roots = np.roots([1.0, 2 * (c * (ox - x) + s * (oy - y)), (ox - x) ** 2 + (oy - y) ** 2 - r * r])
        hits += [float(t.real) for t in roots if abs(t.imag) < 1e-12 and t.real >= 0]
    return min(hits)


def grazes(lines, discs, ox, oy, angle):
    """Whether the ray starts on a surface, or passes within 0.1 mm of an end or along one: either answer is right."""
    c, s = cos(angle), sin(angle)
    points = [p for ax, ay, bx, by in lines for p in ((ax, ay), (bx, by))]
    off = [abs((x - ox) * s - (y - oy) * c) for x, y in points]
    along = [abs(abs((x - ox) * s - (y - oy) * c) - r) for x, y, r in discs]
    touching = [abs(hypot(x - ox, y - oy) - r) for x, y, r in discs]
    touching += [distance_to_segment(ox, oy, *line) for line in lines]
    return min([*off, *along, *touching, inf]) < 1e-4


@settings(max_examples=300, deadline=None)
@given(segments, circles, coordinates, coordinates, angles, st.sampled_from([0.1, 0.37, 2.0]))
def test_a_ray_is_the_nearest_of_all_intersections(lines, discs, ox, oy, angle, size):
    cells = index_shapes(np.array(lines, float).reshape(-1, 4), np.array(discs, float).reshape(-1, 3), size)
    found = cast_ray(cells, ox, oy, cos(angle), sin(angle), 100.0)
    if not grazes(lines, discs, ox, oy, angle):
        assert_allclose(found, brute_force(lines, discs, ox, oy, angle), atol=1e-6)


@settings(deadline=None)
@given(segments, coordinates, coordinates, angles, st.floats(0.1, 20))
def test_beyond_the_limit_there_is_no_echo(lines, ox, oy, angle, limit):
    cells = index_shapes(np.array(lines, float).reshape(-1, 4), np.zeros((0, 3)), 0.5)
    far = cast_ray(cells, ox, oy, cos(angle), sin(angle), 100.0)
    near = cast_ray(cells, ox, oy, cos(angle), sin(angle), limit)
    assert near == far if far <= limit else near in (far, inf)


def test_corners_where_segments_meet_let_no_ray_through():
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], float)
    cells = World("w", (-1, -1, 1, 1), Pose2(), (square,)).cells
    for angle in np.linspace(-pi, pi, 2000):
        ray = cast_ray(cells, 0.0, 0.0, cos(angle), sin(angle), 10.0)
        assert_allclose(ray, 1 / max(abs(cos(angle)), abs(sin(angle))), atol=1e-9)
    for corner in square:
        assert_allclose(cast_ray(cells, 0.0, 0.0, *(corner / np.sqrt(2)), 10.0), np.sqrt(2), atol=1e-6)


@settings(deadline=None)
@given(st.integers(0, 2**32), st.floats(0.03, 0.97), st.floats(0.03, 0.97), angles)
def test_a_ray_ends_where_the_first_solid_cell_begins(seed, share_x, share_y, angle):
    rng = np.random.default_rng(seed)
    solid = rng.random((30, 40)) < 0.08
    size, x0, y0 = 0.05, -1.3, 0.4
    ox, oy = x0 + 40 * size * share_x, y0 + 30 * size * share_y
    cells = index_grid(np.zeros((0, 4)), np.zeros((0, 3)), solid, x0, y0, size)
    found = cast_ray(cells, ox, oy, cos(angle), sin(angle), 10.0)
    boxes = []
    for row, column in zip(*np.nonzero(solid)):
        left, low = x0 + column * size, y0 + row * size
        right, high = left + size, low + size
        assume(min(abs(ox - left), abs(ox - right), abs(oy - low), abs(oy - high)) > 1e-6)
        if left <= ox <= right and low <= oy <= high:
            boxes.append((0.0, 0.0))
            continue
        with np.errstate(divide="ignore"):
            tx = np.sort((np.array([left, right]) - ox) / cos(angle))
            ty = np.sort((np.array([low, high]) - oy) / sin(angle))
        enter, leave = max(tx[0], ty[0]), min(tx[1], ty[1])
        if leave >= 0:
            boxes.append((enter, leave - enter))
    if all(abs(inside) > 1e-6 or enter == 0.0 for enter, inside in boxes):
        assert_allclose(found, min([enter for enter, inside in boxes if inside >= 0], default=inf), atol=1e-6)


def test_a_world_far_away_is_seen_from_outside_its_cells():
    cells = index_shapes(np.array([[10.0, -1.0, 10.0, 1.0]]), np.zeros((0, 3)), 0.1)
    assert_allclose(cast_ray(cells, -40.0, 0.0, 1.0, 0.0, 100.0), 50.0)
    assert cast_ray(cells, -40.0, 0.0, -1.0, 0.0, 100.0) == inf
    assert cast_ray(cells, -40.0, 0.0, 0.0, 1.0, 100.0) == inf


def test_a_map_and_shapes_are_one_world_also_where_shapes_stand_outside_the_map():
    raster = Raster(np.pad(np.zeros((8, 8), bool), 1, constant_values=True), 0.0, 0.0, 0.1)
    beside = np.array([[3.0, 0.0], [3.5, 0.0], [3.5, 1.0], [3.0, 1.0]])
    world = World("w", (0, 0, 4, 1), Pose2(), (beside,), np.array([[0.5, 0.7, 0.1]]), raster)
    assert_allclose(cast_ray(world.cells, 0.5, 0.5, 1.0, 0.0, 9.0), 0.4)
    assert_allclose(cast_ray(world.cells, 0.5, 0.5, 0.0, 1.0, 9.0), 0.1)
    assert_allclose(cast_ray(world.cells, 2.0, 0.5, 1.0, 0.0, 9.0), 1.0)
    assert_allclose(cast_ray(world.cells, 2.0, 0.5, -1.0, 0.0, 9.0), 1.0)
    assert (world.cells.skip == SOLID).sum() == raster.solid.sum()


@settings(max_examples=100)
@given(seed=st.integers(0, 2**32 - 1), h=st.integers(1, 25), w=st.integers(1, 25), share=st.sampled_from([0.01, 0.2]))
def test_a_cell_knows_how_many_cells_around_it_are_free(seed, h, w, share):
    solid = np.random.default_rng(seed).random((h, w)) < share
    skip = index_grid(np.zeros((0, 4)), np.zeros((0, 3)), solid, 0.0, 0.0, 0.05).skip
    rows, columns = np.nonzero(solid)
    for row in range(h):
        for column in range(w):
            steps = np.maximum(abs(rows - row), abs(columns - column))
            expected = SOLID if solid[row, column] else min(steps, default=max(h, w))
            assert skip[row, column] == expected


@pytest.mark.parametrize("shape", [(3, 3), (1, 50)])
def test_a_world_of_nothing_has_no_echo(shape):
    cells = index_grid(np.zeros((0, 4)), np.zeros((0, 3)), np.zeros(shape, bool), 0.0, 0.0, 0.1)
    assert cast_ray(cells, 0.05, 0.05, 0.6, 0.8, 50.0) == inf
