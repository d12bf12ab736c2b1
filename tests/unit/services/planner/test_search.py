# SPDX-License-Identifier: Apache-2.0
import gzip
import heapq
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from services.planner.search import DIAGONAL, STRAIGHT, GridSearch
from tests.unit.services.maps import planning_data

SEARCH = GridSearch()  # one for all tests: what a search leaves in the buffers must not matter to the next

grids = hnp.array_shapes(min_dims=2, max_dims=2, min_side=1, max_side=9).flatmap(
    lambda shape: hnp.arrays(np.uint16, shape, elements=st.sampled_from([0, 50, 50, 50, 60, 333, 20000]))
)


def ringed(inner):
    """The grid inside a blocked ring."""
    return np.ascontiguousarray(np.pad(inner, 1))


def steps_from(costs, cell):
    """Each legal step: the next cell and its cost, by the definition."""
    row, column = cell
    for dr in (-1, 0, 1):
        for dc in (-1, 0, 1):
            there = row + dr, column + dc
            if (dr or dc) and costs[there] and costs[row + dr, column] and costs[row, column + dc]:
                length = DIAGONAL if dr and dc else STRAIGHT
                yield there, (int(costs[cell]) + int(costs[there])) * length


def dijkstra(costs, start, goal):
    """The least cost with a heap, None without a way."""
    if not (costs[start] and costs[goal]):
        return None
    best, queue = {start: 0}, [(0, start)]
    while queue:
        so_far, cell = heapq.heappop(queue)
        if cell == goal:
            return so_far
        if so_far > best[cell]:
            continue
        for there, cost in steps_from(costs, cell):
            if so_far + cost < best.get(there, 2**60):
                best[there] = so_far + cost
                heapq.heappush(queue, (so_far + cost, there))
    return None


def cost_of(costs, way):
    """The sum of the steps' costs; every step must be legal."""
    cells = [tuple(map(int, cell)) for cell in way]
    return sum(dict(steps_from(costs, a))[b] for a, b in pairwise(cells))


@settings(deadline=None)
@given(grids, st.data())
def test_no_way_is_cheaper_than_the_one_found(inner, data):
    costs = ringed(inner)
    cell = st.tuples(st.integers(1, inner.shape[0]), st.integers(1, inner.shape[1]))
    start, goal = data.draw(cell), data.draw(cell)
    way = SEARCH.cheapest_path(costs, start, goal, 50, 20000)
    least = dijkstra(costs, start, goal)
    if least is None:
        assert len(way) == 0
    else:
        assert tuple(way[0]) == start
        assert tuple(way[-1]) == goal
        assert cost_of(costs, way) == least


@settings(deadline=None)
@given(grids, st.data())
def test_there_costs_as_much_as_back(inner, data):
    costs = ringed(inner)
    cell = st.tuples(st.integers(1, inner.shape[0]), st.integers(1, inner.shape[1]))
    start, goal = data.draw(cell), data.draw(cell)
    there, back = (
        SEARCH.cheapest_path(costs, start, goal, 50, 20000),
        SEARCH.cheapest_path(costs, goal, start, 50, 20000),
    )
    assert (len(there) > 0) == (len(back) > 0)
    assert cost_of(costs, there) == cost_of(costs, back)


def test_a_large_grid_needs_more_room_than_the_queue_begins_with():
    rng = np.random.default_rng(5)
    costs = ringed(rng.integers(50, 400, (300, 300)).astype(np.uint16))
    search = GridSearch()
    way = search.cheapest_path(costs, (1, 1), (300, 300), 50, 400)
    assert cost_of(costs, way) == dijkstra(costs, (1, 1), (300, 300))


def test_a_walled_in_goal_has_no_way():
    inner = np.full((9, 9), 50, np.uint16)
    inner[2:7, 2:7] = 0
    inner[4, 4] = 50
    assert len(SEARCH.cheapest_path(ringed(inner), (1, 1), (5, 5), 50, 50)) == 0


def test_two_blocked_cells_that_touch_at_a_corner_let_nobody_through():
    inner = np.array([[50, 0], [0, 50]], np.uint16)
    assert len(SEARCH.cheapest_path(ringed(inner), (1, 1), (2, 2), 50, 50)) == 0


@pytest.mark.parametrize("name", ["arena", "den520d", "random512-10-0", "32room_000", "maze512-32-9", "AR0011SR"])
def test_octile_lengths_equal_the_published_optima(name):
    folder = planning_data() / "movingai"
    lines = gzip.decompress((folder / f"{name}.map.gz").read_bytes()).decode().splitlines()
    free = np.array([[letter in ".GS" for letter in line] for line in lines[4:]])
    costs = ringed(free.astype(np.uint16))
    scenarios = gzip.decompress((folder / f"{name}.map.scen.gz").read_bytes()).decode().splitlines()[1:]
    some = scenarios[:: max(len(scenarios) // 40, 1)]
    assert some
    for scenario in some:
        x0, y0, x1, y1 = map(int, scenario.split()[4:8])
        optimum = scenario.split()[8]
        rounded = 0.5 * 10.0 ** -len(optimum.partition(".")[2])  # some are printed with six digits only
        way = SEARCH.cheapest_path(costs, (y0 + 1, x0 + 1), (y1 + 1, x1 + 1), 1, 1)
        diagonal = np.abs(np.diff(way, axis=0)).sum(axis=1) == 2
        length = np.count_nonzero(diagonal) * np.sqrt(2) + np.count_nonzero(~diagonal)
        assert length == pytest.approx(float(optimum), abs=1e-3 + rounded)
