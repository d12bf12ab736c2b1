# SPDX-License-Identifier: Apache-2.0
"""Paths of a robot that drives no tighter arc than its own: what they keep, and what is said where there is none."""

from math import cos, hypot, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.planner.costmap import UNIT_COST, CostConfig, GlobalCostmap
from services.planner.hierarchical_search import HierarchicalSearch
from services.planner.hybrid_astar import hybrid_astar_path
from services.planner.planning import PlanningConfig, TurningLimits, plan_path
from services.planner.ray_cost import path_cost
from shared import reasons
from shared.config import load_robot
from shared.geometry import Pose2
from shared.ros_map import read_ros_map
from tests.unit.services.maps import boxes, grid_of, planning_data, room
from tests.unit.services.planner.test_dubins import ways

X80 = load_robot("x80sv").robot
OUTLINE, CONFIG = HierarchicalSearch(), PlanningConfig()
RADIUS = 0.5


def terrain_of(cells, resolution=0.05):
    costmap = GlobalCostmap(CostConfig(unknown="forbidden"), X80, resolution)
    costmap.update(grid_of(cells, resolution), None)
    return costmap


def way(costmap, start, goal, spins=False, any_heading=False, radius=RADIUS):
    return plan_path(
        costmap, OUTLINE, Pose2(*start), Pose2(*goal), 0.15, CONFIG, TurningLimits(radius, spins, any_heading)
    )


def keeps_its_arcs(plan, radius, start, goal, any_heading):
    """Begins and ends as it should, in steps no longer than `spacing`, and turns by no more than a step's share."""
    steps = np.hypot(*np.diff(plan.points, axis=0).T)
    turns = np.abs(np.angle(np.exp(1j * np.diff(plan.yaws))))
    assert (steps <= CONFIG.spacing + 1e-6).all()
    # a chord is shorter than its arc
    assert (turns <= 2 * np.arcsin(np.minimum(steps / (2 * radius), 1)) + 1e-6).all()
    # along its headings: half the turn to either side of the chord
    chords = np.arctan2(*np.diff(plan.points, axis=0).T[::-1])
    assert np.abs(np.angle(np.exp(1j * (chords - plan.yaws[:-1]))) - np.angle(np.exp(1j * np.diff(plan.yaws))) / 2)[
        steps > 1e-3
    ] == pytest.approx(0, abs=1e-3)
    assert plan.points[0] == pytest.approx(start[:2], abs=1e-6)
    assert plan.points[-1] == pytest.approx(goal[:2], abs=1e-4)
    assert (cos(plan.yaws[0]), sin(plan.yaws[0])) == pytest.approx((cos(start[2]), sin(start[2])), abs=1e-6)
    if not any_heading:
        assert (cos(plan.yaws[-1]), sin(plan.yaws[-1])) == pytest.approx((cos(goal[2]), sin(goal[2])), abs=1e-4)
    return float(steps.sum())


@settings(max_examples=5, deadline=None)
@given(st.integers(0, 2**32), st.booleans())
def test_in_any_clutter_a_path_keeps_its_arcs_touches_nothing_and_has_its_headings(seed, any_heading):
    rng = np.random.default_rng(seed)
    costmap = terrain_of(boxes(rng, 6))
    free = np.argwhere(costmap.costs)
    (r0, c0), (r1, c1) = free[rng.integers(len(free), size=2)]
    start, goal = (
        (*costmap.centre(int(r), int(c)), float(yaw))
        for (r, c), yaw in zip(((r0, c0), (r1, c1)), rng.uniform(-pi, pi, 2))
    )
    plan = way(costmap, start, goal, any_heading=any_heading)
    if plan.reason is None:
        keeps_its_arcs(plan, RADIUS, start, goal, any_heading)
        free_of = costmap if path_cost(costmap.costs, cells_of(costmap, plan)) >= 0 else costmap.with_min_margin()
        assert path_cost(free_of.costs, cells_of(free_of, plan)) >= 0
    else:
        assert plan.reason in (reasons.NO_ROOM_TO_TURN, reasons.UNREACHABLE)


def cells_of(costmap, plan):
    return (plan.points - costmap.origin) / costmap.resolution


@settings(max_examples=25, deadline=None)
@given(st.floats(-6, 6), st.floats(-6, 6), st.floats(-pi, pi), st.floats(-pi, pi), st.booleans())
def test_on_an_empty_floor_the_way_is_the_shortest_there_is(x, y, start_yaw, goal_yaw, any_heading):
    costs = np.pad(np.full((480, 480), UNIT_COST, np.uint16), 1)
    start, goal = np.array([240.3, 240.6, start_yaw]), np.array([240.3 + 10 * x, 240.6 + 10 * y, goal_yaw])
    poses = hybrid_astar_path(costs, start, goal, 10.0, any_heading, UNIT_COST, 1.0)
    length = np.hypot(*np.diff(poses[:, :2], axis=0).T).sum()
    shortest = min((of for of, _ in ways(start, goal, 10.0, any_heading)), default=np.inf)
    assert length <= 1.08 * shortest + 0.5
    if shortest < np.inf and hypot(x, y) > 4:  # far apart no word is shorter
        assert length >= 0.99 * shortest - 0.5


def test_a_goal_behind_is_reached_by_a_turn_and_with_a_larger_radius_by_a_wider_one():
    costmap = terrain_of(room(8, 8))
    lengths = []
    for radius in (0.3, 0.8, 1.5):
        plan = way(costmap, (4.0, 4.0, 0.0), (2.5, 4.0, 0.0), any_heading=True, radius=radius)
        lengths.append(keeps_its_arcs(plan, radius, (4.0, 4.0, 0.0), (2.5, 4.0, 0.0), True))
    assert 1.5 < lengths[0] < lengths[1] < lengths[2]


def test_where_there_is_no_room_to_turn_that_is_said_and_who_may_turn_on_the_spot_has_a_way():
    costmap = terrain_of(room(1.0, 8))
    start, goal = (4.0, 0.6, 0.0), (1.5, 0.6, 0.0)
    assert way(costmap, start, goal, any_heading=True).reason is reasons.NO_ROOM_TO_TURN
    assert way(costmap, start, goal, spins=True).reason is None
    assert way(costmap, start, (6.5, 0.6, 0.0)).reason is None


def test_who_may_turn_on_the_spot_bends_no_tighter_between():
    cells = room(6, 6)
    cells[:70, 60:64] = 100
    costmap = terrain_of(cells)
    start, goal = (1.5, 1.0, -2.0), (5.0, 1.0, 1.0)
    plan = way(costmap, start, goal, spins=True)
    along = np.diff(plan.points, axis=0)
    steps, chords = np.hypot(*along.T), np.arctan2(along[:, 1], along[:, 0])
    turns = np.abs(np.angle(np.exp(1j * np.diff(chords))))
    assert (turns <= np.maximum(steps[1:], steps[:-1]) / RADIUS + 1e-3).all()
    assert abs(np.angle(np.exp(1j * (chords[0] - start[2])))) > 1.0  # it turns on the spot first
    assert plan.yaws[-1] == pytest.approx(goal[2])


def test_close_to_a_wall_it_drives_away_along_arcs():
    costmap = terrain_of(room(4, 4))
    start, goal = (0.25, 2.0, pi / 2 - 0.3), (3.0, 3.0, 0.0)
    assert costmap.costs[costmap.cell(*start[:2])] == 0
    plan = way(costmap, start, goal)
    assert plan.reason is None
    keeps_its_arcs(plan, RADIUS, start, goal, False)


def test_in_a_real_building_goals_get_a_path_of_arcs_and_none_is_much_longer_than_without():
    cells, resolution, _, _ = read_ros_map(planning_data() / "ros_maps" / "depot.yaml")
    costmap = terrain_of(cells, resolution)
    regions = costmap.components.labels_in(0, 0, *costmap.costs.shape)
    roomy = costmap.costs == UNIT_COST  # far from walls: there is room for any heading
    places = np.argwhere(roomy & (regions == np.bincount(regions[roomy]).argmax()))
    rng = np.random.default_rng(1)
    for _ in range(8):
        start, goal = (
            (*costmap.centre(*map(int, places[rng.integers(len(places))])), float(yaw)) for yaw in rng.uniform(-3, 3, 2)
        )
        plan = way(costmap, start, goal)
        plain = plan_path(costmap, OUTLINE, Pose2(*start), Pose2(*goal), 0.15, CONFIG)
        assert plan.reason is plain.reason is None
        length = keeps_its_arcs(plan, RADIUS, start, goal, False)
        assert length < 1.1 * np.hypot(*np.diff(plain.points, axis=0).T).sum() + 4 * pi * RADIUS


def test_however_far_apart_its_poses_may_be_a_path_of_arcs_touches_nothing_and_has_its_cost():
    rng = np.random.default_rng(5)
    found = 0
    for _ in range(4):
        costmap = terrain_of(boxes(rng, 8))
        places = rng.permutation(np.argwhere(costmap.costs))[:16].tolist()
        for start, goal in zip(places[:8], places[8:]):
            poses = (Pose2(*costmap.centre(*cell), yaw) for cell, yaw in zip((start, goal), rng.uniform(-pi, pi, 2)))
            config = PlanningConfig(spacing=0.2)
            plan = plan_path(costmap, OUTLINE, *poses, 0.15, config, TurningLimits(RADIUS, False, False))
            if plan.reason is None:
                found += 1
                assert plan.cost > 0
                free_of = (
                    costmap if path_cost(costmap.costs, cells_of(costmap, plan)) >= 0 else costmap.with_min_margin()
                )
                assert path_cost(free_of.costs, cells_of(free_of, plan)) >= 0
    assert found > 5
