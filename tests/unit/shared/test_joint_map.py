# SPDX-License-Identifier: Apache-2.0
"""The own map, and where it is not sure what others know."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared.grid import OccupancyGrid
from shared.joint_map import JointMap, joined
from shared.messages import MAX_SPAN, TILE_CELLS

VALUES = np.array([-1, 0, 25, 26, 64, 65, 100], np.int8)


def a_grid(seed, row, column, shape=(1, 2), resolution=0.05, map_id=1):
    grid = OccupancyGrid(resolution, map_id)
    rng = np.random.default_rng(seed)
    grid.first_row, grid.first_column, grid.version = row, column, 1
    grid.cells = rng.choice(VALUES, (shape[0] * TILE_CELLS, shape[1] * TILE_CELLS))
    return grid


def whole(grid):
    return grid.update_of(np.ones(grid.cells.shape, bool), 0)


def value(grid, row, column):
    r, c = row - grid.first_row * TILE_CELLS, column - grid.first_column * TILE_CELLS
    return int(grid.cells[r, c]) if grid.holds(r, c) else -1


@settings(max_examples=30)
@given(st.integers(0, 2**32), st.integers(-2, 2), st.integers(-2, 2))
def test_a_joint_cell_is_the_own_one_where_that_is_sure_and_else_that_of_the_others_if_they_know_it(seed, row, column):
    own, others = a_grid(seed, 0, 0), a_grid(seed + 1, row, column, (2, 1))
    both = joined(own, others)
    before = own.cells.copy()
    for r in range(-2 * TILE_CELLS, 4 * TILE_CELLS, 3):
        for c in range(-2 * TILE_CELLS, 4 * TILE_CELLS, 3):
            mine, theirs = value(own, r, c), value(others, r, c)
            sure = 0 <= mine <= 25 or mine >= 65
            assert value(both, r, c) == (mine if sure or theirs == -1 else theirs)
    assert (own.cells == before).all()


@settings(max_examples=30)
@given(st.lists(st.tuples(st.booleans(), st.integers(0, 9), st.integers(-1, 1), st.integers(-1, 1)), max_size=6))
def test_what_changed_is_what_differs_from_before(steps):
    maps = JointMap()
    for of_others, seed, row, column in steps:
        before = maps.grid.first_row, maps.grid.first_column, maps.grid.cells.copy()
        update = whole(a_grid(seed, row, column))
        changed = maps.apply_others(update) if of_others else maps.apply(update)
        assert changed.shape == maps.grid.cells.shape
        if before[:2] == (maps.grid.first_row, maps.grid.first_column) and before[2].shape == changed.shape:
            assert (changed == (before[2] != maps.grid.cells)).all()


def test_without_others_the_grid_is_the_own_one_and_it_is_so_again_once_they_are_gone():
    maps = JointMap()
    maps.apply(whole(a_grid(1, 0, 0)))
    assert maps.grid is maps.own
    maps.apply_others(whole(a_grid(2, 0, 3)))
    assert maps.grid is not maps.own
    maps.apply_others(whole(a_grid(3, 0, 3, (0, 0), map_id=2)))
    assert maps.grid is maps.own


@pytest.mark.parametrize("others", [a_grid(1, 0, MAX_SPAN), a_grid(1, 0, 1, resolution=0.1)], ids=["far", "coarse"])
def test_a_map_that_does_not_fit_changes_nothing(others):
    own = a_grid(0, 0, 0)
    assert joined(own, others) is own
