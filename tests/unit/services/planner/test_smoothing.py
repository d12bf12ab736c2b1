# SPDX-License-Identifier: Apache-2.0
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from services.planner.ray_cost import BLOCKED, line_cost, path_cost
from services.planner.search import DIAGONAL, STRAIGHT, GridSearch
from services.planner.smoothing import resampled_path, smooth_path
from tests.unit.services.planner.test_search import cost_of, grids, ringed

inside = st.floats(0.01, 8.99)
SEARCH = GridSearch()


def sampled_cost(costs, a, b, n=20001):
    """The line's cost by many samples; BLOCKED where one is blocked."""
    share = (np.arange(n) + 0.5) / n
    x, y = a[0] + share * (b[0] - a[0]), a[1] + share * (b[1] - a[1])
    cells = costs[y.astype(int), x.astype(int)]
    return BLOCKED if (cells == 0).any() else float(cells.mean() * np.hypot(b[0] - a[0], b[1] - a[1]))


def found(inner, data):
    """Costs, and points along the cheapest way between two drawn cells."""
    costs = ringed(inner)
    free = np.argwhere(costs)
    assume(len(free))
    start, goal = (tuple(map(int, data.draw(st.sampled_from(list(free))))) for _ in range(2))
    way = SEARCH.cheapest_path(costs, start, goal, 50, 20000)
    assume(len(way) > 1)
    return costs, way, way[:, ::-1] + 0.5


@settings(deadline=None)
@given(inside, inside, inside, inside, st.integers(0, 2**32))
def test_a_lines_cost_is_what_sampling_finds(x0, y0, x1, y1, seed):
    costs = np.random.default_rng(seed).integers(50, 500, (9, 9)).astype(np.uint16)
    cost = line_cost(costs, x0, y0, x1, y1)
    assert cost == pytest.approx(sampled_cost(costs, (x0, y0), (x1, y1)), rel=2e-3, abs=1.0)


@settings(deadline=None)
@given(inside, inside, inside, inside, st.integers(0, 2**32))
def test_a_line_that_is_not_blocked_touches_no_blocked_cell(x0, y0, x1, y1, seed):
    costs = 50 * np.random.default_rng(seed).integers(0, 4, (9, 9)).clip(0, 1).astype(np.uint16)
    if line_cost(costs, x0, y0, x1, y1) != BLOCKED:
        assert sampled_cost(costs, (x0, y0), (x1, y1)) != BLOCKED


@pytest.mark.parametrize("end", [(-0.5, 1.5), (9.5, 1.5), (1.5, -3.0), (1.5, 9.0)])
def test_a_line_that_leaves_the_grid_is_blocked(end):
    assert line_cost(np.full((9, 9), 50, np.uint16), 4.5, 4.5, *end) == BLOCKED


def test_a_line_through_a_corner_touches_all_four_cells():
    costs = np.full((4, 4), 50, np.uint16)
    assert line_cost(costs, 0.5, 0.5, 3.5, 3.5) > 0
    costs[1, 2] = 0
    assert line_cost(costs, 0.5, 0.5, 3.5, 3.5) == BLOCKED


@settings(deadline=None)
@given(grids, st.data())
def test_the_cost_of_a_way_over_cells_is_the_integral_along_it(inner, data):
    costs, way, points = found(inner, data)
    assert path_cost(costs, points) == pytest.approx(cost_of(costs, way) / (2 * STRAIGHT), rel=1e-6)
    assert pytest.approx(2**0.5, rel=1e-7) == DIAGONAL / STRAIGHT


@settings(deadline=None)
@given(grids, st.data(), st.floats(0.2, 3))
def test_smoothing_keeps_the_ends_the_spacing_and_off_blocked_cells(inner, data, spacing):
    costs, _, points = found(inner, data)
    path = smooth_path(costs, points, spacing)
    assert (path[0] == points[0]).all()
    assert (path[-1] == points[-1]).all()
    assert (np.hypot(*np.diff(path, axis=0).T) <= spacing + 1e-9).all()
    for a, b in pairwise(path):
        assert sampled_cost(costs, a, b, 201) != BLOCKED


@settings(deadline=None)
@given(st.integers(0, 2**32))
def test_smoothing_makes_no_way_notably_dearer(seed):
    rng = np.random.default_rng(seed)
    smooth = np.kron(rng.integers(50, 200, (6, 6)), np.ones((5, 5), int)).astype(np.uint16)
    costs = ringed(smooth)
    points = SEARCH.cheapest_path(costs, (1, 1), (30, 30), 50, 200)[:, ::-1] + 0.5
    assert path_cost(costs, smooth_path(costs, points, 1.0)) <= 1.02 * path_cost(costs, points)


def test_in_the_open_the_path_is_the_straight_line():
    costs = ringed(np.full((40, 60), 50, np.uint16))
    points = SEARCH.cheapest_path(costs, (3, 4), (29, 55), 50, 50)[:, ::-1] + 0.5
    path = smooth_path(costs, points, 1.0)
    straight = np.hypot(29 - 3, 55 - 4)
    assert np.hypot(*np.diff(path, axis=0).T).sum() == pytest.approx(straight)


def test_around_one_corner_the_path_is_nearly_as_short_as_can_be():
    inner = np.full((60, 60), 50, np.uint16)
    inner[:40, 29:31] = 0
    costs = ringed(inner)
    points = SEARCH.cheapest_path(costs, (11, 11), (11, 51), 50, 50)[:, ::-1] + 0.5
    path = smooth_path(costs, points, 0.5)
    corner = np.array([[30.0, 41.0], [32.0, 41.0]])  # the wall's upper end, seen from below and behind
    tight = np.concatenate(([points[0]], corner, [points[-1]]))
    shortest = np.hypot(*np.diff(tight, axis=0).T).sum()
    assert np.hypot(*np.diff(path, axis=0).T).sum() <= 1.015 * shortest


def test_resampling_keeps_corners():
    corners = np.array([[0.0, 0.0], [3.0, 0.0], [3.0, 2.5]])
    path = resampled_path(corners, 1.0)
    for corner in corners:
        assert (np.abs(path - corner).max(axis=1) < 1e-12).any()
