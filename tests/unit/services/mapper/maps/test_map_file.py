# SPDX-License-Identifier: Apache-2.0
"""A saved map loads to the same bytes; whatever else is in the file is a clear error."""

from dataclasses import replace
from hashlib import sha256

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.mapper.back_end.keyframe import Keyframe
from services.mapper.back_end.pose_graph import PoseGraph
from services.mapper.maps.map_file import ARRAYS, EDIT_ARRAYS, FORMAT, MAGIC, SavedMap, pack_map, unpack_map
from shared.config import UserError
from shared.geometry import Pose2
from shared.messages import EditKind, MapEdit, MapUpdate


def made(seed, n, n_loops=0, n_tiles=1, removed=()):
    """A map of n keyframes with sweeps of all sizes, also empty ones."""
    rng = np.random.default_rng(seed)
    graph = PoseGraph()
    keyframes = []
    for k in range(n):
        pose = Pose2(*rng.uniform(-3, 3, 3))
        graph.add_node(pose)
        if k:
            graph.add_edge(k - 1, k, Pose2(*rng.normal(size=3)), np.diag(rng.uniform(1, 9, 3)), loop=False)
        beams, surface = rng.integers(0, 9, 2)
        ends = rng.normal(size=(beams, 2)).astype(np.float32)
        ends[rng.random(beams) < 0.2] = ends[:1] = np.nan
        points = rng.normal(size=(surface, 2)).astype(np.float32)
        normals = rng.uniform(-0.7, 0.7, (surface, 2)).astype(np.float32)
        silent = np.where(np.isnan(ends), np.float32(2), np.float32(np.nan))[: beams * rng.integers(2)]
        keyframes.append(
            Keyframe.of(int(rng.integers(2**60)), pose, np.zeros_like(ends), ends, points, normals, silent)
        )
    for _ in range(n_loops if n > 2 else 0):
        i, j = rng.choice(n, 2, replace=False)
        graph.add_edge(int(i), int(j), Pose2(*rng.normal(size=3)), np.eye(3), loop=True)
    for node in removed:
        if 0 < node < len(keyframes) - 1 and len(keyframes) == len(graph.nodes):
            graph.remove_node(int(graph.nodes[node]))
            del keyframes[node]
    places = np.sort(rng.choice(40, n_tiles, replace=False)).astype(np.int32)
    cells = rng.integers(-1, 101, (n_tiles, 4096)).astype(np.int8)
    tiles = MapUpdate(7, 8, 9, 0.05, places // 7, places % 7 - 3, cells)
    return SavedMap(graph.snapshot(), tuple(keyframes), np.sort(rng.uniform(0, 99, len(keyframes))), tiles)


def refusal(content):
    with pytest.raises(UserError) as error:
        unpack_map(content, "maps/office/graph.msgpack")
    assert "maps/office/graph.msgpack" in error.value.what
    assert "\n" not in error.value.what
    assert error.value.hint
    return error.value.what


def sealed(body):
    number = 2 if "edit_ids" in body else 1
    content = msgpack.packb(body)
    return msgpack.packb((MAGIC, number, sha256(content).digest(), content))


def body_of(saved):
    return msgpack.unpackb(msgpack.unpackb(pack_map(saved))[3])


@given(st.integers(0, 2**32), st.integers(0, 12), st.integers(0, 4), st.integers(0, 3), st.lists(st.integers(0, 9)))
@settings(max_examples=60)
def test_what_was_loaded_is_saved_to_the_same_bytes(seed, n, n_loops, n_tiles, removed):
    saved = made(seed, n, n_loops, n_tiles, removed)
    content = pack_map(saved)
    loaded = unpack_map(content, "")
    assert pack_map(loaded) == content
    assert len(loaded.keyframes) == len(saved.keyframes) == len(loaded.graph.nodes)
    for mine, theirs in zip(saved.keyframes, loaded.keyframes):
        assert (mine.stamp, mine.local_from_base) == (theirs.stamp, theirs.local_from_base)
        for name in ("origins", "ends", "points", "normals", "silent"):
            np.testing.assert_array_equal(getattr(mine, name), getattr(theirs, name))
    for name in ("rows", "columns", "cells"):
        np.testing.assert_array_equal(getattr(saved.tiles, name), getattr(loaded.tiles, name))
    assert PoseGraph.of(loaded.graph).snapshot().poses.tolist() == saved.graph.poses.tolist()


@given(st.data())
@settings(max_examples=150)
def test_no_damage_goes_unnoticed_and_none_is_a_crash(data):
    content = bytearray(pack_map(made(3, 4, 2)))
    kind = data.draw(st.sampled_from(("flip", "cut", "more", "hole")))
    at = data.draw(st.integers(0, len(content) - 1))
    if kind == "flip":
        content[at] ^= data.draw(st.integers(1, 255))
    elif kind == "cut":
        del content[at:]
    elif kind == "more":
        content += bytes(1 + at % 50)
    else:
        del content[at : at + 1 + at % 7]
    refusal(bytes(content))


@given(st.binary(max_size=60))
def test_a_foreign_file_is_refused_as_one(content):
    assert "not a saved map" in refusal(content)


def test_a_cut_file_says_so():
    content = pack_map(made(1, 5))
    assert "ends early" in refusal(content[: len(content) // 2])


def test_a_newer_program_s_map_is_told_apart_from_a_damaged_one():
    newer = msgpack.packb((MAGIC, FORMAT + 1, b"?", {"all": "new"}))
    assert f"saved in format {FORMAT + 1}, this program reads {FORMAT}" in refusal(newer)


def edited():
    """A map with an erased polygon and a wall."""
    erase = MapEdit(0, 3, EditKind.ERASE, np.array([0.0, 1, 1]), np.array([0.0, 0, 2]), 0.0)
    wall = MapEdit(0, 4, EditKind.WALL, np.array([-1.0, 5]), np.array([2.0, 3]), 0.1)
    return replace(made(5, 4, 2), edits=(erase, wall))


def test_edits_are_saved_beside_the_tiles_and_a_program_that_knows_none_refuses_the_map():
    content = pack_map(edited())
    loaded = unpack_map(content, "")
    assert pack_map(loaded) == content
    assert [(e.id, e.kind, e.xs.tolist(), e.ys.tolist(), e.width) for e in loaded.edits] == [
        (3, EditKind.ERASE, [0, 1, 1], [0, 0, 2], 0.0), (4, EditKind.WALL, [-1, 5], [2, 3], 0.1),
    ]  # fmt: skip
    np.testing.assert_array_equal(loaded.tiles.cells, edited().tiles.cells)
    assert msgpack.unpackb(content)[1] == 2
    assert msgpack.unpackb(pack_map(made(5, 4, 2)))[1] == 1, "as before there were edits"


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        ("edit_ids", [3, 3], "one id"),
        ("edit_points", [2, 2], "edit_points"),
        ("edit_points", [2, 3], "2 points"),
        ("edit_kinds", [0, 2], "edit_kinds"),
        ("edit_widths", [0.0, 0.0], "width"),
        ("edit_widths", [0.0, 9.0], "edit_widths"),
        ("edit_xy", [[0.0, 0], [9e3, 0], [9e3, 9e3], [0, 0], [1, 1]], "m2"),
        ("edit_xy", [[0.0, 0], [1, 0], [1, 1], [0, np.nan], [1, 1]], "edit_xy"),
    ],
)
def test_edits_that_make_no_sense_are_refused(name, values, words):
    body = body_of(edited())
    dtype = EDIT_ARRAYS[name][0]
    array = np.array(values, dtype)
    body[name] = (dtype, array.shape, array.tobytes())
    assert words in refusal(sealed(body))


@given(st.sampled_from(sorted(ARRAYS)), st.data())
@settings(max_examples=150)
def test_content_that_makes_no_sense_is_refused_though_its_checksum_is_right(name, data):
    body = body_of(made(5, 4, 2))
    dtype, shape, content = body[name]
    kind = data.draw(st.sampled_from(("lacking", "type", "row", "nan", "huge", "cut", "nothing")))
    if kind == "lacking":
        del body[name]
    elif kind == "type":
        body[name] = ("<f2" if dtype != "<f2" else "<f4", shape, content)
    elif kind == "row":
        body[name] = (dtype, [(shape or [1])[0] + 1, *shape[1:]], content + bytes(len(content)))
    elif kind == "cut":
        body[name] = (dtype, shape, content[:-1])
    elif kind == "nothing":
        body[name] = data.draw(st.sampled_from((None, 3, [], "text", {}, [dtype, None, content])))
    elif dtype in ("<f4", "<f8"):
        array = np.frombuffer(content, dtype).copy()
        holes = name in ("ends", "silent") and kind == "nan"
        array[-1:] = np.inf if kind == "huge" or holes else np.nan
        body[name] = (dtype, shape, array.tobytes())
    else:
        body[name] = (dtype, shape, b"\x7f" * (len(content) + 1))
    assert "makes sense" in refusal(sealed(body))


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        ("driven", [3.0, 2.0, 4.0], "decreases"),
        ("beams", [-1, 1, 0], "-1"),
        ("surfaces", [2**20, 1, 0], "surfaces"),
        ("beams", [5, 99, 5], "beams"),
        ("nodes", [0, 2, 1], "rise"),
        ("nodes", [0, 1, 2**62], "nodes"),
        ("stamps", [0, 1, -5], "-5"),
    ],
)
def test_what_contradicts_itself_is_named(name, values, words):
    saved = made(9, 3)
    body = body_of(saved)
    dtype, shape, _ = body[name]
    body[name] = (dtype, shape, np.array(values, dtype).tobytes())
    assert words in refusal(sealed(body))


def test_tiles_that_lie_too_far_apart_for_one_map_are_refused():
    body = body_of(made(2, 2, n_tiles=2))
    dtype, shape, _ = body["rows"]
    body["rows"] = (dtype, shape, np.array([-29000, 29000], dtype).tobytes())
    assert "span" in refusal(sealed(body))
