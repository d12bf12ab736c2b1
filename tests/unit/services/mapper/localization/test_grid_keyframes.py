# SPDX-License-Identifier: Apache-2.0
"""A grid of another program is as good as a map of the mapper's own: the robot is found on it, and it is continued."""

from dataclasses import replace
from math import hypot

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.mapper.grid.occupancy import Occupancy, OccupancyConfig
from services.mapper.localization.grid_keyframes import nearest_places, saved_map_from_tiles, viewpoints
from services.mapper.maps.map_file import pack_map, unpack_map
from shared import requests
from shared.config import UserError
from shared.geometry import Pose2
from shared.grid import FREE_UP_TO, OCCUPIED_FROM, OccupancyGrid, update_of_cells
from shared.messages import Localization, MapMode
from shared.requests import LoadMap, StartMap
from tests.unit.services.mapper.buildings import ALIKE, SHUT, START, Building, drives, off, put, saved_by
from tests.unit.services.mapper.rooms import ROOM, MapRequester, RoomDrive

SIZES = [0.025, 0.05, 0.1]


def grown(update):
    grid = OccupancyGrid(update.resolution, update.map_id)
    grid.apply(update)
    return grid


def drawn_from(segments, resolution, x0=-4.0, y0=-3.0, x1=5.0, y1=4.0, inside=(0.0, 0.0)):
    """The tiles of a grid of line segments: what can be reached from `inside` is free, the rest unknown."""
    cells = np.full((round((y1 - y0) / resolution), round((x1 - x0) / resolution)), -1, np.int8)
    for ax, ay, bx, by in segments:
        n = int(hypot(bx - ax, by - ay) / resolution * 4) + 2
        columns = np.floor((np.linspace(ax, bx, n) - x0) / resolution).astype(int)
        rows = np.floor((np.linspace(ay, by, n) - y0) / resolution).astype(int)
        cells[rows, columns] = 100
    reached = [(int((inside[1] - y0) / resolution), int((inside[0] - x0) / resolution))]
    while reached:
        row, column = reached.pop()
        if cells[row, column] == -1:
            cells[row, column] = 0
            reached += [(row + 1, column), (row - 1, column), (row, column + 1), (row, column - 1)]
    return update_of_cells(cells, resolution, x0, y0)


@pytest.fixture(scope="module")
def building():
    """Two rooms that look alike at a corridor that does not: the tiles of its map, and where that lies in it."""
    alike = Building(ALIKE, (START.x, START.y))
    driven = RoomDrive(ALIKE, noise=0.01)
    driven.true = START
    for _ in drives(driven, alike, 60, np.random.default_rng(0)):
        pass
    return alike, saved_by(driven).tiles, driven.first


def in_cells_of(tiles, size):
    """The tiles in larger cells, each as occupied as the most occupied in it."""
    grid = grown(tiles)
    step = round(size / tiles.resolution)
    h, w = grid.cells.shape
    cells = grid.cells.reshape(h // step, step, w // step, step).max(axis=(1, 3))
    return update_of_cells(cells, step * tiles.resolution, grid.x0, grid.y0)


@pytest.mark.parametrize("size", [0.05, 0.1])
def test_from_anywhere_it_is_found_by_driving_and_never_at_a_wrong_place(building, size):
    alike, tiles, first = building
    saved = saved_map_from_tiles(in_cells_of(tiles, size), 0.05)
    found = []
    for seed in range(4):
        rng = np.random.default_rng(seed)
        driven = put(ALIKE, saved, alike.anywhere(rng))
        n_known = 0
        for _ in drives(driven, alike, 10, rng):
            if driven.poses[-1].state is Localization.GOOD:
                n_known += 1
                away, turn = off(driven, first)
                assert away < 0.15
                assert turn < 0.06
            if n_known > 5:
                break
        found.append(n_known > 0)
    assert sum(found) >= 3, "from one of these places no wall but those of the like room is seen"


@pytest.mark.parametrize("seed", [0, 1])
def test_where_it_could_be_in_either_of_two_rooms_nothing_is_claimed(building, seed):
    """Both doors are shut: the robot drives on and on in one of two rooms that are alike."""
    _, tiles, _ = building
    rng = np.random.default_rng(seed)
    driven = put(SHUT, saved_map_from_tiles(tiles, 0.05), Pose2(3, 2.5, 0.3) if seed else Pose2(10, 2.5, 2.0))
    for _ in drives(driven, Building(SHUT, (driven.true.x, driven.true.y)), 12, rng):
        assert driven.poses[-1].state is Localization.LOST


def test_carried_away_it_notices_and_is_found_again(building):
    alike, tiles, first = building
    saved, rng = saved_map_from_tiles(tiles, 0.05), np.random.default_rng(5)
    driven = put(ALIKE, saved, Pose2(6.5, 6.0, 0.0))
    for _ in drives(driven, alike, 10, rng):
        if driven.poses[-1].state is Localization.GOOD:
            break
    assert driven.poses[-1].state is Localization.GOOD
    driven.true = Pose2(3.0, 2.5, 1.0)
    noticed = None
    for k in range(15):
        driven.step(Pose2())
        if driven.poses[-1].state is Localization.LOST:
            noticed = 0.2 * (k + 1)
            break
    assert noticed is not None, "within 3 s"
    for _ in drives(driven, alike, 10, rng):
        if driven.poses[-1].state is Localization.GOOD:
            break
    assert driven.poses[-1].state is Localization.GOOD
    assert off(driven, first)[0] < 0.15


def test_it_goes_on_and_what_was_loaded_stays_where_it_was(building):
    alike, tiles, first = building
    saved, rng = saved_map_from_tiles(tiles, 0.05), np.random.default_rng(2)
    driven = put(ALIKE, saved, START, fixed=False)
    for _ in drives(driven, alike, 20, rng):
        pass
    assert driven.poses[-1].state is Localization.GOOD
    assert off(driven, first)[0] < 0.1
    driven.take(driven.mapper.slam.jobs.optimize())
    driven.now += 3600 * 10**9
    for _ in range(3):
        driven.publish_map()
    gone_on = driven.mapper.slam.snapshot()
    n = len(saved.keyframes)
    assert len(gone_on.keyframes) > n
    assert gone_on.graph.loop.sum() > 10
    np.testing.assert_allclose(gone_on.graph.poses[:n], saved.graph.poses, atol=1e-9)
    before, after = grown(saved.tiles), grown(gone_on.tiles)
    walls = np.argwhere(before.occupied)[:, ::-1] * 0.05 + (before.x0 + 0.025, before.y0 + 0.025)
    rows, columns = after.cells_of(walls).T
    near = np.zeros(len(walls), bool)
    for dr in (-1, 0, 1):
        for dc in (-1, 0, 1):
            near |= after.occupied[rows + dr, columns + dc]
    assert near.mean() > 0.97, "its walls are those of the map that was loaded"


@pytest.mark.parametrize("size", SIZES)
def test_keyframes_see_the_walls_where_they_are_from_the_side_of_the_viewpoint(size):
    saved = saved_map_from_tiles(drawn_from(ROOM, size), 0.05)
    assert saved.tiles.resolution == 0.05
    n_wrong = n = 0
    for keyframe, row in zip(saved.keyframes, saved.graph.poses.tolist()):
        at = Pose2(*row)
        points = at @ keyframe.points.astype(float)
        along = ROOM[:, 2:] - ROOM[:, :2]
        lengths = np.hypot(*along.T)
        t = np.clip(((points[:, None] - ROOM[None, :, :2]) * along).sum(axis=2) / lengths**2, 0, 1)
        away = np.hypot(*np.moveaxis(points[:, None] - ROOM[None, :, :2] - t[..., None] * along, 2, 0))
        cell = max(size, 0.05)
        assert away.min(axis=1).max() < 1.25 * cell
        assert np.quantile(away.min(axis=1), 0.98) < cell
        assert np.median(away.min(axis=1)) < 0.51 * cell, "a cell bounds it to half its size"
        has = keyframe.normals.any(axis=1)
        assert (np.einsum("ij,ij->i", keyframe.normals, keyframe.points)[has] < 0).all()
        i = away.argmin(axis=1)
        across = np.abs(np.einsum("ij,ij->i", keyframe.normals, along[i] / lengths[i, None]))
        n_wrong, n = n_wrong + int((across[has] > 0.3).sum()), n + int(has.sum())
    assert n > 500
    assert n_wrong < 0.03 * n


def test_drawn_again_it_is_the_same_map_and_what_was_unknown_stays_unknown(building):
    _, tiles, _ = building
    saved = saved_map_from_tiles(tiles, 0.05)
    again = Occupancy(OccupancyConfig(), 1)
    for keyframe, row in zip(saved.keyframes, saved.graph.poses.tolist()):
        keyframe.draw(again, Pose2(*row))
    again.update_cells()
    whole = again.all_tiles(0)
    source, other = grown(tiles), grown(whole)
    at = np.argwhere(np.ones(source.cells.shape, bool))
    rows, columns = other.cells_of((at[:, ::-1] + 0.5) * 0.05 + (source.x0, source.y0)).T
    inside = (rows >= 0) & (columns >= 0) & (rows < other.cells.shape[0]) & (columns < other.cells.shape[1])
    cells = np.full(len(at), -1)
    cells[inside] = other.cells[rows[inside], columns[inside]]
    before = source.cells.ravel()
    free, occupied = (before >= 0) & (before <= FREE_UP_TO), before >= OCCUPIED_FROM
    unknown = before < 0
    assert ((cells >= 0) & (cells <= FREE_UP_TO))[free].mean() > 0.999
    assert (cells[free] < OCCUPIED_FROM).all()
    beside = np.zeros_like(source.free)
    beside[1:-1, 1:-1] = source.free[2:, 1:-1] | source.free[:-2, 1:-1] | source.free[1:-1, 2:] | source.free[1:-1, :-2]
    assert (cells[occupied & beside.ravel()] >= OCCUPIED_FROM).all()
    assert (cells[unknown] < 0).mean() > 0.999


def test_a_thin_wall_has_two_sides():
    segments = np.array([(-3, -2, 4, -2), (4, -2, 4, 3), (4, 3, -3, 3), (-3, 3, -3, -2), (0.5, -1.0, 0.5, 2.0)])
    saved = saved_map_from_tiles(drawn_from(segments, 0.05), 0.05)
    sides = set()
    for keyframe, row in zip(saved.keyframes, saved.graph.poses.tolist()):
        points = Pose2(*row) @ keyframe.points.astype(float)
        on = (np.abs(points[:, 0] - 0.525) < 0.03) & (points[:, 1] > -0.7) & (points[:, 1] < 1.7)
        sides |= {(row[0] > 0.5, float(np.sign(x))) for x in keyframe.normals[on, 0] if abs(x) > 0.8}
    assert sides == {(True, 1.0), (False, -1.0)}


@pytest.mark.parametrize("size", SIZES)
def test_cells_of_another_size_are_brought_to_the_mappers_in_the_same_place(size):
    tiles = drawn_from(ROOM, size)
    before, after = grown(tiles), grown(saved_map_from_tiles(tiles, 0.05).tiles)
    for kind in ("free", "occupied"):
        a = np.argwhere(getattr(before, kind)) * size + (before.y0, before.x0)
        b = np.argwhere(getattr(after, kind)) * 0.05 + (after.y0, after.x0)
        np.testing.assert_allclose(a.min(axis=0), b.min(axis=0), atol=0.051)
        np.testing.assert_allclose(a.max(axis=0) + size, b.max(axis=0) + 0.05, atol=0.051)
        if size >= 0.05:
            assert len(b) * 0.05**2 == pytest.approx(len(a) * size**2)


def test_the_same_tiles_give_the_same_bytes_and_they_are_read_again():
    tiles = drawn_from(ROOM, 0.05)
    content = pack_map(saved_map_from_tiles(tiles, 0.05))
    assert content == pack_map(saved_map_from_tiles(tiles, 0.05))
    again = unpack_map(content, "test")
    assert pack_map(again) == content
    assert again.graph.fixed.all()


def test_viewpoints_are_free_far_from_walls_and_in_every_room():
    free = grown(drawn_from(ROOM, 0.05)).free
    found = viewpoints(free, 0.05)
    assert all(free[row, column] for row, column in found)
    rooms = np.zeros((40, 90), bool)
    rooms[5:35, 5:40] = rooms[5:35, 50:85] = True  # two rooms in one block, without a door
    assert {bool(column > 45) for _, column in viewpoints(rooms, 0.05)} == {True, False}
    assert len(viewpoints(np.ones((2000, 2000), bool), 0.5)) <= 3000, "of a square kilometre"


@pytest.mark.parametrize(
    ("cells", "told"),
    [
        (np.full((64, 64), -1, np.int8), "no occupied cell"),
        (np.zeros((64, 64), np.int8), "no occupied cell"),
        (np.full((64, 64), 100, np.int8), "no free space"),
    ],
)
def test_a_map_that_tells_nothing_is_refused_with_a_hint(cells, told):
    with pytest.raises(UserError, match=told) as error:
        saved_map_from_tiles(update_of_cells(cells, 0.05, 0.0, 0.0), 0.05)
    assert "zenav map show" in error.value.hint


def loaded(segments, tiles, pose, at, mode):
    """A mapper that was given tiles near a pose, in a mode."""
    driven = RoomDrive(segments, noise=0.01)
    driven.true = pose
    asker = MapRequester(driven)
    assert asker.ask(requests.LOAD_MAP, LoadMap(driven.now, tiles, at)).accepted
    assert asker.ask(requests.START_MAP, StartMap(driven.now, mode, 0, ())).accepted
    return driven


@pytest.mark.parametrize("wrong", [False, True])
def test_tiles_that_are_loaded_near_a_pose_get_keyframes_and_the_robot_is_looked_for_on_all_of_them(building, wrong):
    alike, tiles, first = building
    rng = np.random.default_rng(4)
    at = Pose2(3.0, 2.5, 0.5)
    driven = loaded(ALIKE, tiles, at, first.inverse() @ (START if wrong else at), MapMode.LOCALISE)
    found = None
    for metres in drives(driven, alike, 14, rng):
        if driven.poses[-1].state is Localization.GOOD and driven.mapper.back_end.n_loops > 0:
            found = metres
            break
    assert found is not None
    assert off(driven, first)[0] < 0.15
    assert ("lost: looking for the robot on the whole map" in driven.logs) is wrong
    np.testing.assert_array_equal(driven.mapper.slam.grid.all_tiles(0).cells, tiles.cells)


def test_tiles_that_are_loaded_are_continued(building):
    alike, tiles, first = building
    driven = loaded(ALIKE, tiles, START, first.inverse() @ START, MapMode.CONTINUE)
    for _ in drives(driven, alike, 12, np.random.default_rng(4)):
        pass
    assert driven.poses[-1].state is Localization.GOOD
    assert off(driven, first)[0] < 0.1
    back_end = driven.mapper.back_end
    assert back_end.n_loops > 5
    assert len(back_end.keyframes) > back_end.first_row > 20


def test_a_map_whose_tiles_lie_too_far_apart_is_refused():
    tiles = drawn_from(ROOM, 0.05)
    with pytest.raises(UserError, match="too far apart"):
        saved_map_from_tiles(replace(tiles, rows=np.linspace(-30000, 30000, len(tiles.rows)).astype(np.int32)), 0.05)


def test_a_map_of_large_cells_is_refused_before_it_takes_gigabytes_of_the_mappers_cells():
    cells = np.zeros((500, 500), np.int8)
    cells[0] = 100
    with pytest.raises(UserError, match="too far apart") as error:
        saved_map_from_tiles(update_of_cells(cells, 1.0, 0.0, 0.0), 0.05)
    assert "`resolution`" in error.value.hint


@settings(deadline=None)
@given(st.integers(1, 12), st.integers(1, 4), st.integers(0, 2**32 - 1))
def test_the_nearest_places_are_those_of_a_sorted_list(n_places, count, seed):
    rng, count = np.random.default_rng(seed), min(count, n_places)
    points, places = rng.uniform(-5, 5, (7, 2)), rng.uniform(-5, 5, (n_places, 2))
    distances = np.hypot(*(points[:, None] - places).transpose(2, 0, 1))
    assert np.array_equal(nearest_places(points, places, count), np.argsort(distances, axis=1)[:, :count])
