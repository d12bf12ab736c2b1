# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.planner.costmap import CostConfig, GlobalCostmap
from services.planner.hierarchical_search import HierarchicalSearch
from services.planner.planning import PlanningConfig, plan_path
from services.planner.ray_cost import path_cost
from shared import reasons
from shared.config import load_robot
from shared.geometry import Pose2
from shared.ros_map import read_ros_map
from tests.unit.services.maps import boxes, drawn, grid_of, message, planning_data, room

X80 = load_robot("x80sv").robot
OUTLINE = HierarchicalSearch()
CONFIG = PlanningConfig()


def terrain_of(cells, **settings_):
    costmap = GlobalCostmap(CostConfig(**settings_), X80, 0.05)
    costmap.update(grid_of(cells), None)
    return costmap


def way(costmap, start, goal, tolerance=0.15):
    return plan_path(costmap, OUTLINE, Pose2(*start), Pose2(*goal), tolerance, CONFIG)


def clearance(costmap, plan):
    """m from each of the plan's points to the centre of the nearest occupied cell (at most the inflation radius)."""
    row_column = ((plan.points - costmap.origin) / costmap.resolution).astype(int)[:, ::-1] - costmap.pad
    return costmap.distance[tuple(row_column.T)] * costmap.resolution


def touches_nothing(costmap, plan):
    return path_cost(costmap.costs, (plan.points - costmap.origin) / costmap.resolution) >= 0


def wall_with_door(at, width=0.8):
    """Two rooms of 4 x 4 m, a wall at x = 4 m with a door from y = at."""
    cells = room(4, 8)
    cells[:, 80:84] = 100
    cells[round(at / 0.05) : round((at + width) / 0.05), 80:84] = 0
    return cells


def test_a_gap_within_the_margin_is_driven_only_where_there_is_no_other_way():
    """0.5 m for a robot that is 0.4 m wide and wants 0.54 m."""
    cells = wall_with_door(0.4, 0.5)
    alone = way(terrain_of(cells), (1.0, 0.7, 0.0), (7.0, 0.7, 0.0))
    assert alone.reason is None
    assert clearance(terrain_of(cells), alone).min() >= 0.2 + 0.03 - 1e-6
    cells[60:76, 80:84] = 0  # a wide door, 4 m around
    around = way(terrain_of(cells), (1.0, 0.7, 0.0), (7.0, 0.7, 0.0))
    assert around.points[:, 1].max() > 3.0
    assert clearance(terrain_of(cells), around).min() >= 0.2 + 0.07 - 1e-6


def test_a_gap_in_which_the_robot_hardly_fits_is_no_way():
    assert way(terrain_of(wall_with_door(0.4, 0.4)), (1.0, 0.6, 0), (7.0, 0.6, 0)).reason is reasons.UNREACHABLE


@pytest.mark.parametrize(("start", "goal"), [(1.0, 7.0), (4.1, 7.0), (1.0, 4.1), (3.7, 4.6)])
def test_through_a_narrow_corridor_there_is_a_way_from_anywhere(start, goal):
    """0.5 m for a robot that is 0.4 m wide and wants 0.54 m, 2 m long."""
    cells = room(4, 8)
    cells[:, 60:100] = 100
    cells[35:45, 60:100] = 0
    costmap = terrain_of(cells)
    plan = way(costmap, (start, 2.0, 0.0), (goal, 2.0, 0.0))
    assert plan.reason is None
    assert plan.points[-1] == pytest.approx((goal, 2.0), abs=0.16)
    assert clearance(costmap, plan).min() >= 0.2 + 0.03 - 1e-6


@pytest.mark.parametrize("resolution", [0.05, 0.1, 0.25])
def test_no_path_comes_nearer_than_the_robot_s_half_width_whatever_the_cells(resolution):
    rng = np.random.default_rng(3)
    n = 64
    cells = np.zeros((n, n), np.int8)
    cells[[0, -1]] = cells[:, [0, -1]] = 100
    for row, column, height, width in rng.integers((4, 4, 1, 1), (56, 56, 6, 6), (12, 4)):
        cells[row : row + height, column : column + width] = 100
    costmap = GlobalCostmap(CostConfig(clearance_weight=0.0), X80, resolution)
    costmap.update(grid_of(cells, resolution), None)
    rows, columns = np.nonzero(costmap.cells == 100)
    places = rng.permutation(np.argwhere(costmap.costs))[:60]
    found = 0
    for start, goal in zip(places[:30].tolist(), places[30:].tolist()):
        plan = plan_path(costmap, OUTLINE, Pose2(*costmap.centre(*start)), Pose2(*costmap.centre(*goal)), 0.15, CONFIG)
        if plan.reason is None:
            found += 1
            x, y = plan.points[:, :1] / resolution, plan.points[:, 1:] / resolution
            gaps = np.abs(x - columns - 0.5) - 0.5, np.abs(y - rows - 0.5) - 0.5
            assert np.hypot(*np.maximum(gaps, 0.0)).min() * resolution >= X80.inscribed_radius
    assert found > 5


def test_a_path_starts_at_the_robot_and_ends_in_the_goal_with_its_heading():
    plan = way(terrain_of(wall_with_door(1.6)), (1.0, 1.0, 0.0), (7.0, 3.0, -2.0))
    assert plan.reason is None
    assert plan.points[0] == pytest.approx((1.0, 1.0))
    assert plan.points[-1] == pytest.approx((7.0, 3.0))
    assert plan.yaws[-1] == pytest.approx(-2.0)
    assert (np.hypot(*np.diff(plan.points, axis=0).T) < 0.051).all()
    ahead = np.diff(plan.points, axis=0)
    assert plan.yaws[:-1] == pytest.approx(np.arctan2(ahead[:, 1], ahead[:, 0]))


def test_the_path_keeps_clearance_where_there_is_room():
    costmap = terrain_of(wall_with_door(1.6))
    plan = way(costmap, (0.4, 1.0, 0.0), (7.6, 1.0, 0.0))
    through = (plan.points[:, 0] > 3.6) & (plan.points[:, 0] < 4.6)
    open_ = (plan.points[:, 0] > 1.0) & (plan.points[:, 0] < 3.2)
    away = clearance(costmap, plan)
    assert away[through].min() >= 0.35  # the middle of the door
    assert away[open_].min() >= 0.6
    assert touches_nothing(costmap, plan)


def test_no_bend_is_sharp():
    plan = way(terrain_of(wall_with_door(2.5)), (1.0, 1.0, 0.0), (7.0, 1.0, 0.0))
    turns = np.abs(np.angle(np.exp(1j * np.diff(plan.yaws[:-1]))))
    assert turns.max() < 0.35


def test_a_goal_beside_a_wall_is_moved_to_the_nearest_place_with_room():
    costmap = terrain_of(room(3, 3))
    plan = way(costmap, (2.0, 2.0, 0.0), (0.2, 1.5, 1.0))
    assert plan.reason is None
    moved = np.hypot(plan.points[-1][0] - 0.2, plan.points[-1][1] - 1.5)
    assert 0 < moved <= CONFIG.goal_reach
    assert plan.yaws[-1] == pytest.approx(1.0)
    rows, columns = np.nonzero(costmap.costs)
    x0, y0 = costmap.origin
    nearest = np.hypot(x0 + (columns + 0.5) * 0.05 - 0.2, y0 + (rows + 0.5) * 0.05 - 1.5).min()
    assert moved == pytest.approx(nearest)


@pytest.mark.parametrize(
    ("goal", "tolerance", "reason"),
    [
        ((0.05, 1.5), 0.15, reasons.GOAL_BLOCKED),
        ((-3.0, 1.5), 0.15, reasons.GOAL_OUTSIDE),
        ((1e5, -1e5), 0.15, reasons.GOAL_OUTSIDE),
        ((0.05, 1.5), 0.6, None),
    ],
)
def test_a_goal_without_room_is_refused_with_the_reason(goal, tolerance, reason):
    assert way(terrain_of(room(3, 3)), (2.0, 2.0, 0.0), (*goal, 0.0), tolerance).reason is reason


def test_a_goal_in_unknown_space_is_refused_only_where_that_is_forbidden():
    cells = drawn("..????", 20).repeat(2, axis=0)
    for policy, reason in (("costly", None), ("allowed", None), ("forbidden", reasons.GOAL_UNKNOWN)):
        assert way(terrain_of(cells, unknown=policy), (1.0, 1.0, 0), (5.0, 1.0, 0)).reason is reason


def test_a_goal_behind_walls_is_unreachable():
    assert way(terrain_of(wall_with_door(1, 0.0)), (1.0, 1.0, 0), (7.0, 1.0, 0)).reason is reasons.UNREACHABLE


def test_a_robot_outside_of_the_map_has_a_reason_of_its_own():
    assert way(terrain_of(room(3, 3)), (-5.0, 1.0, 0), (1.0, 1.0, 0)).reason is reasons.START_OUTSIDE


def test_a_robot_close_to_a_wall_leaves_it_straight_away():
    costmap = terrain_of(room(3, 3))
    plan = way(costmap, (0.22, 1.5, 0.0), (2.5, 1.5, 0.0))
    assert plan.reason is None
    assert plan.points[0] == pytest.approx((0.22, 1.5))
    assert plan.points[-1] == pytest.approx((2.5, 1.5))
    assert (np.diff(clearance(costmap, plan)[:6]) >= 0).all()


def test_a_robot_that_the_map_puts_into_a_wall_gets_out_on_its_own_side():
    cells = wall_with_door(3.0)
    plan = way(terrain_of(cells), (3.99, 1.0, 0.0), (1.0, 1.0, 0.0))
    assert plan.reason is None
    assert plan.points[:, 0].max() < 4.2


def test_a_robot_walled_in_is_blocked():
    cells = room(3, 3)
    cells[:40, :40] = 100
    cells[19:23, 19:23] = 0
    assert way(terrain_of(cells), (1.05, 1.05, 0), (2.5, 2.5, 0)).reason is reasons.START_BLOCKED


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32))
def test_in_any_clutter_the_path_touches_nothing_and_ends_within_reach_of_the_goal(seed):
    rng = np.random.default_rng(seed)
    costmap = terrain_of(boxes(rng, 12))
    free = np.argwhere(costmap.costs)
    for _ in range(4):
        (r0, c0), (r1, c1) = free[rng.integers(len(free), size=2)]
        start, goal = (*costmap.centre(int(r0), int(c0)), 0.0), (*costmap.centre(int(r1), int(c1)), 0.0)
        plan = way(costmap, start, goal)
        connected = costmap.components.at(r0, c0) == costmap.components.at(r1, c1)
        if plan.reason is None:
            assert touches_nothing(costmap, plan)
            assert np.hypot(*(plan.points[-1] - goal[:2])) <= (1e-9 if connected else CONFIG.goal_reach)
        else:
            assert not connected
            assert plan.reason is reasons.UNREACHABLE


@pytest.mark.parametrize("name", ["depot", "willow_garage"])
def test_in_real_buildings_every_reachable_goal_gets_a_path_with_clearance(name):
    cells, resolution, _, _ = read_ros_map(planning_data() / "ros_maps" / f"{name}.yaml")
    grid = grid_of(cells, resolution)
    costmap = GlobalCostmap(CostConfig(), X80, resolution)
    costmap.update(grid, None)
    known = np.pad(grid.free, costmap.pad) & (costmap.costs > 0)
    regions = costmap.components.labels_in(0, 0, *costmap.costs.shape)
    largest = np.bincount(regions[known]).argmax()
    places = np.argwhere(known & (regions == largest))
    rng = np.random.default_rng(1)
    for _ in range(20):
        start, goal = (
            Pose2(*costmap.centre(*map(int, places[rng.integers(len(places))])), float(yaw))
            for yaw in rng.uniform(-3, 3, 2)
        )
        plan = plan_path(costmap, OUTLINE, start, goal, 0.15, CONFIG)
        assert plan.reason is None
        assert touches_nothing(costmap, plan)
        assert clearance(costmap, plan).min() >= X80.inscribed_radius


def test_where_the_goal_is_walled_off_by_an_update_it_becomes_unreachable():
    cells = wall_with_door(1.6)
    grid = grid_of(cells)
    costmap = GlobalCostmap(CostConfig(), X80, 0.05)
    costmap.update(grid, None)
    assert way(costmap, (1.0, 1.0, 0), (7.0, 1.0, 0)).reason is None
    closed = cells.copy()
    closed[:, 80:84] = 100
    costmap.update(grid, grid.apply(message(closed, version=2, since=cells)))
    assert way(costmap, (1.0, 1.0, 0), (7.0, 1.0, 0)).reason is reasons.UNREACHABLE
