# SPDX-License-Identifier: Apache-2.0
"""Two maps of one floor become one where both show the same; of two floors, or of equal rooms, they are refused."""

from dataclasses import replace
from math import hypot

import numpy as np
import pytest

from services.mapper.config import MapperConfig
from services.mapper.maps.map_file import pack_map, unpack_map
from services.mapper.maps.map_merging import merge_maps
from services.mapper.maps.map_overlap import MIN_PLACES, MIN_SPREAD_M, Overlap, certain_overlap
from shared.config import UserError
from shared.geometry import Pose2, wrapped
from shared.messages import EditKind, MapEdit
from tests.unit.services.mapper.buildings import Building, saved_by, towards
from tests.unit.services.mapper.rooms import ROBOT, RoomDrive, box

WALLS = [
    *box(0, 0, 18, 9), (0, 4, 2, 4), (3.2, 4, 7, 4), (8.2, 4, 15.5, 4), (16.7, 4, 18, 4), (5, 0, 5, 4), (11, 0, 11, 4),
    (0, 5.6, 5.5, 5.6), (6.7, 5.6, 12, 5.6), (13.2, 5.6, 18, 5.6), (8, 5.6, 8, 9),
]  # fmt: skip
FURNITURE = [
    *box(0.6, 0.4, 2.2, 1.1), *box(4.3, 2.6, 4.9, 3.8), *box(6.0, 0.1, 7.6, 0.8), *box(10.2, 1.9, 10.9, 3.1),
    *box(12.0, 0.2, 12.7, 2.0), *box(15.1, 0.5, 17.0, 1.2), *box(1.0, 8.2, 2.7, 8.9), *box(6.6, 7.4, 7.1, 8.8),
    *box(9.0, 8.1, 10.2, 8.8), *box(14.6, 7.0, 16.0, 7.6), *box(9.6, 5.2, 10.4, 5.6), *box(0.1, 4.5, 0.4, 5.2),
]  # fmt: skip
OTHER_FURNITURE = [
    *box(3.4, 0.3, 4.6, 1.6), *box(0.2, 1.8, 0.8, 3.4), *box(8.9, 0.2, 10.6, 1.0), *box(5.3, 1.4, 6.0, 2.9),
    *box(16.8, 1.9, 17.7, 3.6), *box(13.6, 1.6, 14.6, 2.3), *box(4.0, 8.0, 5.2, 8.8), *box(0.3, 6.4, 0.9, 7.8),
    *box(8.2, 7.4, 8.9, 8.8), *box(16.6, 6.0, 17.6, 7.0), *box(4.2, 4.1, 5.2, 4.5), *box(13.6, 5.2, 14.4, 5.6),
]  # fmt: skip
FLOOR, UPPER_FLOOR = np.array([*WALLS, *FURNITURE], float), np.array([*WALLS, *OTHER_FURNITURE], float)
OTHER = np.array(
    [
        *box(0, 0, 17, 9), (0, 3.4, 4, 3.4), (5.1, 3.4, 9.5, 3.4), (10.6, 3.4, 17, 3.4), (7, 0, 7, 3.4),
        (0, 5.0, 2, 5.0), (3.1, 5.0, 11, 5.0), (12.1, 5.0, 17, 5.0), (5.5, 5.0, 5.5, 9), (11.5, 5.8, 11.5, 9),
        *box(1, 0.2, 2.5, 1.0), *box(12.6, 1.2, 14.1, 2.2), *box(3.2, 7.6, 4.6, 8.6), *box(14.2, 7.9, 16.2, 8.7),
    ],
    float,
)  # fmt: skip
"""Another building of about the same size."""
WEST = ((3.0, 2.2), (2.6, 5.0), (6.1, 6.6), (4.0, 7.4), (6.1, 5.0), (7.6, 2.4), (9.0, 1.6), (7.6, 4.8), (10.5, 4.8))
EAST = ((14.0, 3.0), (16.1, 4.8), (12.6, 6.4), (11.4, 7.4), (12.6, 4.8), (7.6, 4.8), (7.6, 2.4), (9.0, 1.6), (7.6, 4.8))
EQUAL = np.array(
    [
        *box(0, 0, 36, 5.2),
        *(
            segment
            for x in range(0, 36, 4)
            for segment in (
                (x, 0, x, 3.6), (x, 3.6, x + 1.4, 3.6), (x + 2.6, 3.6, x + 4, 3.6), *box(x + 0.3, 0.2, x + 1.4, 0.9)
            )
        ),
    ],
    float,
)  # fmt: skip
"""Nine equal rooms with a door each at a corridor."""
CONFIG = MapperConfig()
RANGE_MAX = ROBOT.laser.range_max


def mapped(segments, places, yaw=0.0, seed=1):
    """The map of a drive from place to place, and the true poses of its keyframes."""
    floor = Building(segments, places[0])
    driven = RoomDrive(segments, noise=0.01)
    driven.rng = np.random.default_rng(seed)
    driven.true = Pose2(*places[0], yaw)
    stamps, truths = [], []
    for place in places[1:]:
        before = floor._from(floor._cell(*place))
        cell = floor._cell(driven.true.x, driven.true.y)
        while cell != floor._cell(*place):
            for _ in range(3):
                cell = before[cell]
            for motion in towards(driven.true, floor._place(cell, 0.0)):
                driven.step(motion)
                stamps.append(driven.now)
                truths.append((driven.true.x, driven.true.y, driven.true.yaw))
    saved = saved_by(driven)
    rows = [int(np.argmin(np.abs(np.array(stamps) - keyframe.stamp))) for keyframe in saved.keyframes]
    return saved, np.array(truths)[rows]


@pytest.fixture(scope="module")
def west():
    return mapped(FLOOR, WEST)


@pytest.fixture(scope="module")
def east():
    return mapped(FLOOR, EAST, yaw=2.0, seed=2)


@pytest.fixture(scope="module")
def merged(west, east):
    """Both, each with a wall 1 m ahead of its first keyframe."""
    wall = MapEdit(0, 1, EditKind.WALL, np.array([1.0, 1.5]), np.zeros(2), 0.1)
    return merge_maps(*(replace(saved, edits=(wall,)) for saved, _ in (west, east)), CONFIG, RANGE_MAX)


def test_the_second_maps_keyframes_lie_in_the_firsts_frame_where_they_were_measured(west, east, merged):
    n = len(west[1])
    world_from_map = Pose2(*west[1][0]) @ Pose2(*merged.saved.graph.poses[0]).inverse()
    assert len(merged.saved.keyframes) == n + len(east[1])
    for row, true in zip(merged.saved.graph.poses[n:].tolist(), east[1].tolist(), strict=True):
        pose = world_from_map @ Pose2(*row)
        assert hypot(pose.x - true[0], pose.y - true[1]) < 0.1
        assert abs(wrapped(pose.yaw - true[2])) < 0.03
    assert np.hypot(*(merged.saved.graph.poses[:n] - west[0].graph.poses)[:, :2].T).max() < 0.1
    assert merged.n_closures >= 10


def test_the_merged_map_shows_what_either_shows_and_is_a_map_like_any(west, east, merged):
    assert len(merged.saved.tiles.rows) > max(len(west[0].tiles.rows), len(east[0].tiles.rows))
    known = [(saved.tiles.cells >= 0).sum() for saved in (west[0], east[0], merged.saved)]
    assert max(known[:2]) < known[2] < sum(known[:2])
    content = pack_map(merged.saved)
    assert pack_map(unpack_map(content, "merged")) == content


def test_edits_of_both_maps_stay_at_their_places(west, merged):
    assert [edit.id for edit in merged.saved.edits] == [1, 2]
    for edit, row in zip(merged.saved.edits, (0, len(west[1])), strict=True):
        expected = Pose2(*merged.saved.graph.poses[row]) @ Pose2(1.0, 0.0)
        assert hypot(edit.xs[0] - expected.x, edit.ys[0] - expected.y) < 0.1


@pytest.mark.parametrize("segments", [UPPER_FLOOR, OTHER], ids=["another floor", "another building"])
def test_what_is_not_the_same_floor_is_refused(west, segments):
    places = EAST if segments is UPPER_FLOOR else ((1.5, 4.2), (4.5, 2.2), (3.0, 4.2), (2.5, 6.4), (10, 4.2), (13, 4.2))
    with pytest.raises(UserError):
        merge_maps(west[0], mapped(segments, places, seed=3)[0], CONFIG, RANGE_MAX)


def test_parts_of_a_row_of_equal_rooms_are_refused():
    """Rooms 2 to 4 and rooms 6 to 8: they match each other room by room, in several ways, and all are wrong."""
    parts = [
        mapped(EQUAL, [place for x in range(first, first + 12, 4) for place in ((x + 2.0, 4.4), (x + 2.0, 2.0))])
        for first in (4, 20)
    ]
    with pytest.raises(UserError) as refused:
        merge_maps(parts[0][0], parts[1][0], CONFIG, RANGE_MAX)
    assert refused.value.hint


def overlap(n_matching, n_judged=None, spread=10.0):
    return Overlap(Pose2(), tuple(range(n_matching)), tuple(range(n_judged or n_matching)), 0.0, spread)


@pytest.mark.parametrize(
    "overlaps",
    [
        [],
        [overlap(MIN_PLACES - 1)],
        [overlap(20, spread=MIN_SPREAD_M / 2)],
        [overlap(10, 20)],
        [overlap(10), overlap(5)],
        [overlap(10, 20), overlap(3)],
    ],
    ids=["no pose", "few places", "one room", "contradicted", "two ways", "the best one contradicted"],
)
def test_a_transform_that_is_not_certain_is_refused_with_a_hint(overlaps):
    with pytest.raises(UserError) as refused:
        certain_overlap(overlaps, 30)
    assert refused.value.hint


def test_a_rival_that_is_contradicted_or_matches_little_does_not_count():
    best = overlap(12)
    assert certain_overlap([overlap(10, 20), best, overlap(2)], 30) is best
