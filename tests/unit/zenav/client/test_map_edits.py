# SPDX-License-Identifier: Apache-2.0
"""`zenav map erase|wall|edits|undo` on a saved map: both of its pictures and its graph have the edits."""

import numpy as np
import pytest

from shared.config import UserError
from shared.grid import OCCUPIED_FROM
from shared.messages import EditKind
from tests.unit.zenav.logs import room_log
from zenav.__main__ import _status
from zenav.client.map_edits import edit_of
from zenav.maps.map_files import grid_of
from zenav.maps.saved_map import read_saved_map


@pytest.fixture(scope="module")
def mapped(tmp_path_factory):
    """The working folder with a map of its own, `room`."""
    folder = tmp_path_factory.mktemp("mapped")
    (folder / "room.log").write_text("\n".join(room_log()) + "\n")
    assert _status(["slam", str(folder / "room.log"), "--out", str(folder / "maps" / "room")]) == 0
    return folder


@pytest.fixture
def room(mapped, monkeypatch):
    monkeypatch.chdir(mapped)
    yield mapped / "maps" / "room"
    if read_saved_map(mapped / "maps" / "room").edits:
        assert _status(["map", "undo", "--all", "--map", "room"]) == 0


def inside(room) -> tuple[float, float]:
    """A free place of the room's picture, m."""
    grid = grid_of(room / "map.yaml")
    row, column = np.argwhere(grid.free)[len(np.argwhere(grid.free)) // 2]
    return grid.centre(int(row), int(column))


def test_a_wall_is_in_the_picture_and_the_graph_until_it_is_undone(room, capsys):
    before, (x, y) = grid_of(room / "map.yaml"), inside(room)
    assert _status(["map", "wall", f"{x},{y}", f"{x + 0.3},{y}", "--map", "room"]) == 0
    assert capsys.readouterr().out.split() == [
        "1", "wall", "0.1", "m", "wide", f"{x:.2f},{y:.2f}", f"{x + 0.3:.2f},{y:.2f}",
    ]  # fmt: skip
    after = grid_of(room / "map.yaml")
    assert after.cells[after.cell(x, y)] == 100
    assert (after.cells >= OCCUPIED_FROM).sum() > (before.cells >= OCCUPIED_FROM).sum()
    (wall,) = read_saved_map(room).edits
    assert (wall.id, wall.kind) == (1, EditKind.WALL)
    assert _status(["map", "undo", "--map", "room"]) == 0
    np.testing.assert_array_equal(grid_of(room / "map.yaml").cells, before.cells)


def test_what_is_erased_is_free_and_each_edit_is_undone_by_its_number(room, capsys):
    before = grid_of(room / "map.yaml")
    row, column = np.argwhere(before.occupied)[0].tolist()
    x, y = before.centre(row, column)
    assert _status(["map", "erase", f"{x},{y}", "--width", "0.2", "--map", "room"]) == 0
    after = grid_of(room / "map.yaml")
    assert after.cells[after.cell(x, y)] == 0
    x, y = inside(room)
    assert _status(["map", "wall", f"{x},{y}", f"{x},{y + 0.2}", "--map", "room"]) == 0
    assert _status(["map", "undo", "1", "--map", "room"]) == 0
    capsys.readouterr()
    assert _status(["map", "edits", "--map", "room"]) == 0
    assert capsys.readouterr().out.split()[:2] == ["2", "wall"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["wall", "1,2", "--width", "0"], "a wall without a width"),
        (["erase", "1,2", "3,4"], "an edit of 2 points"),
        (["wall", "1", "2,3"], "'1' is no point"),
        (["wall", "900,0", "901,0"], "outside the map"),
        (["undo"], "the map has no edits"),
        (["undo", "7"], "there is no edit 7"),
    ],
)
def test_a_wrong_argument_is_one_line_with_a_hint_and_changes_nothing(room, capsys, arguments, words):
    before = (room / "graph.msgpack").read_bytes()
    assert _status(["map", *arguments, "--map", "room"]) == 2
    errors = capsys.readouterr().err
    assert words in errors
    assert "hint:" in errors
    assert (room / "graph.msgpack").read_bytes() == before


def test_a_map_of_cells_alone_keeps_no_edits(room, capsys, tmp_path):
    assert _status(["map", "convert", "room", str(tmp_path / "cells")]) == 0
    assert _status(["map", "wall", "0,0", "1,0", "--map", str(tmp_path / "cells")]) == 2
    assert "cells alone" in capsys.readouterr().err


def test_a_width_beyond_the_largest_one_is_refused():
    with pytest.raises(UserError, match="width"):
        edit_of(EditKind.WALL, ["0,0", "1,0"], 9.0)
