# SPDX-License-Identifier: Apache-2.0
"""A saved map as bytes: the pose graph, the keyframes, and the tiles that were drawn from them.

The file is msgpack: [MAGIC, format, SHA-256 of the body, body]; the body is a msgpack map of arrays, each as
[dtype, shape, little-endian bytes]. What was loaded is saved again to the same bytes.
"""

from dataclasses import dataclass
from hashlib import sha256
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from services.mapper.keyframe import Keyframe
from services.mapper.pose_graph import Graph
from shared.config import UserError
from shared.geometry import Float64s, Pose2
from shared.messages import TILE_CELLS, MapUpdate

MAGIC = "zenav saved map"
FORMAT = 1
AGAIN = "save the map again, or take a copy of it"
BEGINNING = b"\x94" + bytes(msgpack.packb(MAGIC))
"""Of every saved map of any format: a list of four, and the magic."""

MOST_KEYFRAMES = 1_000_000
MOST_NAMES = 2**53  # of nodes and edges
FARTHEST = 1e6  # m
MOST_RANGE = 1e4  # m
MOST_TILE = 30_000

ARRAYS: dict[str, tuple[str, tuple[str | int, ...]]] = {
    # the graph's: see pose_graph.Graph
    "nodes": ("<i8", ("n",)), "poses": ("<f8", ("n", 3)), "fixed": ("|b1", ("n",)),
    "edges": ("<i8", ("m",)), "i": ("<i8", ("m",)), "j": ("<i8", ("m",)), "relative": ("<f8", ("m", 3)),
    "information": ("<f8", ("m", 3, 3)), "loop": ("|b1", ("m",)), "on": ("|b1", ("m",)),
    # the keyframes', one after the other: beams[k] of the rows of origins and ends, and so on
    "stamps": ("<i8", ("n",)), "local_from_base": ("<f8", ("n", 3)), "driven": ("<f8", ("n",)),
    "beams": ("<i8", ("n",)), "origins": ("<f4", ("b", 2)), "ends": ("<f4", ("b", 2)),
    "silences": ("<i8", ("n",)), "silent": ("<f4", ("q", 2)),
    "surfaces": ("<i8", ("n",)), "points": ("<f4", ("s", 2)), "normals": ("<f4", ("s", 2)),
    # the tiles': see messages.MapUpdate
    "resolution": ("<f8", ()), "rows": ("<i4", ("t",)), "columns": ("<i4", ("t",)),
    "cells": ("|i1", ("t", TILE_CELLS**2)),
}  # fmt: skip
"""What the body holds: dtype and shape, in which a letter is the same length wherever it stands."""

SWEEP = ("origins", "ends", "points", "normals", "silent")
"""A keyframe's arrays, in its order."""
COUNTS = {"beams": ("origins", "ends"), "silences": ("silent",), "surfaces": ("points", "normals")}
"""What holds the numbers of each keyframe's rows."""

BOUNDS: dict[str, tuple[float, float]] = {
    "nodes": (0, MOST_NAMES), "edges": (0, MOST_NAMES), "poses": (-FARTHEST, FARTHEST),
    "relative": (-FARTHEST, FARTHEST), "stamps": (0, 2**62), "local_from_base": (-FARTHEST, FARTHEST),
    "driven": (0, 1e9), "beams": (0, 1e6), "surfaces": (0, 1e6), "origins": (-MOST_RANGE, MOST_RANGE),
    "ends": (-MOST_RANGE, MOST_RANGE), "silences": (0, 1e6), "silent": (-MOST_RANGE, MOST_RANGE),
    "points": (-MOST_RANGE, MOST_RANGE), "normals": (-1.01, 1.01),
    "resolution": (0.005, 1), "rows": (-MOST_TILE, MOST_TILE), "columns": (-MOST_TILE, MOST_TILE), "cells": (-1, 100),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class SavedMap:
    """keyframes, and driven, (n,) m up to each, go with the graph's nodes. tiles: the whole grid; its ids count for
    nothing."""

    graph: Graph
    keyframes: tuple[Keyframe, ...]
    driven: Float64s
    tiles: MapUpdate


def packed(saved: SavedMap) -> bytes:
    """The file's content."""
    graph, keyframes, tiles = saved.graph, saved.keyframes, saved.tiles
    values: dict[str, Any] = {name: getattr(graph, name) for name in Graph.__dataclass_fields__}
    values |= {
        "stamps": [k.stamp for k in keyframes],
        "local_from_base": [(k.local_from_base.x, k.local_from_base.y, k.local_from_base.yaw) for k in keyframes],
        "driven": saved.driven,
        "beams": [len(k.ends) for k in keyframes],
        "silences": [len(k.silent) for k in keyframes],
        "surfaces": [len(k.points) for k in keyframes],
        "resolution": tiles.resolution, "rows": tiles.rows, "columns": tiles.columns, "cells": tiles.cells,
    }  # fmt: skip
    for name in SWEEP:
        values[name] = np.concatenate([np.zeros((0, 2), np.float32), *(getattr(k, name) for k in keyframes)])
    body = {}
    for name, (dtype, axes) in ARRAYS.items():
        array = np.ascontiguousarray(values[name], dtype).reshape(np.shape(values[name]))
        if not array.size:  # a list of no poses has one axis
            array = array.reshape(tuple(axis if isinstance(axis, int) else 0 for axis in axes))
        body[name] = (dtype, array.shape, array.tobytes())
    content = bytes(msgpack.packb(body))
    return bytes(msgpack.packb((MAGIC, FORMAT, sha256(content).digest(), content)))


def unpacked(content: bytes, source: str) -> SavedMap:
    """A saved map from a file's content. Raises UserError, never anything else, whatever the bytes.

    source: what the file is called in that.
    """
    if not content.startswith(BEGINNING):
        raise UserError(f"{source}: not a saved map", "give the folder that zenav slam or zenav map save wrote")
    try:
        _, number, digest, body = msgpack.unpackb(content)
    except Exception:  # msgpack raises a dozen kinds on damaged bytes: all mean the same here
        raise UserError(f"{source}: the file ends early, or is damaged", AGAIN) from None
    if type(number) is not int or number > FORMAT:
        raise UserError(f"{source}: saved in format {number}, this program reads {FORMAT}", "take a newer zenav")
    if type(body) is not bytes or sha256(body).digest() != digest:
        raise UserError(f"{source}: damaged: its checksum is another one", AGAIN)
    try:
        return _saved(_arrays(msgpack.unpackb(body)))
    except Exception as error:  # whoever made the checksum made the content too: nothing about it is sure
        raise UserError(f"{source}: not a map that makes sense: {error or type(error).__name__}", AGAIN) from None


def _arrays(body: Any) -> dict[str, NDArray[Any]]:
    """The body's arrays, each of its dtype, its shape and within its bounds; or ValueError."""
    if type(body) is not dict or body.keys() != ARRAYS.keys():
        raise ValueError("its arrays are not those of a saved map")
    lengths: dict[str, int] = {}
    found = {}
    for name, (dtype, axes) in ARRAYS.items():
        told, shape, content = body[name]
        wanted = tuple(
            axis if isinstance(axis, int) else lengths.setdefault(axis, length) for axis, length in zip(axes, shape)
        )
        if told != dtype or tuple(shape) != wanted or len(axes) != len(shape):
            raise ValueError(f"{name} is {told} {shape}, not {dtype} {list(axes)}")
        array = np.frombuffer(content, dtype).reshape(shape)
        low, high = BOUNDS.get(name, (-np.inf, np.inf))
        holes = name in ("ends", "silent")  # a beam without an echo, or with one
        outside = ~((array >= low) & (array <= high) | (np.isnan(array) if holes else False))
        if outside.any():
            raise ValueError(f"{name} holds {array[outside].flat[0]}, not {low:g} .. {high:g}")
        found[name] = array.copy()  # aligned, and its own
    return found


def _saved(arrays: dict[str, NDArray[Any]]) -> SavedMap:
    if len(arrays["nodes"]) > MOST_KEYFRAMES:
        raise ValueError(f"it has more than {MOST_KEYFRAMES} keyframes")
    if (np.diff(arrays["driven"]) < 0).any():
        raise ValueError("the way driven shrinks")
    tiles = MapUpdate(0, 0, 1, float(arrays["resolution"]), arrays["rows"], arrays["columns"], arrays["cells"])
    if (problem := tiles.problem()) is not None:
        raise ValueError(problem)
    parts = {}
    if ((arrays["silences"] != 0) & (arrays["silences"] != arrays["beams"])).any():
        raise ValueError("a sweep tells of some of its silent beams only")
    for count, names in COUNTS.items():
        ends = np.cumsum(arrays[count])
        for name in names:
            if (ends[-1] if len(ends) else 0) != len(arrays[name]):
                raise ValueError(f"{name} are not as many as {count} says")
            parts[name] = np.split(arrays[name], ends[:-1])
    keyframes = tuple(
        Keyframe(stamp, Pose2(*row), *(parts[name][k] for name in SWEEP))
        for k, (stamp, row) in enumerate(zip(arrays["stamps"].tolist(), arrays["local_from_base"].tolist()))
    )
    graph = Graph(*(arrays[name] for name in Graph.__dataclass_fields__))
    graph.check()
    return SavedMap(graph, keyframes, arrays["driven"], tiles)
