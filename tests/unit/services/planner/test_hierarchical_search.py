# SPDX-License-Identifier: Apache-2.0
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.planner.abstract_graph import MAX_PARTS, AbstractGraph
from services.planner.connected_components import ConnectedComponents
from services.planner.costmap import UNIT_COST, CostConfig, GlobalCostmap
from services.planner.hierarchical_search import HierarchicalSearch
from services.planner.ray_cost import line_cost, path_cost
from services.planner.search import GridSearch
from services.planner.smoothing import smooth_path
from shared.config import load_robot
from shared.ros_map import read_ros_map
from tests.unit.services.maps import grid_of, planning_data

SEARCH, OUTLINE = (
    GridSearch(),
    HierarchicalSearch(),
)  # for all tests: what a search leaves behind must not matter to the next


def clutter(seed, share, shape=(70, 90)):
    """Costs of three kinds, a share of the cells blocked, inside a blocked ring."""
    rng = np.random.default_rng(seed)
    inner = rng.choice(np.array([50, 50, 80, 300], np.uint16), shape)
    return np.pad(np.where(rng.random(shape) < share, 0, inner).astype(np.uint16), 1)


def pairs(costs, n, seed=0):
    """Pairs of cells in one connected component."""
    rng = np.random.default_rng(seed)
    regions = ConnectedComponents(costs).labels_in(0, 0, *costs.shape)
    free = np.argwhere(regions)
    for _ in range(n):
        start = tuple(map(int, free[rng.integers(len(free))]))
        others = np.argwhere(regions == regions[start])
        yield start, tuple(map(int, others[rng.integers(len(others))]))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32), st.floats(0.0, 0.5))
def test_wherever_a_way_exists_there_is_one_in_sight_from_point_to_point(seed, share):
    costs = clutter(seed, share)
    blocks, regions = AbstractGraph.of(costs), ConnectedComponents(costs)
    for start, goal in pairs(costs, 8, seed):
        points = OUTLINE.rough_path(costs, blocks, regions, start, goal, 50, 300)
        assert tuple(points[0]) == (start[1] + 0.5, start[0] + 0.5)
        assert tuple(points[-1]) == (goal[1] + 0.5, goal[0] + 0.5)
        assert all(line_cost(costs, *a, *b) >= 0 for a, b in pairwise(points))


def test_a_block_of_more_parts_than_it_has_nodes_is_found_a_way_through():
    costs = np.full((39, 40), 50, np.uint16)
    costs[::2] = 0  # 20 corridors
    costs[0], costs[-1], costs[:, 0], costs[:, -1] = 0, 0, 0, 0
    for row in range(2, 38, 2):
        costs[row, 38 if row % 4 else 1] = 50  # one after the other
    blocks = AbstractGraph.of(costs)
    assert blocks.parts.max() == MAX_PARTS
    points = OUTLINE.rough_path(costs, blocks, ConnectedComponents(costs), (1, 1), (37, 20), 50, 50)
    assert path_cost(costs, points) > 18 * 36 * 50


def test_the_same_question_has_the_same_answer():
    costs = clutter(1, 0.2)
    blocks, regions = AbstractGraph.of(costs), ConnectedComponents(costs)
    for start, goal in pairs(costs, 20):
        fresh = HierarchicalSearch().rough_path(costs, blocks, regions, start, goal, 50, 300)
        assert np.array_equal(OUTLINE.rough_path(costs, blocks, regions, start, goal, 50, 300), fresh)


def test_in_clutter_the_way_keeps_near_the_straight_line():
    """Many paths of the abstract graph are equally long: it has eight directions. Smoothing repairs no wrong one."""
    costs = np.pad(np.where(np.random.default_rng(3).random((200, 300)) < 0.1, 0, 50).astype(np.uint16), 1)
    blocks, regions = AbstractGraph.of(costs), ConnectedComponents(costs)
    ratios = []
    for start, goal in pairs(costs, 30):
        if np.hypot(start[0] - goal[0], start[1] - goal[1]) > 80:
            points = OUTLINE.rough_path(costs, blocks, regions, start, goal, 50, 50)
            way = SEARCH.cheapest_path(costs, start, goal, 50, 50)[:, ::-1] + 0.5
            found, shortest = (path_cost(costs, smooth_path(costs, p, 1.0)) for p in (points, way))
            ratios.append(found / shortest)
    assert len(ratios) > 15
    assert np.mean(ratios) < 1.02


@pytest.mark.parametrize("name", ["depot", "pal_office"])
def test_in_real_buildings_the_path_costs_hardly_more_than_the_cheapest_way_smoothed(name):
    cells, resolution, _, _ = read_ros_map(planning_data() / "ros_maps" / f"{name}.yaml")
    costmap = GlobalCostmap(CostConfig(unknown="forbidden"), load_robot("x80sv").robot, resolution)
    costmap.update(grid_of(cells, resolution), None)
    ratios = []
    for start, goal in pairs(costmap.costs, 30):
        if abs(start[0] - goal[0]) + abs(start[1] - goal[1]) < 20:
            continue
        points = OUTLINE.rough_path(
            costmap.costs, costmap.graph, costmap.components, start, goal, UNIT_COST, costmap.max_cost
        )
        way = SEARCH.cheapest_path(costmap.costs, start, goal, UNIT_COST, costmap.max_cost)[:, ::-1] + 0.5
        found, cheapest = (path_cost(costmap.costs, smooth_path(costmap.costs, p, 1.0)) for p in (points, way))
        ratios.append(found / cheapest)
    assert np.mean(ratios) < 1.01
    assert max(ratios) < 1.10
