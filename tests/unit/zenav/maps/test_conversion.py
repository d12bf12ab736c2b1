# SPDX-License-Identifier: Apache-2.0
"""`zenav map convert`: maps of ROS map_server and the stack's, each as the other."""

from math import cos, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_array_equal

from shared.config import UserError
from shared.ros_map import read_ros_map, ros_map_files
from zenav.__main__ import _status
from zenav.maps.conversion import convert
from zenav.maps.map_files import grid_of
from zenav.maps.rotated_map import axis_aligned

CELLS = np.full((20, 30), 0, np.int8)
CELLS[5, 3:25] = 100
CELLS[12:, 28:] = -1

maps = arrays(np.int8, st.tuples(st.integers(1, 25), st.integers(1, 25)), elements=st.sampled_from([-1, 0, 0, 0, 100]))


def saved(folder, cells=CELLS, yaw=0.0, **more):
    folder.mkdir()
    for name, content in ros_map_files(cells, 0.05, -0.5, 1.0, **more).items():
        (folder / name).write_bytes(content.replace(b", 0]", f", {yaw}]".encode()))
    return folder / "map.yaml"


@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
@pytest.mark.parametrize("negate", [False, True])
def test_a_map_of_any_mode_becomes_one_of_any_other(mode, negate, tmp_path):
    path = saved(tmp_path / "in", mode=mode, negate=negate)
    for other in ("trinary", "scale", "raw"):
        convert(str(path), tmp_path / other, other, not negate, False)
        found, *place = read_ros_map(tmp_path / other / "map.yaml")
        assert_array_equal(found, CELLS)
        assert place == [0.05, -0.5, 1.0]


def test_what_was_brought_in_is_a_map_that_the_stack_loads(tmp_path, monkeypatch, capsys):
    path = saved(tmp_path / "in")
    monkeypatch.chdir(tmp_path)
    assert _status(["map", "convert", str(path), "maps/office"]) == 0
    assert "1.5 x 1.0 m" in capsys.readouterr().out
    assert _status(["map", "show", "office"]) == 0
    grid = grid_of(tmp_path / "maps" / "office" / "map.yaml")
    row, column = grid.cell(-0.5 + 10.5 * 0.05, 1.0 + 5.5 * 0.05)
    assert grid.cells[row, column] == 100
    assert (grid.cells == 100).sum() == 22


def test_a_map_that_is_there_is_not_written_over_unless_that_is_said(tmp_path):
    path = saved(tmp_path / "in")
    convert(str(path), tmp_path / "out", "trinary", False, False)
    (tmp_path / "out" / "graph.msgpack").write_bytes(b"of another map")
    with pytest.raises(UserError, match="there is a map") as error:
        convert(str(path), tmp_path / "out", "scale", False, False)
    assert "--force" in error.value.hint
    convert(str(path), tmp_path / "out", "scale", False, True)
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["map.png", "map.yaml"]
    with pytest.raises(UserError, match="what is to be read"):
        convert(str(path), path.parent, "raw", False, True)


def test_a_map_of_another_name_keeps_its_picture(tmp_path):
    path = saved(tmp_path / "in").rename(tmp_path / "in" / "floor.yaml")
    (tmp_path / "link").symlink_to(path.parent)
    before = {file.name: file.read_bytes() for file in path.parent.iterdir()}
    for out in (path.parent, tmp_path / "link", tmp_path / "in" / ".." / "in"):
        with pytest.raises(UserError, match="what is to be read"):
            convert(str(path), out, "trinary", True, True)
    assert {file.name: file.read_bytes() for file in path.parent.iterdir()} == before


def test_a_turned_map_is_refused_with_the_command_that_turns_it(tmp_path, capsys):
    path = saved(tmp_path / "in", yaw=0.5)
    with pytest.raises(UserError, match=r"turned by 0\.5 rad") as error:
        read_ros_map(path)
    assert f"zenav map convert {path}" in error.value.hint
    convert(str(path), tmp_path / "out", "trinary", False, False)
    assert "turned by 28.6 degrees" in capsys.readouterr().err
    found, resolution, x0, y0 = read_ros_map(tmp_path / "out" / "map.yaml")
    x, y = 14.5 * 0.05, 5.5 * 0.05  # in the middle of the wall
    at = -0.5 + cos(0.5) * x - sin(0.5) * y, 1.0 + sin(0.5) * x + cos(0.5) * y
    assert found[int((at[1] - y0) / resolution), int((at[0] - x0) / resolution)] == 100


@settings(max_examples=40)
@given(maps, st.integers(-2, 2))
def test_quarter_turns_are_exact(cells, quarters):
    found, *_ = axis_aligned(cells, 0.05, 0.0, 0.0, quarters * pi / 2)
    assert_array_equal(found, np.rot90(cells, -quarters))


@settings(max_examples=60)
@given(maps, st.floats(-pi, pi), st.floats(-9, 9), st.floats(-9, 9))
def test_no_wall_is_lost_or_made_up_by_turning(cells, yaw, x0, y0):
    """Each occupied cell's middle lies in an occupied cell afterwards, and none is occupied far from where one was.

    A look-up is up to 0.25 sqrt(2) of a cell from the cell's middle. The middle of the cell at that place is up to
    sqrt(0.5) of a cell farther: 1.061 in all.
    """
    found, left, low = axis_aligned(cells, 0.1, x0, y0, yaw)
    before = np.argwhere(cells == 100)[:, ::-1] * 0.1 + 0.05
    before = before @ np.array([(cos(yaw), sin(yaw)), (-sin(yaw), cos(yaw))]) + (x0, y0)
    after = np.argwhere(found == 100)[:, ::-1] * 0.1 + 0.05 + (left, low)
    if not len(before):
        assert not len(after)
        return
    apart = np.hypot(*(before[:, None] - after[None]).transpose(2, 0, 1))
    assert apart.min(axis=1).max() < 0.0708
    assert apart.min(axis=0).max() < 0.1061
