# SPDX-License-Identifier: Apache-2.0
"""What lies in a folder is a map to go on with: the stack's own, or one of ROS map_server in any of its modes."""

import itertools
import json
import os
from contextlib import suppress

import numpy as np
import pytest

from services.mapper.maps.map_file import pack_map
from shared.config import UserError
from shared.messages import MapMode
from shared.ros_map import ros_map_files, write_ros_map
from tests.unit.zenav.logs import room_log
from zenav.__main__ import _status
from zenav.client.map_modes import OnMap
from zenav.maps import atomic_folder
from zenav.maps.conversion import write
from zenav.maps.foreign_map import read_map
from zenav.maps.map_files import find_map, grid_of, update_of
from zenav.maps.saved_map import read_saved_map


@pytest.fixture(scope="module")
def mapped(tmp_path_factory):
    """The folder of a map that was made of a log, and the log."""
    folder = tmp_path_factory.mktemp("mapped")
    (folder / "room.log").write_text("\n".join(room_log()) + "\n")
    assert _status(["slam", str(folder / "room.log"), "--out", str(folder / "room")]) == 0
    return folder


@pytest.fixture
def picture(mapped, tmp_path):
    """The folder of its pgm and yaml alone."""
    grid = grid_of(mapped / "room" / "map.yaml")
    write_ros_map(tmp_path / "ros", grid.cells, grid.resolution, grid.x0, grid.y0)
    return tmp_path / "ros"


def test_a_folder_with_a_graph_is_that_map_and_a_yaml_is_its_cells(mapped):
    own = read_saved_map(mapped / "room")
    assert pack_map(read_map(mapped / "room", 0.05)) == pack_map(own)
    cells = read_map(mapped / "room" / "map.yaml", 0.05)
    assert cells.graph.fixed.all()
    np.testing.assert_array_equal(cells.tiles.cells >= 65, own.tiles.cells >= 65)


@pytest.mark.parametrize("n_moved", range(4))
@pytest.mark.parametrize("read", [lambda f: read_map(f, 0.05).tiles, lambda f: update_of(find_map(str(f)))])
def test_a_map_whose_files_were_moved_in_part_is_the_new_one(picture, monkeypatch, read, n_moved):
    """The picture of one map with the origin of another one would put every wall in a wrong place."""
    grid = grid_of(picture / "map.yaml")
    write(picture, grid.cells, grid.resolution, grid.x0, grid.y0)
    moves = itertools.count()

    def crashes(source, target, replace=os.replace):
        if next(moves) == n_moved:
            raise KeyboardInterrupt
        replace(source, target)

    with monkeypatch.context() as patched, suppress(KeyboardInterrupt):
        patched.setattr(atomic_folder.os, "replace", crashes)
        write(picture, np.ascontiguousarray(grid.cells[:, ::-1]), grid.resolution, -32.0, -64.0)
    update = read(picture)
    assert (update.columns.min(), update.rows.min()) == (-10, -20)


@pytest.mark.parametrize("negate", [False, True])
@pytest.mark.parametrize("mode", ["trinary", "scale", "raw"])
def test_the_modes_of_map_server_are_one_map(picture, tmp_path, mode, negate):
    grid = grid_of(picture / "map.yaml")
    folder = tmp_path / "other"
    folder.mkdir()
    files = ros_map_files(grid.cells, grid.resolution, grid.x0, grid.y0, "map", mode, negate)
    for name, content in files.items():
        (folder / name).write_bytes(content)
    a, b = read_map(picture, 0.05), read_map(folder, 0.05)
    np.testing.assert_array_equal(a.tiles.cells >= 65, b.tiles.cells >= 65)
    np.testing.assert_array_equal(a.graph.poses, b.graph.poses)
    assert all((p.points == q.points).all() for p, q in zip(a.keyframes, b.keyframes))


@pytest.mark.parametrize(("value", "told"), [(-1, "no occupied cell"), (100, "no free space")])
def test_a_map_that_tells_nothing_is_refused_by_its_name(tmp_path, value, told):
    write_ros_map(tmp_path, np.full((70, 70), value, np.int8), 0.05, 0.0, 0.0)
    with pytest.raises(UserError, match=told) as error:
        read_map(tmp_path, 0.05)
    assert "map.yaml" in error.value.what
    assert error.value.hint


def test_a_folder_without_a_map_says_what_it_lacks(tmp_path):
    with pytest.raises(UserError, match=r"graph.msgpack"):
        read_map(tmp_path, 0.05)


def test_a_log_is_localised_on_the_cells_of_a_map(mapped, picture, tmp_path):
    log, out = str(mapped / "room.log"), tmp_path / "there"
    assert _status(["slam", log, "--out", str(out), "--mode", "localise", "--map", str(picture)]) == 0
    report = json.loads((out / "report.json").read_text())
    assert report["log_lines"][0].startswith("found on the map")
    own, found = (np.loadtxt(folder / "trajectory.tum")[-10:, 1:3] for folder in (mapped / "room", out))
    assert np.hypot(*(own - found).T).max() < 0.05


def test_a_log_goes_on_with_the_cells_of_a_map(mapped, picture, tmp_path):
    out = tmp_path / "both"
    yaml = str(picture / "map.yaml")
    assert _status(["slam", str(mapped / "room.log"), "--out", str(out), "--mode", "continue", "--map", yaml]) == 0
    before, after = read_map(picture, 0.05), read_saved_map(out)
    assert len(after.keyframes) > len(before.keyframes)
    n = len(before.keyframes)
    np.testing.assert_allclose(after.graph.poses[:n], before.graph.poses, atol=1e-9)


def test_what_a_recording_attaches_of_a_yaml_is_that_picture(picture):
    for path in list(picture.iterdir()):
        path.rename(picture / path.name.replace("map", "hall"))
    on_map = OnMap.of(str(picture / "hall.yaml"), MapMode.LOCALISE, None)
    assert {path.rsplit("/", 1)[1] for path in on_map.files()} == {"hall.yaml", "hall.pgm"}
