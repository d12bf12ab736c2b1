# SPDX-License-Identifier: Apache-2.0
"""What other robots know, in cells of the own map."""

from dataclasses import asdict, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.navigator.others_map import OthersMap, packed_map
from shared import messages
from shared import sample_messages as sample
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import TILE_CELLS

S = 1_000_000_000
poses = st.builds(Pose2, st.floats(-9, 9), st.floats(-9, 9), st.floats(-3, 3))


def a_grid(seed, row=0, column=0, shape=(1, 2)):
    grid = OccupancyGrid(0.05, 1)
    grid.first_row, grid.first_column = row, column
    values = np.array([-1, 0, 25, 26, 64, 65, 100], np.int8)
    grid.cells = np.random.default_rng(seed).choice(values, (shape[0] * TILE_CELLS, shape[1] * TILE_CELLS))
    return grid


def told(grid, common_from_map=sample.ORIGIN, robot="blue"):
    """What a robot with this map says."""
    share = sample.exploration_share(S, robot, ("red",), common_from_map)
    return replace(share, **asdict(packed_map(grid)))


def kind(value):
    return 100 if value >= 65 else 0 if 0 <= value <= 25 else -1


@settings(max_examples=25)
@given(poses, poses, st.integers(0, 2**32))
def test_each_own_cell_has_what_the_other_map_has_at_its_centre(common_from_red, common_from_blue, seed):
    theirs, others = a_grid(seed, -1, 2), OthersMap()
    update = others.update([told(theirs, common_from_blue)], common_from_red, 0.05, S)
    assert update is not None
    grid = OccupancyGrid(update.resolution, update.map_id)
    grid.apply(update)
    theirs_from_own = common_from_blue.inverse() @ common_from_red
    n_known = 0
    for row in range(0, grid.cells.shape[0], 5):
        for column in range(0, grid.cells.shape[1], 5):
            point = theirs_from_own @ Pose2(*grid.centre(row, column))
            offsets = [(dx, dy) for dx in (-1e-6, 1e-6) for dy in (-1e-6, 1e-6)]  # on an edge either cell will do
            found = [theirs.cell(point.x + dx, point.y + dy) for dx, dy in offsets]
            wanted = {kind(theirs.cells[cell]) if theirs.holds(*cell) else -1 for cell in found}
            assert grid.cells[row, column] in wanted
            n_known += grid.cells[row, column] >= 0
    assert n_known > 100


def test_a_large_map_is_sent_in_larger_cells_that_are_occupied_with_any_occupied_one(monkeypatch):
    grid = a_grid(1, 3, -2, (2, 2))
    whole = told(grid)
    monkeypatch.setattr("services.navigator.others_map.MAX_COARSE_CELLS", 2 * TILE_CELLS * TILE_CELLS)
    coarse = told(grid)
    assert (whole.cell, whole.rows, whole.columns) == (0.05, *grid.cells.shape)
    assert (coarse.cell, coarse.first_row, coarse.first_column) == (0.1, 3 * TILE_CELLS // 2, -2 * TILE_CELLS // 2)
    blocks = grid.cells.reshape(coarse.rows, 2, coarse.columns, 2)
    assert ((coarse.coarse_cells() == 100) == (blocks >= 65).any(axis=(1, 3))).all()


def test_only_what_changed_is_said_and_what_a_silent_robot_knew_is_unknown_again():
    others, share = OthersMap(), told(a_grid(1))
    first = others.update([share], Pose2(), 0.05, S)
    assert others.update([replace(share, sequence=9, x=3.0)], Pose2(), 0.05, 2 * S) is None
    more = a_grid(1, 0, 0, (1, 3))
    more.cells[:, : 2 * TILE_CELLS] = a_grid(1).cells
    second = others.update([told(more)], Pose2(), 0.05, 3 * S)
    assert set(zip(second.rows.tolist(), second.columns.tolist(), strict=True)) == {(0, 2)}
    third = others.update([], Pose2(), 0.05, 4 * S)
    assert len(third.rows) == 3
    assert (others.grid.cells == -1).all()
    assert first.map_id == second.map_id == third.map_id
    assert first.version < second.version < third.version


def test_of_two_robots_the_first_that_is_sure_of_a_cell_counts():
    blue, green = a_grid(1), a_grid(2)
    others = OthersMap()
    others.update([told(green, robot="green"), told(blue)], Pose2(), 0.05, S)
    wanted = [kind(b) if kind(b) >= 0 else kind(g) for b, g in zip(blue.cells.flat, green.cells.flat, strict=True)]
    assert others.grid.cells.shape == blue.cells.shape
    assert others.grid.cells.ravel().tolist() == wanted


@pytest.mark.parametrize(
    "fields",
    [
        {"cells": b"no zlib"},
        {"rows": 5},
        {"rows": messages.MAX_COARSE_CELLS, "columns": messages.MAX_COARSE_CELLS},
        {"common_from_map": Pose2(1e5, 0.0)},
    ],
    ids=["not packed", "another size", "too many", "far away"],
)
def test_a_map_that_cannot_be_read_or_is_too_far_away_is_left_out(fields):
    others = OthersMap()
    near = told(a_grid(1))
    others.update([near], Pose2(), 0.05, S)
    before = others.grid.cells
    others.update([near, replace(told(a_grid(2), robot="green"), **fields)], Pose2(), 0.05, 2 * S)
    assert (others.grid.cells == before).all()
