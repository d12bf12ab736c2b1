# SPDX-License-Identifier: Apache-2.0
"""File format of a saved map: the pose graph, the keyframes, and the tiles that were drawn from them.

The file is msgpack: [MAGIC, format, SHA-256 of the body, body]. The body is a msgpack map of arrays, each as
[dtype, shape, little-endian bytes]. A map that was loaded is saved again to the same bytes.

A map with edits has format 2, so that a program that knows no edits refuses it: it would drive through virtual walls.
Its tiles are without the edits. A map without edits has format 1.
"""

from dataclasses import dataclass
from hashlib import sha256
from typing import Any

import msgpack
import numpy as np
from numpy.typing import NDArray

from services.mapper.back_end.keyframe import Keyframe
from services.mapper.back_end.pose_graph import Graph
from services.mapper.grid.edit_cells import edits_problem
from shared.config import UserError
from shared.geometry import Pose2
from shared.messages import MAX_EDIT_POINTS, MAX_EDIT_WIDTH_M, MAX_EDIT_XY_M, TILE_CELLS, EditKind, MapEdit, MapUpdate
from shared.types import Float64s

MAGIC = "zenav saved map"
FORMAT_WITHOUT_EDITS, FORMAT = 1, 2
SAVE_AGAIN = "save the map again, or take a copy of it"
FIRST_BYTES = b"\x94" + bytes(msgpack.packb(MAGIC))
"""Of every saved map of any format: a msgpack list of four, and the magic."""

MAX_KEYFRAMES = 1_000_000
MAX_NAME = 2**53  # of nodes and edges
MAX_XY_M = 1e6  # m
MAX_RANGE_M = 1e4  # m
MAX_TILE_INDEX = 30_000

ARRAYS: dict[str, tuple[str, tuple[str | int, ...]]] = {
    # of pose_graph.Graph
    "nodes": ("<i8", ("n",)), "poses": ("<f8", ("n", 3)), "fixed": ("|b1", ("n",)),
    "edges": ("<i8", ("m",)), "i": ("<i8", ("m",)), "j": ("<i8", ("m",)), "relative": ("<f8", ("m", 3)),
    "information": ("<f8", ("m", 3, 3)), "loop": ("|b1", ("m",)), "on": ("|b1", ("m",)),
    # of the keyframes, concatenated: keyframe k has beams[k] rows of origins and ends, and so on
    "stamps": ("<i8", ("n",)), "local_from_base": ("<f8", ("n", 3)), "driven": ("<f8", ("n",)),
    "beams": ("<i8", ("n",)), "origins": ("<f4", ("b", 2)), "ends": ("<f4", ("b", 2)),
    "silences": ("<i8", ("n",)), "silent": ("<f4", ("q", 2)),
    "surfaces": ("<i8", ("n",)), "points": ("<f4", ("s", 2)), "normals": ("<f4", ("s", 2)),
    # of messages.MapUpdate
    "resolution": ("<f8", ()), "rows": ("<i4", ("t",)), "columns": ("<i4", ("t",)),
    "cells": ("|i1", ("t", TILE_CELLS**2)),
}  # fmt: skip
"""Arrays of the body: dtype and shape. A letter is the same length in all shapes."""

EDIT_ARRAYS: dict[str, tuple[str, tuple[str | int, ...]]] = {
    # of messages.MapEdit; edit k has edit_points[k] rows of edit_xy
    "edit_ids": ("<i8", ("e",)), "edit_kinds": ("<i8", ("e",)), "edit_widths": ("<f8", ("e",)),
    "edit_points": ("<i8", ("e",)), "edit_xy": ("<f8", ("p", 2)),
}  # fmt: skip
"""Further arrays of a body with edits."""
EDIT_KINDS = (EditKind.ERASE, EditKind.WALL)
"""By their number in `edit_kinds`."""

SWEEP = ("origins", "ends", "points", "normals", "silent")
"""Arrays of a keyframe, by the names of its fields."""
COUNTS = {"beams": ("origins", "ends"), "silences": ("silent",), "surfaces": ("points", "normals")}
"""Array with the number of rows of each keyframe: the arrays that it counts."""

BOUNDS: dict[str, tuple[float, float]] = {
    "nodes": (0, MAX_NAME), "edges": (0, MAX_NAME), "poses": (-MAX_XY_M, MAX_XY_M),
    "relative": (-MAX_XY_M, MAX_XY_M), "stamps": (0, 2**62), "local_from_base": (-MAX_XY_M, MAX_XY_M),
    "driven": (0, 1e9), "beams": (0, 1e6), "surfaces": (0, 1e6), "origins": (-MAX_RANGE_M, MAX_RANGE_M),
    "ends": (-MAX_RANGE_M, MAX_RANGE_M), "silences": (0, 1e6), "silent": (-MAX_RANGE_M, MAX_RANGE_M),
    "points": (-MAX_RANGE_M, MAX_RANGE_M), "normals": (-1.01, 1.01),
    "resolution": (0.005, 1), "rows": (-MAX_TILE_INDEX, MAX_TILE_INDEX),
    "columns": (-MAX_TILE_INDEX, MAX_TILE_INDEX), "cells": (-1, 100),
    "edit_ids": (0, MAX_NAME), "edit_kinds": (0, len(EDIT_KINDS) - 1), "edit_widths": (0, MAX_EDIT_WIDTH_M),
    "edit_points": (1, MAX_EDIT_POINTS), "edit_xy": (-MAX_EDIT_XY_M, MAX_EDIT_XY_M),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class SavedMap:
    """A map with its pose graph.

    keyframes, driven: (n,) of the graph's nodes; driven is the path length up to each, m.
    tiles: the whole grid without the edits; its map id and version are not used.
    edits: in `map`, by users.
    """

    graph: Graph
    keyframes: tuple[Keyframe, ...]
    driven: Float64s
    tiles: MapUpdate
    edits: tuple[MapEdit, ...] = ()


def pack_map(saved: SavedMap) -> bytes:
    """Returns the content of the file."""
    graph, keyframes, tiles = saved.graph, saved.keyframes, saved.tiles
    values: dict[str, Any] = {name: getattr(graph, name) for name in Graph.__dataclass_fields__}
    values |= {
        "stamps": [k.stamp for k in keyframes],
        "local_from_base": [(k.local_from_base.x, k.local_from_base.y, k.local_from_base.yaw) for k in keyframes],
        "driven": saved.driven,
        "beams": [len(k.ends) for k in keyframes],
        "silences": [len(k.silent) for k in keyframes],
        "surfaces": [len(k.normals) for k in keyframes],
        "resolution": tiles.resolution, "rows": tiles.rows, "columns": tiles.columns, "cells": tiles.cells,
    }  # fmt: skip
    kinds = ARRAYS | EDIT_ARRAYS if saved.edits else ARRAYS
    if saved.edits:
        values |= {
            "edit_ids": [edit.id for edit in saved.edits],
            "edit_kinds": [EDIT_KINDS.index(edit.kind) for edit in saved.edits],
            "edit_widths": [edit.width for edit in saved.edits],
            "edit_points": [len(edit.xs) for edit in saved.edits],
            "edit_xy": np.concatenate([np.column_stack((edit.xs, edit.ys)) for edit in saved.edits]),
        }
    for name in SWEEP:
        values[name] = np.concatenate([np.zeros((0, 2), np.float32), *(getattr(k, name) for k in keyframes)])
    body = {}
    for name, (dtype, axes) in kinds.items():
        array = np.ascontiguousarray(values[name], dtype).reshape(np.shape(values[name]))
        if not array.size:  # a list of no poses has one axis
            array = array.reshape(tuple(axis if isinstance(axis, int) else 0 for axis in axes))
        body[name] = (dtype, array.shape, array.tobytes())
    content = bytes(msgpack.packb(body))
    number = FORMAT if saved.edits else FORMAT_WITHOUT_EDITS
    return bytes(msgpack.packb((MAGIC, number, sha256(content).digest(), content)))


def unpack_map(content: bytes, source: str) -> SavedMap:
    """Returns the saved map of a file's content. Raises UserError, and no other exception, for invalid content.

    source: name of the file in the error.
    """
    if not content.startswith(FIRST_BYTES):
        raise UserError(f"{source}: not a saved map", "give the folder that zenav slam or zenav map save wrote")
    try:
        _, number, digest, body = msgpack.unpackb(content)
    except Exception:  # msgpack raises many kinds of exceptions for damaged bytes
        raise UserError(f"{source}: the file ends early, or is damaged", SAVE_AGAIN) from None
    if type(number) is not int or number > FORMAT:
        raise UserError(f"{source}: saved in format {number}, this program reads {FORMAT}", "take a newer zenav")
    if type(body) is not bytes or sha256(body).digest() != digest:
        raise UserError(f"{source}: damaged: its checksum is another one", SAVE_AGAIN)
    try:
        kinds = ARRAYS if number <= FORMAT_WITHOUT_EDITS else ARRAYS | EDIT_ARRAYS
        return _saved(_arrays(msgpack.unpackb(body), kinds))
    except Exception as error:  # a valid checksum does not make the content valid
        raise UserError(f"{source}: not a map that makes sense: {error or type(error).__name__}", SAVE_AGAIN) from None


def _arrays(body: Any, kinds: dict[str, tuple[str, tuple[str | int, ...]]]) -> dict[str, NDArray[Any]]:
    """Returns the arrays of the body. Raises ValueError for a wrong dtype, shape or value."""
    if type(body) is not dict or body.keys() != kinds.keys():
        raise ValueError("its arrays are not those of a saved map")
    lengths: dict[str, int] = {}
    arrays = {}
    for name, (dtype, axes) in kinds.items():
        given, shape, content = body[name]
        wanted = tuple(
            axis if isinstance(axis, int) else lengths.setdefault(axis, length) for axis, length in zip(axes, shape)
        )
        if given != dtype or tuple(shape) != wanted or len(axes) != len(shape):
            raise ValueError(f"{name} is {given} {shape}, not {dtype} {list(axes)}")
        array = np.frombuffer(content, dtype).reshape(shape)
        low, high = BOUNDS.get(name, (-np.inf, np.inf))
        may_be_nan = name in ("ends", "silent")  # of beams without an echo, and with one
        outside = ~((array >= low) & (array <= high) | (np.isnan(array) if may_be_nan else False))
        if outside.any():
            raise ValueError(f"{name} holds {array[outside].flat[0]}, not {low:g} .. {high:g}")
        arrays[name] = array.copy()  # aligned, and writeable
    return arrays


def _saved(arrays: dict[str, NDArray[Any]]) -> SavedMap:
    if len(arrays["nodes"]) > MAX_KEYFRAMES:
        raise ValueError(f"it has more than {MAX_KEYFRAMES} keyframes")
    if (np.diff(arrays["driven"]) < 0).any():
        raise ValueError("driven decreases")
    tiles = MapUpdate(
        stamp=0,
        map_id=0,
        version=1,
        resolution=float(arrays["resolution"]),
        rows=arrays["rows"],
        columns=arrays["columns"],
        cells=arrays["cells"],
    )
    if (problem := tiles.problem()) is not None:
        raise ValueError(problem)
    parts = {}
    if ((arrays["silences"] != 0) & (arrays["silences"] != arrays["beams"])).any():
        raise ValueError("silences differs from beams")
    for count, names in COUNTS.items():
        ends = np.cumsum(arrays[count])
        for name in names:
            if (ends[-1] if len(ends) else 0) != len(arrays[name]):
                raise ValueError(f"{name} are not as many as {count} says")
            parts[name] = np.split(arrays[name], ends[:-1])
    keyframes = tuple(
        Keyframe.of(
            stamp=stamp,
            local_from_base=Pose2(*row),
            origins=parts["origins"][k],
            ends=parts["ends"][k],
            points=parts["points"][k],
            normals=parts["normals"][k],
            silent=parts["silent"][k],
        )
        for k, (stamp, row) in enumerate(zip(arrays["stamps"].tolist(), arrays["local_from_base"].tolist()))
    )
    graph = Graph(**{name: arrays[name] for name in Graph.__dataclass_fields__})
    graph.check()
    return SavedMap(graph, keyframes, arrays["driven"], tiles, _edits(arrays) if "edit_ids" in arrays else ())


def _edits(arrays: dict[str, NDArray[Any]]) -> tuple[MapEdit, ...]:
    """Returns the edits. Raises ValueError for edits that the mapper would refuse."""
    ids, ends = arrays["edit_ids"].tolist(), np.cumsum(arrays["edit_points"])
    if not ids or len(set(ids)) != len(ids) or ends[-1] != len(arrays["edit_xy"]):
        raise ValueError("edit_xy are not as many as edit_points says, or two edits have one id")
    edits = tuple(
        MapEdit(stamp=0, id=id_, kind=EDIT_KINDS[kind], xs=xy[:, 0].copy(), ys=xy[:, 1].copy(), width=width)
        for id_, kind, width, xy in zip(
            ids,
            arrays["edit_kinds"].tolist(),
            arrays["edit_widths"].tolist(),
            np.split(arrays["edit_xy"], ends[:-1]),
            strict=True,
        )
    )
    problem = next((p for edit in edits if (p := edit.problem())), None) or edits_problem(edits)
    if problem is not None:
        raise ValueError(problem)
    return edits
