# SPDX-License-Identifier: Apache-2.0
"""The tiled grid: what the reader holds is what the writer sent, wherever and in whatever order tiles come."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.codec import CodecError, Envelope, decode, encode
from shared.grid import OccupancyGrid
from shared.messages import MAX_SPAN, TILE_CELLS, MapUpdate

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


@pytest.mark.parametrize("along", ["rows", "columns"])
def test_an_update_that_spans_more_than_a_map_may_is_refused(along):
    def crossing(span):
        far = (span - 1 - 30000, 0) if along == "rows" else (0, span - 1 - 30000)
        near = (-30000, 0) if along == "rows" else (0, -30000)
        return encode(update([(*near, 10), (*far, 10)], 1), Envelope("mapper", "s", 0, 1))

    assert len(decode(MapUpdate, crossing(MAX_SPAN))[0].rows) == 2
    with pytest.raises(CodecError, match="span more than"):
        decode(MapUpdate, crossing(MAX_SPAN + 1))
    with pytest.raises(CodecError, match="span more than"):
        decode(MapUpdate, crossing(60001))


far_places = st.lists(
    st.tuples(st.integers(-1, 1), st.integers(-MAX_SPAN - 9, MAX_SPAN + 9), st.integers(0, 100)), min_size=1, max_size=5
)


@given(st.lists(far_places.filter(lambda places: update(places, 1).problem() is None), min_size=2, max_size=4))
def test_a_map_never_spans_more_than_it_may_and_keeps_what_it_had(updates):
    for transposed in (False, True):
        grid, whole = OccupancyGrid(), None
        for version, places in enumerate(updates):
            message = update([(c, r, v) if transposed else (r, c, v) for r, c, v in places], version)
            before = set(zip(whole.rows, whole.columns)) if whole else set()
            grid.apply(message)
            whole = message if whole is None else whole.merged(message)
            assert before <= set(zip(whole.rows, whole.columns))
            assert whole.problem() is None
            assert max(grid.cells.shape) <= MAX_SPAN * TILE_CELLS
        late = OccupancyGrid()
        late.apply(whole)
        assert (late.first_row, late.first_column) == (grid.first_row, grid.first_column)
        np.testing.assert_array_equal(late.cells, grid.cells)


def test_tiles_too_far_from_the_map_are_left_out_and_the_others_taken():
    grid = OccupancyGrid()
    grid.apply(update([(0, 0, 10)], 1))
    changed = grid.apply(update([(0, MAX_SPAN - 1, 20), (0, MAX_SPAN, 30)], 2))
    assert grid.cells.shape == (TILE_CELLS, MAX_SPAN * TILE_CELLS)
    assert (changed.any(axis=0).nonzero()[0] // TILE_CELLS == MAX_SPAN - 1).all()
    assert not grid.apply(update([(0, -1, 40)], 3)).any()
    assert grid.version == 3
    assert not (grid.cells == 40).any()


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
