# SPDX-License-Identifier: Apache-2.0
"""What a user can prefer: how far around for clearance, and whether unknown space is a way."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.planner.costmap import UNIT_COST, CostConfig, GlobalCostmap, cost_by_distance
from services.planner.hierarchical_search import HierarchicalSearch
from services.planner.planning import PlanningConfig, plan_path
from services.planner.search import GridSearch
from shared import reasons
from shared.config import load_robot
from shared.geometry import Pose2
from tests.unit.services.maps import boxes, drawn, grid_of, room

X80 = load_robot("x80sv").robot
SEARCH, OUTLINE = GridSearch(), HierarchicalSearch()
WEIGHTS = (0.0, 1.0, 3.0, 8.0, 20.0)


def terrain_of(cells, **settings_):
    costmap = GlobalCostmap(CostConfig(min_margin=0.07, **settings_), X80, 0.05)
    costmap.update(grid_of(cells), None)
    return costmap


def way(costmap, start, goal):
    return plan_path(costmap, OUTLINE, Pose2(*start), Pose2(*goal), 0.15, PlanningConfig())


def exposed(costmap, cells):
    """(n,) how much nearness there is at cells (n, 2) of `costs`: 1 where the robot just fits, 0 far away."""
    tables = [
        cost_by_distance(CostConfig(clearance_weight=w), X80, 0.05, costmap.reach_cells).astype(float) for w in (0, 100)
    ]
    rows, columns = cells.T - costmap.pad
    squared = np.rint(costmap.distance[rows, columns] ** 2).astype(int)
    return (tables[1] - tables[0])[squared] / (100 * UNIT_COST)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32))
def test_who_gives_more_for_clearance_comes_less_near_to_things_and_drives_no_shorter_way(seed):
    """Of cheapest ways that is a law: the costs' sum of a preference and a length, each the least at its own price."""
    cells, told = boxes(np.random.default_rng(seed), 14), []
    for weight in WEIGHTS:
        costmap = terrain_of(cells, clearance_weight=weight)
        rng = np.random.default_rng(seed)
        (a, b) = np.argwhere(costmap.costs)[rng.integers(np.count_nonzero(costmap.costs), size=2)]
        found = SEARCH.cheapest_path(costmap.costs, tuple(map(int, a)), tuple(map(int, b)), UNIT_COST, costmap.max_cost)
        if len(found) < 2:
            return
        steps = np.hypot(*np.diff(found, axis=0).T)
        near = exposed(costmap, found)
        plain = (
            terrain_of(cells, clearance_weight=0).costs[tuple(found.T)] / UNIT_COST
        )  # length, dear where it is narrow
        told.append([float(np.sum(steps * (of[1:] + of[:-1]) / 2)) for of in (near, plain)])
    for (nearness, length), (less_near, longer) in pairwise(told):
        rounding = 0.01 * (length + longer)  # costs are whole numbers of 1 / UNIT
        assert less_near <= nearness + rounding
        assert longer >= length - rounding


def test_so_many_metres_of_detour_are_driven_rather_than_one_where_the_robot_just_fits():
    """A tight passage, 2 m long, and a wide one beside it: the way through that is some 4 m longer."""
    cells = room(6, 6)
    cells[:, 40:80] = 100
    cells[10:21, 40:80] = 0  # 0.55 m for a robot of 0.4 m and its margins
    cells[80:118, 40:80] = 0
    lengths = {}
    for weight in (0.0, 0.5, 4.0, 10.0):
        plan = way(terrain_of(cells, clearance_weight=weight, narrow_weight=0.0), (1.0, 0.9), (5.0, 0.9))
        lengths[weight] = float(np.hypot(*np.diff(plan.points, axis=0).T).sum())
    detour = lengths[10.0] - lengths[0.0]
    assert lengths[0.0] == pytest.approx(4.0, abs=0.1)
    assert 4.0 < detour < 2.0 * 10.0
    assert lengths[0.5] == pytest.approx(lengths[0.0], abs=0.05)  # 2 m x 0.5 is less than the detour
    assert lengths[4.0] == pytest.approx(lengths[10.0], abs=0.6)  # 2 m x 4 is more


def through_the_unknown():
    """Two halves, joined by an unknown corridor and, far around, by a known one."""
    text = """
    ############
    #..........#
    #.########.#
    #.########.#
    #.########.#
    #..??????..#
    ############
    """
    return drawn(text, 20)


@pytest.mark.parametrize(("policy", "crosses"), [("allowed", True), ("costly", False), ("forbidden", False)])
def test_space_that_nobody_has_seen_is_a_way_a_dear_way_or_none(policy, crosses):
    cells = through_the_unknown()
    costmap = terrain_of(cells, unknown=policy, unknown_weight=5.0)
    plan = way(costmap, (1.5, 1.5), (10.5, 1.5))
    assert plan.reason is None
    assert (plan.points[:, 1].max() < 2.5) == crosses
    if policy != "forbidden":
        cells[100:120, 40:80] = 100  # and the seen one is closed
        closed = way(terrain_of(cells, unknown=policy), (1.5, 1.5), (10.5, 1.5))
        assert closed.points[:, 1].max() < 2.5
    else:
        cells[100:120, 40:80] = 100
        assert way(terrain_of(cells, unknown=policy), (1.5, 1.5), (10.5, 1.5)).reason is reasons.UNREACHABLE
        assert way(costmap, (1.5, 1.5), (6.0, 1.5)).reason is reasons.GOAL_UNKNOWN
