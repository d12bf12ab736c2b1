# SPDX-License-Identifier: Apache-2.0
"""`zenav map erase|wall|edits|undo`: edits of the running mapper's map, or of a saved one."""

import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from threading import Event

import numpy as np

from services.mapper.grid.map_edits import MapEdits
from shared import requests, topics
from shared.config import UserError, load_robot
from shared.messages import MAX_EDIT_WIDTH_M, MAX_EDIT_XY_M, EditKind, MapEdit
from shared.requests import EditMap, Reply
from shared.runners.transport import stack_address
from zenav.client import Client
from zenav.client.map_transfer import ask_until_free
from zenav.client.navigation_client import poses_from
from zenav.maps.map_files import find_map
from zenav.maps.saved_map import GRAPH, read_saved_map, write_saved_map

Change = Callable[[tuple[MapEdit, ...]], tuple[Sequence[MapEdit], Sequence[int]]]
"""A function of the present edits that gives those to add, and the ids of those to remove."""


def edit_of(kind: EditKind, points: list[str], width: float) -> MapEdit:
    """An edit from points `X,Y`: a stroke, or without a width (m) the inside of a polygon. Raises UserError."""
    if any(point.count(",") != 1 for point in points):
        wrong = next(point for point in points if point.count(",") != 1)
        raise UserError(f"{wrong.strip()!r} is no point", "write X,Y: m, m on the map")
    if not 0 <= width <= MAX_EDIT_WIDTH_M:
        raise UserError(f"a width of {width:g} m", f"give a width of 0 to {MAX_EDIT_WIDTH_M} m")
    xs, ys = np.array([(x, y) for x, y, _ in poses_from(points)], float).reshape(-1, 2).T
    if not max(np.abs(xs).max(), np.abs(ys).max()) <= MAX_EDIT_XY_M:
        raise UserError("a point lies outside of any map", f"give coordinates up to {MAX_EDIT_XY_M:g} m")
    edit = MapEdit(stamp=0, id=0, kind=kind, xs=np.ascontiguousarray(xs), ys=np.ascontiguousarray(ys), width=width)
    if (problem := edit.problem()) is not None:
        hint = "a polygon has three points or more, a wall two: zenav map wall 1,2 4,2"
        raise UserError(problem, hint if width else f"{hint}; or a brush: --width 0.3")
    return edit


def add_edit(robot: str, stack: str, map_name: str, edit: MapEdit) -> None:
    """Adds an edit to a saved map, or without a name to the running mapper's. Raises UserError where it is refused."""
    _change(robot, stack, map_name, lambda _: ([edit], ()))


def undo_edits(robot: str, stack: str, map_name: str, ids: list[int], all_: bool) -> None:
    """Removes the edits with these ids, all, or the last one. Raises UserError where there is no such edit."""

    def chosen(edits: tuple[MapEdit, ...]) -> tuple[Sequence[MapEdit], Sequence[int]]:
        known = [edit.id for edit in edits]
        unknown = [id_ for id_ in ids if id_ not in known]
        if unknown or not known:
            what = f"there is no edit {unknown[0]}" if unknown else "the map has no edits"
            raise UserError(what, "see: zenav map edits")
        return (), known if all_ else ids or [max(known)]

    _change(robot, stack, map_name, chosen)


def list_edits(robot: str, stack: str, map_name: str) -> None:
    """Prints the edits of a saved map, or of the running mapper's."""
    if map_name:
        _print(read_saved_map(_folder(map_name)).edits)
        return
    with Client(load_robot(robot).robot.name, stack_address(stack)) as client:
        _print(_present_edits(client))


def _change(robot: str, stack: str, map_name: str, change: Change) -> None:
    if map_name:
        folder = _folder(map_name)
        saved = read_saved_map(folder)
        edits = MapEdits(saved.edits)
        add, remove = change(saved.edits)
        tiles = list(zip(saved.tiles.rows.tolist(), saved.tiles.columns.tolist()))
        problem = edits.change(add, frozenset(remove), tiles, saved.tiles.resolution)
        if problem is not None:
            raise UserError(problem, "see the map: zenav map show NAME")
        write_saved_map(folder, replace(saved, edits=edits.edits))
        _print(edits.edits)
        sys.stderr.write(f"a stack that runs on {map_name} has them after: zenav map load {map_name}\n")
        return
    with Client(load_robot(robot).robot.name, stack_address(stack)) as client:
        add, remove = change(_present_edits(client))
        request = EditMap(client.now(), tuple(add), tuple(remove))
        reply: Reply = ask_until_free(client, Event().wait, requests.EDIT_MAP, request)
        _print(_present_edits(client))
        sys.stderr.write(f"{reply.detail}; to keep them in a file: zenav map save NAME\n")


def _present_edits(client: Client) -> tuple[MapEdit, ...]:
    state = client.latched_value(topics.MAP_STATE)
    return state.edits if state is not None else ()


def _folder(map_name: str) -> Path:
    folder = find_map(map_name).parent
    if not (folder / GRAPH).is_file():
        hint = f"load it, edit it there, and save it: zenav map load {map_name}"
        raise UserError(f"{folder}: a map of cells alone keeps no edits", hint)
    return folder


def _print(edits: tuple[MapEdit, ...]) -> None:
    for edit in edits:
        points = " ".join(f"{x:.2f},{y:.2f}" for x, y in zip(edit.xs.tolist(), edit.ys.tolist()))
        width = f"{edit.width:g} m wide" if edit.width else "polygon"
        sys.stdout.write(f"{edit.id:<4}{edit.kind:<7}{width:<14}{points}\n")
    if not edits:
        sys.stderr.write("no edits; draw one: zenav map wall 1,2 4,2\n")
