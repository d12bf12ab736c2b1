# SPDX-License-Identifier: Apache-2.0
"""The navigator refuses in its reply what the planner refuses whatever the way, and nothing that it reaches."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.navigator.goal_check import MAX_SINGLE_CHECKS, needs_check, refusal_reason
from services.planner.costmap import CostConfig, GlobalCostmap
from services.planner.hierarchical_search import HierarchicalSearch
from services.planner.planning import PlanningConfig, plan_path
from shared import reasons
from shared.config import load_robot
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import GoalLimits
from tests.unit.services.maps import grid_of, room

X80 = load_robot("x80sv").robot
START = Pose2(1.0, 1.0, 0.0)
PATH = PlanningConfig()


def limits_of(config: CostConfig) -> GoalLimits:
    return GoalLimits(0, config.margin, config.min_margin, PATH.goal_reach, config.beyond)


def both(cells, goal, tolerance=0.15, **costs):
    """What navigator and planner say of a goal."""
    config, grid = CostConfig(**costs), grid_of(cells)
    terrain = GlobalCostmap(config, X80, grid.resolution)
    terrain.update(grid, None)
    plan = plan_path(terrain, HierarchicalSearch(), START, Pose2(*goal), tolerance, PATH)
    return refusal_reason(grid, limits_of(config), X80.inscribed_radius, Pose2(*goal), tolerance), plan.reason


@settings(deadline=None, max_examples=150)
@given(
    st.lists(st.tuples(st.integers(0, 79), st.integers(0, 79), st.integers(1, 12), st.integers(1, 12)), max_size=6),
    st.integers(-100, 600).map(lambda n: n / 100 + 0.003),  # m, not on a cell's edge, where rounding decides
    st.integers(-100, 600).map(lambda n: n / 100 + 0.003),
    st.sampled_from([0.05, 0.15, 0.4, 1.0]),
    st.sampled_from([0.0, 0.5]),
    st.sampled_from(["costly", "allowed", "forbidden"]),
)
def test_nothing_that_the_planner_reaches_is_refused_and_the_reason_is_the_planners(
    blocks, x, y, tolerance, beyond, unknown
):
    cells = room(4, 4)
    for row, column, height, width in blocks:
        cells[row : row + height, column : column + width] = 100
    cells[15:25, 15:25] = 0
    mine, planners = both(cells, (x, y, 0.0), tolerance, beyond_map=beyond, unknown=unknown)
    if mine is not None and planners is not reasons.START_BLOCKED:
        assert planners is mine
    if planners is reasons.GOAL_OUTSIDE:
        assert mine is reasons.GOAL_OUTSIDE


@pytest.mark.parametrize(
    ("goal", "reason"),
    [
        ((2.0, 2.0), None),
        ((2.0, 0.0), reasons.GOAL_BLOCKED),
        ((0.05, 0.05), reasons.GOAL_BLOCKED),
        ((2.0, 0.3), None),  # beside the wall, with room within reach
        ((90.0, 2.0), reasons.GOAL_OUTSIDE),
        ((2.0, -90.0), reasons.GOAL_OUTSIDE),
    ],
)
def test_walls_and_the_outside_are_refused(goal, reason):
    cells = room(4, 4)
    cells[:6], cells[:, :6] = 100, 100
    goal = (goal[0], goal[1] + 0.25) if goal == (2.0, 0.3) else goal
    assert both(cells, (*goal, 0.0))[0] is reason


def test_unknown_space_is_no_wall_and_no_map_refuses_nothing():
    cells = room(4, 4)
    cells[40:, 40:] = -1
    assert both(cells, (3.0, 3.0, 0.0))[0] is None
    limits = limits_of(CostConfig())
    assert refusal_reason(OccupancyGrid(), limits, X80.inscribed_radius, Pose2(1e6, 0.0, 0.0), 0.1) is None


def test_a_tolerance_that_reaches_free_space_makes_a_goal_in_a_wall_one():
    cells = room(4, 4)
    cells[:, :20] = 100
    assert both(cells, (0.5, 2.0, 0.0), 0.15)[0] is reasons.GOAL_BLOCKED
    assert both(cells, (0.5, 2.0, 0.0), 1.0)[0] is None


def test_of_a_long_route_only_poses_without_room_are_looked_at_one_by_one_and_none_is_missed():
    cells = room(4, 4)
    cells[30:50, 30:50] = 100
    grid, limits, radius = grid_of(cells), limits_of(CostConfig()), X80.inscribed_radius
    poses = tuple(Pose2(0.1 * i - 0.503, 0.1 * j - 0.503, 0.0) for i in range(50) for j in range(50))
    assert len(poses) > MAX_SINGLE_CHECKS
    doubts = needs_check(grid, limits, radius, poses)
    assert 0 < doubts.sum() < len(poses)
    assert all(
        refusal_reason(grid, limits, radius, pose, 0.15) is None for pose, doubt in zip(poses, doubts) if not doubt
    )
    assert needs_check(grid, limits, radius, poses[:3]).all()
