# SPDX-License-Identifier: Apache-2.0
"""Edits of the present map: they stay in every mode, move with the keyframes beside them, and bad ones are refused."""

from dataclasses import replace

import numpy as np
import pytest

from services.mapper.grid.edit_cells import edited_rows_and_columns
from services.mapper.grid.map_edits import MapEdits
from services.mapper.maps.map_file import pack_map, unpack_map
from shared import requests, topics
from shared.geometry import Pose2
from shared.messages import EditKind, Localization, MapEdit, MapMode, MapState
from shared.requests import EditMap, NameMap
from shared.topics import Publication
from tests.unit.services.mapper.rooms import LAP
from tests.unit.services.mapper.test_modes import Lap


def edit(kind, corners, width):
    xs, ys = np.array(corners, float).reshape(-1, 2).T
    return MapEdit(0, 0, EditKind(kind), xs.copy(), ys.copy(), width)


WALL = edit("wall", [(7.0, -0.6), (7.0, 0.6)], 0.1)
ERASE = edit("erase", [(3.0, -1.5), (5.0, -1.5), (5.0, 0.2), (3.0, 0.2)], 0.0)
"""With a part of the ring's outer wall, and of a box that stands at it."""


class EditedLap(Lap):
    """A robot in the ring that keeps the published state of its map."""

    def __init__(self):
        super().__init__()
        self.states: list[MapState] = []
        take = self.driven.take

        def keep(out):
            items = list(out or ())
            self.states += [i.message for i in items if isinstance(i, Publication) and i.topic is topics.MAP_STATE]
            take(items)

        self.driven.take = keep

    def edit(self, *edits, **values):
        return self.asker.ask(requests.EDIT_MAP, EditMap(self.driven.now, tuple(edits), **values))

    def name(self, name):
        return self.asker.ask(requests.NAME_MAP, NameMap(self.driven.now, name))

    @property
    def map_now(self):
        self.driven.publish_map()
        return self.driven.mapper.slam.grid.all_tiles(0)

    def values(self, edit):
        """Percent of an edit's cells on the published map; cells without a tile are left out."""
        cells = edited_rows_and_columns(edit, 0.05)
        grid = self.driven.grid
        rows, columns = (cells - np.array((grid.first_row, grid.first_column)) * 64).T
        return grid.cells[rows, columns]


@pytest.fixture(scope="module")
def mapped():
    """The ring, mapped once round, and edited."""
    lap = EditedLap()
    lap.go(LAP + 20)
    before = lap.values(ERASE)
    assert (before >= 65).sum() > 20, "there is something to erase"
    assert lap.edit(WALL, ERASE).accepted
    lap.driven.publish_map()
    return lap, lap.fetched(), lap.driven.first


def assert_edited(lap):
    erased = lap.values(ERASE)
    assert (erased[erased >= 0] == 0).all()
    assert (erased == 0).sum() > 100
    assert (lap.values(WALL) == 100).all()


def test_edits_are_published_with_ids_and_shown_at_once(mapped):
    lap, _, _ = mapped
    assert [(e.id, e.kind) for e in lap.states[-1].edits] == [(1, EditKind.WALL), (2, EditKind.ERASE)]
    assert lap.states[-1].map_id == lap.driven.maps[-1].map_id
    assert_edited(lap)


def test_a_saved_map_has_its_edits_and_below_them_what_the_laser_saw(mapped):
    saved = unpack_map(mapped[1], "saved")
    assert [e.id for e in saved.edits] == [1, 2]
    plain = EditedLap()
    plain.go(LAP + 20)
    np.testing.assert_array_equal(saved.tiles.cells, unpack_map(plain.fetched(), "plain").tiles.cells)


@pytest.mark.parametrize("mode", [MapMode.LOCALISE, MapMode.CONTINUE])
def test_a_loaded_map_has_its_edits_and_scans_do_not_remove_them(mapped, mode):
    _, content, first = mapped
    lap = EditedLap()
    lap.start(mode, content, first.inverse() @ lap.driven.true)
    lap.go(40)
    assert lap.state is Localization.GOOD
    assert_edited(lap)
    if mode is MapMode.LOCALISE:
        assert lap.fetched() == content, "to the byte"
        assert lap.driven.mapper.slam.kidnap_detector.agreement > 0.9, "no beam through a wall contradicts the map"
        return
    lap.driven.mapper.back_end.map_shift = np.inf  # draws the map again
    lap.driven.now += 20 * 10**9
    lap.driven.publish_map()
    lap.driven.publish_map()
    assert not lap.driven.mapper.slam.is_drawing
    assert_edited(lap)


def test_undone_edits_leave_what_the_laser_saw(mapped):
    _, content, first = mapped
    lap = EditedLap()
    lap.start(MapMode.LOCALISE, content, first.inverse() @ lap.driven.true)
    assert lap.edit(remove=(2,)).accepted
    assert (lap.values(ERASE) >= 65).sum() > 20
    assert (lap.values(WALL) == 100).all()
    assert [e.id for e in lap.states[-1].edits] == [1]
    assert lap.edit(clear=True).accepted
    assert lap.states[-1].edits == ()
    saved = unpack_map(content, "")
    assert lap.fetched() == pack_map(replace(saved, edits=()))


def test_a_virtual_wall_changes_no_pose_on_a_saved_map(mapped):
    _, content, first = mapped
    walls = tuple(
        replace(edit("wall", [(x, -0.9), (x, 0.9)], 0.1), id=k) for k, x in enumerate((2.0, 4.0, 6.0, 8.0, 10.0))
    )
    poses = []
    for edits in ((), walls):
        lap = EditedLap()
        at = first.inverse() @ lap.driven.true
        lap.start(MapMode.LOCALISE, pack_map(replace(unpack_map(content, ""), edits=edits)), at)
        lap.go(60)
        poses.append([pose.map_from_base for pose in lap.driven.poses])
    assert poses[0] == poses[1]


def test_modes_of_the_present_map_keep_edits_and_name_and_a_new_map_has_none(mapped):
    _, content, first = mapped
    lap = EditedLap()
    lap.start(MapMode.CONTINUE, content, first.inverse() @ lap.driven.true)
    lap.go(10)
    assert lap.name("ring").accepted
    for mode, at in (
        (MapMode.LOCALISE, None),
        (MapMode.CONTINUE, None),
        (MapMode.LOCALISE, lap.driven.poses[-1].map_from_base),
    ):
        lap.start(mode, at=at)
        lap.go(2)
        assert (lap.states[-1].name, len(lap.states[-1].edits)) == ("ring", 2)
        assert_edited(lap)
    lap.start(MapMode.MAP)
    lap.go(3)
    assert (lap.states[-1].name, lap.states[-1].edits) == ("", ())
    assert lap.states[-1].map_id == lap.driven.maps[-1].map_id


def test_a_map_without_name_and_edits_publishes_no_state():
    lap = EditedLap()
    lap.go(5)
    assert lap.states == []


@pytest.mark.parametrize(
    ("edits", "values", "reason"),
    [
        ([edit("wall", [(7.0, 0.0), (700.0, 0.0)], 0.1)], {}, "bad_request"),
        ([edit("wall", [(1.0, 0.0), (1.5, 0.0)], 0.1)] * 257, {}, "bad_request"),
        ([WALL], {"map_id": 5}, "other_map"),
    ],
)
def test_bad_edits_are_refused_with_a_reason_and_change_nothing(mapped, edits, values, reason):
    lap, _, _ = mapped
    n = len(lap.states)
    reply = lap.edit(*edits, **values)
    assert not reply.accepted
    assert reply.reason == reason
    assert len(lap.states) == n
    assert_edited(lap)


@pytest.mark.parametrize(
    "bad",
    [edit("wall", [(0, 0), (1, 0)], 0.0), edit("erase", [(0, 0), (1, 0)], 0.0), edit("erase", [(0, 0)] * 257, 0.1)],
)
def test_edits_that_draw_nothing_or_too_much_are_no_messages(bad):
    assert bad.problem() is not None


def test_without_a_map_there_is_nothing_to_edit():
    reply = EditedLap().edit(WALL)
    assert (reply.accepted, reply.reason) == (False, "no_map")


def test_an_edit_moves_with_its_nearest_keyframe():
    nodes, poses = np.array([4, 7]), np.array([[0.0, 0, 0], [10.0, 0, 0]])
    edits = MapEdits()
    edits.add([edit("wall", [(1.0, 0.0), (1.0, 1.0)], 0.1), edit("wall", [(9.0, 0.0), (9.0, 1.0)], 0.1)])
    assert not edits.follow(nodes, poses)
    assert edits.anchor_nodes == {4, 7}
    corrected = poses + np.array([[0.0, 0, 0], [0.5, -0.25, np.pi / 2]])
    n = edits.n_changes
    assert edits.follow(nodes, corrected)
    assert edits.n_changes == n + 1
    np.testing.assert_allclose(edits.edits[0].xs, [1.0, 1.0])
    expected = Pose2(10.5, -0.25, np.pi / 2) @ np.array([(-1.0, 0.0), (-1.0, 1.0)])
    np.testing.assert_allclose(np.column_stack((edits.edits[1].xs, edits.edits[1].ys)), expected, atol=1e-12)
    assert not edits.follow(nodes, corrected), "once"
    edits.remove([2])
    assert edits.anchor_nodes == {4}


def test_edits_without_keyframes_stay_in_the_frame_of_the_map():
    edits = MapEdits()
    edits.add([WALL])
    assert not edits.follow(np.zeros(0, np.int64), np.zeros((0, 3)))
    assert edits.anchor_nodes == frozenset()
    np.testing.assert_array_equal(edits.edits[0].xs, WALL.xs)


def test_a_corrected_graph_takes_its_edits_along_when_the_map_is_drawn_again(mapped):
    _, content, first = mapped
    lap = EditedLap()
    lap.start(MapMode.CONTINUE, content, first.inverse() @ lap.driven.true)
    lap.go(5)
    back_end = lap.driven.mapper.back_end
    back_end.graph.move_nodes(0, Pose2(0.2, 0.1, 0.0))  # as a closure with the rest of a building would
    back_end.map_from_local = Pose2(0.2, 0.1, 0.0) @ back_end.map_from_local
    back_end.map_shift = np.inf
    lap.driven.now += 20 * 10**9
    lap.driven.publish_map()
    lap.driven.publish_map()
    np.testing.assert_allclose(lap.states[-1].edits[0].xs, WALL.xs + 0.2)
    np.testing.assert_allclose(lap.states[-1].edits[0].ys, WALL.ys + 0.1)
    assert (lap.values(lap.states[-1].edits[0]) == 100).all()
    erased = lap.values(lap.states[-1].edits[1])
    assert (erased[erased >= 0] == 0).all()
