# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from scipy import ndimage

from services.planner.costmap import UNIT_COST, CostConfig, GlobalCostmap, tile_groups
from services.planner.search import GridSearch
from shared.config import load_robot
from tests.unit.services.maps import drawn, grid_of, message, room

X80, JACKAL = load_robot("x80sv").robot, load_robot("jackal").robot

MARGIN = CostConfig().margin  # m


def terrain_of(cells, robot=X80, resolution=0.05, **settings_):
    costmap = GlobalCostmap(CostConfig(**settings_), robot, resolution)
    costmap.update(grid_of(cells, resolution), None)
    return costmap


@pytest.mark.parametrize("robot", [X80, JACKAL])
def test_cost_falls_with_the_distance_to_the_wall_and_ends_at_the_inflation_radius(robot):
    costmap = terrain_of(room(3, 3), robot)
    away = costmap.costs[costmap.pad + 2 : costmap.pad + 32, costmap.pad + 32].astype(int)  # from the wall inwards
    n_blocked = np.count_nonzero(away == 0)
    distance = (np.arange(30) + 1) * 0.05  # from the wall's last cell
    assert (distance[:n_blocked] < robot.inscribed_radius + MARGIN).all()
    assert distance[n_blocked] >= robot.inscribed_radius + MARGIN - 1e-9
    outer = away[n_blocked:]
    assert (np.diff(outer) <= 0).all()
    assert (outer[distance[n_blocked:] >= 1.0] == UNIT_COST).all()
    assert (outer[distance[n_blocked:] < 0.9] > UNIT_COST).all()


def test_where_the_robot_cannot_turn_it_costs_more():
    plain, narrow = (terrain_of(room(3, 3), JACKAL, narrow_weight=w) for w in (0.0, 3.0))
    dearer = (narrow.costs > plain.costs)[plain.pad :, plain.pad :][:60, 32]
    distance = np.abs(np.arange(60) - 1) * 0.05
    inscribed, circumscribed = JACKAL.inscribed_radius + MARGIN, JACKAL.circumscribed_radius + MARGIN
    assert (dearer[:32] == ((distance >= inscribed) & (distance < circumscribed))[:32]).all()


def test_unknown_space_is_by_policy():
    cells = drawn("....????....", 10).repeat(10, axis=0)
    known, unknown = (50, 20), (50, 60)
    costs = {}
    for policy in ("allowed", "costly", "forbidden"):
        costmap = terrain_of(cells, unknown=policy)
        costs[policy] = [
            int(costmap.costs[row + costmap.pad, column + costmap.pad]) for row, column in (known, unknown)
        ]
    assert costs["allowed"] == [UNIT_COST, UNIT_COST]
    assert costs["costly"] == [UNIT_COST, 3 * UNIT_COST]
    assert costs["forbidden"] == [UNIT_COST, 0]


def test_cells_that_are_neither_free_nor_occupied_are_unknown():
    cells = np.full((64, 64), 50, np.int8)
    assert terrain_of(cells, unknown="forbidden").costs.max() == 0


@pytest.mark.parametrize("beyond", [0.0, 1.0])
def test_outside_of_the_map_is_unknown_space_as_far_as_configured(beyond):
    costmap = terrain_of(room(2, 2), beyond_map=beyond)
    assert costmap.contains(*costmap.cell(-0.01, 1.0)) == (beyond > 0)
    assert not costmap.contains(*costmap.cell(-1.2, 1.0))
    assert (costmap.costs[[0, -1]] == 0).all()
    assert (costmap.costs[:, [0, -1]] == 0).all()


@pytest.mark.parametrize("robot", [X80, JACKAL])
def test_a_door_of_80_cm_lets_the_robot_through(robot):
    cells = room(3, 5)
    cells[:, 50:54] = 100
    cells[30:46, 50:54] = 0
    costmap = terrain_of(cells, robot)
    west, east = (costmap.components.at(*costmap.cell(x, 1.5)) for x in (1.0, 4.0))
    assert west == east != 0


def test_a_slit_of_30_cm_does_not():
    cells = room(3, 5)
    cells[:, 50:54] = 100
    cells[30:36, 50:54] = 0
    costmap = terrain_of(cells)
    assert costmap.components.at(*costmap.cell(1.0, 1.5)) != costmap.components.at(*costmap.cell(4.0, 1.5))


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32), st.floats(0.0, 0.08))
def test_regions_are_what_the_search_can_reach(seed, share):
    rng = np.random.default_rng(seed)
    cells = np.where(rng.random((24, 24)) < share, 100, 0).astype(np.int8)
    costmap = terrain_of(cells, resolution=0.1, unknown="forbidden")
    search, free = GridSearch(), np.argwhere(costmap.costs)
    for _ in range(10 if len(free) else 0):
        a, b = (tuple(map(int, free[rng.integers(len(free))])) for _ in range(2))
        way = search.cheapest_path(costmap.costs, a, b, UNIT_COST, costmap.max_cost)
        assert (len(way) > 0) == (costmap.components.at(*a) == costmap.components.at(*b))


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 191), st.integers(0, 127), st.sampled_from([100, 0, -1])), max_size=6),
    st.sampled_from([0.003, 0.1, 0.5]),
    st.sampled_from([X80, JACKAL]),
)
def test_updating_by_changes_equals_starting_from_the_start(changes, share, robot):
    """Costs, connected components and the abstract graph, with the margin and with the minimum clearance."""
    rng = np.random.default_rng(len(changes))
    resolution = 0.05 if share < 0.1 else 0.4
    cells = np.where(rng.random((192, 128)) < share, 100, 0).astype(np.int8)
    grid = grid_of(cells, resolution)
    costmap = GlobalCostmap(CostConfig(), robot, resolution)
    costmap.update(grid, None)
    costmap.with_min_margin()
    for version, (row, column, percent) in enumerate(changes):
        before = cells.copy()
        cells[row : row + 3, column : column + 3] = percent
        costmap.update(grid, grid.apply(message(cells, resolution, version=version + 2, since=before)))
    rebuilt = terrain_of(cells, robot, resolution)
    for one, other in ((costmap, rebuilt), (costmap.with_min_margin(), rebuilt.with_min_margin())):
        whole = 0, 0, *other.costs.shape
        assert (one.costs == other.costs).all()
        assert (one.components.labels_in(*whole) == other.components.labels_in(*whole)).all()
        for name in ("parts", "representatives", "crossing", "edges"):
            assert (getattr(one.graph, name) == getattr(other.graph, name)).all(), name


@given(arrays(np.bool_, array_shapes(min_dims=2, max_dims=2, max_side=9)))
def test_groups_of_tiles_and_their_order_are_those_of_scipy(tiles):
    expected = [
        (rows.start, columns.start, rows.stop, columns.stop)
        for rows, columns in ndimage.find_objects(ndimage.label(tiles, np.ones((3, 3)))[0])
    ]
    assert tile_groups(tiles) == expected
