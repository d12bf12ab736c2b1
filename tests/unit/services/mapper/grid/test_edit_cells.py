# SPDX-License-Identifier: Apache-2.0
"""Edits of a map: erased known cells are free and cells of walls are occupied, whatever is drawn below them."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from services.mapper.grid.edit_cells import (
    ERASED,
    WALL,
    edit_masks,
    edited_rows_and_columns,
    edits_problem,
    erased_points,
    with_edits,
    without_walls,
)
from services.mapper.grid.occupancy import Occupancy, OccupancyConfig
from shared.grid import OccupancyGrid
from shared.messages import EditKind, MapEdit
from shared.polygon import contains, distances_to_outline

CONFIG = OccupancyConfig()
coordinates = st.floats(-4, 4).map(lambda v: round(v, 3) + 0.00037)  # off the cells' borders and centres
points = st.tuples(coordinates, coordinates)
beams = st.lists(st.tuples(coordinates, coordinates, coordinates, coordinates), min_size=1, max_size=8)
scans = st.lists(beams, min_size=1, max_size=4)


def edit(kind, corners, width, id_=1):
    xs, ys = np.array(corners, float).reshape(-1, 2).T
    return MapEdit(0, id_, EditKind(kind), xs.copy(), ys.copy(), width)


polygons = st.lists(points, min_size=3, max_size=6).map(lambda corners: edit("erase", corners, 0.0))
strokes = st.builds(
    edit, st.sampled_from(["erase", "wall"]), st.lists(points, min_size=1, max_size=5), st.floats(0.01, 0.6)
)
edits = st.lists(polygons | strokes, max_size=4)


def drawn(scans):
    """A grid with scans of beams [(ox, oy, ex, ey)]."""
    grid = Occupancy(CONFIG, 1)
    for scan in scans:
        rows = np.array(scan)
        ends = np.ascontiguousarray(rows[:, 2:])
        grid.insert_scan(np.ascontiguousarray(rows[:, :2]), ends, np.full_like(ends, np.nan))
    grid.update_cells()
    return grid


def dense(update):
    grid = OccupancyGrid(update.resolution, update.map_id)
    grid.apply(update)
    return grid


def cells_at(update, cells):
    """Percent of cells (n, 2), rows and columns from the origin of `map`; -1 where there is no tile."""
    grid = dense(update)
    rows, columns = (cells - np.array((grid.first_row, grid.first_column)) * 64).T
    inside = (rows >= 0) & (columns >= 0) & (rows < grid.cells.shape[0]) & (columns < grid.cells.shape[1])
    values = np.full(len(cells), -1)
    values[inside] = grid.cells[rows[inside], columns[inside]]
    return values, inside


def assert_law(edited, raw, edits):
    """Walls are occupied, other erased cells are free if known, and nothing else differs from the raw grid."""
    walls = np.concatenate(
        [np.zeros((0, 2), int), *(edited_rows_and_columns(e, 0.05) for e in edits if e.kind == "wall")]
    )
    erased = np.concatenate(
        [np.zeros((0, 2), int), *(edited_rows_and_columns(e, 0.05) for e in edits if e.kind == "erase")]
    )
    wall_cells = set(map(tuple, walls.tolist()))
    erased = np.array([cell for cell in erased.tolist() if tuple(cell) not in wall_cells]).reshape(-1, 2).astype(int)
    values, inside = cells_at(edited, walls)
    assert (values[inside] == 100).all()
    before, after = cells_at(raw, erased)[0], cells_at(edited, erased)[0]
    assert_array_equal(after, np.where(before >= 0, 0, -1))
    touched = wall_cells | set(map(tuple, erased.tolist()))
    everywhere = (
        np.argwhere(np.ones_like(dense(raw).cells)) + np.array((dense(raw).first_row, dense(raw).first_column)) * 64
    )
    others = np.array([cell for cell in everywhere.tolist() if tuple(cell) not in touched])
    assert_array_equal(cells_at(edited, others)[0], cells_at(raw, others)[0])


@settings(max_examples=12, deadline=None)
@given(scans, scans, edits, edits)
def test_erased_cells_are_free_and_walls_occupied_after_any_change_and_redrawing(before, after, first, second):
    grid = drawn(before)
    grid.set_edits(edit_masks(first, 0.05))
    grid.update_cells()
    assert_law(grid.all_tiles(0), drawn(before).all_tiles(0), first)
    grid.set_edits(edit_masks(second, 0.05))
    grid.update_cells()
    assert_law(grid.all_tiles(0), drawn(before).all_tiles(0), second)
    redrawn = drawn(before + after)
    grid.replace_with(redrawn)
    grid.set_edits(edit_masks(second, 0.05))
    grid.update_cells()
    assert_law(grid.all_tiles(0), drawn(before + after).all_tiles(0), second)


@settings(max_examples=25, deadline=None)
@given(scans, edits, scans)
def test_without_its_edits_a_grid_is_what_the_laser_drew(scans, edits, later):
    grid, raw = drawn(scans), drawn(scans)
    grid.set_edits(edit_masks(edits, 0.05))
    grid.update_cells()
    below = grid.tiles_without_edits(0)
    assert_array_equal(dense(below).cells, dense(raw.all_tiles(0)).cells)
    assert_law(with_edits(below, edits), raw.all_tiles(0), edits)
    grid.set_edits({})
    assert_array_equal(grid.log_odds[: len(raw.tile_index)], raw.log_odds[: len(raw.tile_index)])


@settings(max_examples=30, deadline=None)
@given(scans, edits)
def test_a_grid_that_was_published_with_edits_gets_back_what_lies_below_them(scans, edits):
    raw = drawn(scans)
    grid = Occupancy(CONFIG, 1)
    grid.load(without_walls(with_edits(raw.all_tiles(0), edits), edits))
    grid.set_edits(edit_masks(edits, 0.05))
    grid.load_below_edits(raw.all_tiles(0))
    grid.update_cells()
    assert_array_equal(dense(grid.tiles_without_edits(0)).cells, dense(raw.all_tiles(0)).cells)


def test_scans_are_compared_with_what_was_erased_but_never_with_walls():
    grid = drawn([[(0.01, 0.01, 2.01, 0.01)]] * 6)
    origins, ends = np.array([[0.01, 0.01]]), np.array([[2.01, 0.01]])
    behind = np.array([[3.01, 0.01]])
    assert grid.is_near_occupied(ends)[0]
    assert grid.crosses_occupied(origins, behind)[0]
    wall = edit("wall", [(1, -1), (1, 1)], 0.1)
    grid.set_edits(edit_masks([wall, edit("erase", [(2, 0)], 0.3)], 0.05))
    assert not grid.crosses_occupied(origins, behind)[0], "neither the phantom nor the wall"
    assert not grid.is_near_occupied(ends)[0]
    assert not grid.is_near_occupied(np.array([[1.01, 0.01]]))[0]
    grid.set_edits({})
    assert grid.is_near_occupied(ends)[0], "undone"


@settings(max_examples=60)
@given(st.lists(points, min_size=3, max_size=7))
def test_a_polygon_holds_the_cells_that_brute_force_finds(corners):
    erase = edit("erase", corners, 0.0)
    cells = {tuple(cell) for cell in edited_rows_and_columns(erase, 0.05).tolist()}
    rows, columns = np.mgrid[-90:90, -90:90]
    centres = np.column_stack((columns.ravel() + 0.5, rows.ravel() + 0.5)) * 0.05
    outline = np.array(corners)
    clear = distances_to_outline(outline, centres) > 1e-6
    inside = contains(outline, centres)
    expected = {(int(r), int(c)) for r, c in zip(rows.ravel()[inside & clear], columns.ravel()[inside & clear])}
    doubtful = {(int(r), int(c)) for r, c in zip(rows.ravel()[~clear], columns.ravel()[~clear])}
    assert expected - doubtful == cells - doubtful


@settings(max_examples=60)
@given(st.lists(points, min_size=2, max_size=4), st.floats(0.001, 0.3))
def test_no_line_leaks_a_wall_holds_every_cell_that_it_crosses(corners, width):
    cells = {tuple(cell) for cell in edited_rows_and_columns(edit("wall", corners, width), 0.05).tolist()}
    for (x0, y0), (x1, y1) in pairwise(corners):
        along = np.linspace(0, 1, 400)
        crossed = np.floor(np.column_stack((y0 + along * (y1 - y0), x0 + along * (x1 - x0))) / 0.05).astype(int)
        assert {tuple(cell) for cell in crossed.tolist()} <= cells


def test_points_are_erased_where_their_cells_are():
    masks = edit_masks(
        [edit("erase", [(0, 0), (1, 0), (1, 1), (0, 1)], 0.0), edit("wall", [(0.5, 0), (0.5, 1)], 0.1)], 0.05
    )
    assert erased_points(masks, np.array([(0.2, 0.2), (0.5, 0.5), (1.2, 0.2), (-9.0, 70.0)]), 0.05).tolist() == [
        True, False, False, False,
    ]  # fmt: skip
    assert masks[0, 0][10, 10] == WALL
    assert masks[0, 0][10, 2] == ERASED


@pytest.mark.parametrize(
    ("edits", "words"),
    [
        ([edit("wall", [(0, 0), (1, 1)], 0.1)] * 257, "256 edits"),
        ([edit("erase", [(0, 0), (400, 0), (400, 400)], 0.0)], "m2"),
        ([edit("wall", [(0, 0), (300, 300)], 0.1)], "m2"),
    ],
)
def test_too_many_or_too_large_edits_are_refused(edits, words):
    assert words in edits_problem(edits)


def test_a_wall_far_from_the_map_adds_no_tile():
    grid = drawn([[(0.0, 0.0, 1.0, 0.5)]])
    n = len(grid.tile_index)
    grid.set_edits(edit_masks([edit("wall", [(900, 900), (901, 901)], 0.1)], 0.05))
    assert len(grid.tile_index) == n
