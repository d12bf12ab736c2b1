# SPDX-License-Identifier: Apache-2.0
"""The tiled grid: what the reader holds is what the writer sent, wherever and in whatever order tiles come."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from shared.grid import OccupancyGrid
from shared.messages import TILE_CELLS, MapUpdate

tile_places = st.lists(st.tuples(st.integers(-5, 5), st.integers(-5, 5), st.integers(-1, 100)), min_size=1, max_size=6)


def update(places: list[tuple[int, int, int]], version: int, map_id: int = 7) -> MapUpdate:
    unique = {(r, c): value for r, c, value in places}
    rows = np.array([r for r, _ in unique], np.int32)
    columns = np.array([c for _, c in unique], np.int32)
    cells = np.array([np.full(TILE_CELLS**2, value) for value in unique.values()], np.int8)
    return MapUpdate(version, map_id, version, 0.05, rows, columns, cells)


@given(st.lists(tile_places, min_size=1, max_size=4))
def test_the_grid_holds_the_last_value_of_every_tile(updates):
    grid, expected = OccupancyGrid(), {}
    for version, places in enumerate(updates):
        grid.apply(update(places, version))
        expected.update({(r, c): value for r, c, value in places})
    for (r, c), value in expected.items():
        x, y = (c + 0.5) * TILE_CELLS * 0.05, (r + 0.5) * TILE_CELLS * 0.05
        assert grid.cells[grid.cell(x, y)] == value


@given(st.lists(tile_places, min_size=1, max_size=4))
def test_a_late_joiner_with_the_merged_update_holds_the_same_map(updates):
    early, late = OccupancyGrid(), OccupancyGrid()
    merged = None
    for version, places in enumerate(updates):
        message = update(places, version)
        early.apply(message)
        merged = message if merged is None else merged.merged(message)
    late.apply(merged)
    assert (late.first_row, late.first_column, late.version) == (early.first_row, early.first_column, early.version)
    np.testing.assert_array_equal(late.cells, early.cells)


def test_apply_tells_which_cells_changed_and_leaves_older_snapshots_alone():
    grid = OccupancyGrid()
    grid.apply(update([(0, 0, 10), (0, 1, 20)], 1))
    snapshot = grid.cells
    changed = grid.apply(update([(0, 0, 10), (0, 1, 30), (1, 0, -1)], 2))
    assert snapshot.shape == (TILE_CELLS, 2 * TILE_CELLS)
    assert (snapshot[:, TILE_CELLS:] == 20).all()
    assert changed[:TILE_CELLS, TILE_CELLS:].all()
    assert not changed[:, :TILE_CELLS].any()


def test_another_map_replaces_the_whole():
    grid = OccupancyGrid()
    grid.apply(update([(3, 3, 10)], 1))
    grid.apply(update([(0, 0, 20)], 1, map_id=8))
    assert grid.cells.shape == (TILE_CELLS, TILE_CELLS)
    assert (grid.cells == 20).all()


@given(tile_places, st.floats(-15, 15), st.floats(-15, 15))
def test_a_point_lies_in_its_cell(places, x, y):
    grid = OccupancyGrid()
    grid.apply(update(places, 1))
    row, column = grid.cell(x, y)
    cx, cy = grid.centre(row, column)
    assert abs(cx - x) <= 0.025 + 1e-9
    assert abs(cy - y) <= 0.025 + 1e-9
    assert grid.cells_of(np.array([[x, y]])).tolist() == [[row, column]]


def test_update_of_carries_just_the_tiles_with_changes():
    grid = OccupancyGrid()
    grid.apply(update([(0, 0, 10), (1, 1, 20)], 1))
    changed = np.zeros(grid.cells.shape, bool)
    changed[TILE_CELLS + 3, TILE_CELLS + 5] = True
    message = grid.update_of(changed, 9)
    assert (message.rows.tolist(), message.columns.tolist()) == ([1], [1])
    assert (message.cells == 20).all()
