# SPDX-License-Identifier: Apache-2.0
"""Frontiers: borders of known free and unknown space that the robot can reach (Yamauchi 1997)."""

from dataclasses import dataclass
from math import atan2, ceil
from operator import attrgetter
from typing import ClassVar

import numpy as np
from numba import njit
from pydantic import Field

from shared.config import Section
from shared.distance_field import distance_field
from shared.grid import FREE_UP_TO, OCCUPIED_FROM
from shared.types import Bools, Float32s, Float64s, Int8s, Int32s, Int64s

_STRAIGHT, _DIAGONAL = 70, 99  # of a step, in 1/70 cells
_UNREACHED = 2**30
_MAX_TOURED = 20  # frontiers with measured distances between them
_COARSE_CELLS = 3  # cells along a side of one of the coarse grid
_MIN_REACHABLE_M2 = 4.0  # below it the robot searches for a narrower exit
_MAX_ESCAPE_M = 0.6  # through inflated or unknown space to where the robot fits


class FrontierConfig(Section):
    """Frontiers."""

    RENAMED: ClassVar[dict[str, str]] = {"least_margin": "min_margin"}

    margin: float = Field(0.07, ge=0, le=1, description="m kept free around the footprint's inscribed circle")
    min_margin: float = Field(0.03, ge=0, le=1, description="m kept free around it on the way out of an enclosed place")
    goal_margin: float = Field(
        0.1, ge=0, le=1, description="m around it that must be known and free at the pose from which a frontier is seen"
    )
    min_size: float = Field(
        0.5, gt=0, le=10, description="m across; smaller gaps hide no space that the robot could enter"
    )
    max_size: float = Field(3.0, gt=0, le=50, description="m of border that make one goal; longer ones are split")


@dataclass(frozen=True, slots=True, eq=False)
class Frontier:
    """A section of border. `x`, `y`, `yaw`: pose from which it is seen. `size`: m of border. `distance`: m to drive.

    `cells`: (n, 2) int64, row and column counted from the map's origin.
    """

    x: float
    y: float
    yaw: float
    size: float
    distance: float
    cells: Int64s


@dataclass(frozen=True, slots=True, eq=False)
class Frontiers:
    """The result of a search, the nearest frontier first.

    `unreachable`: cells of borders without a path to them, where the robot would fit. `enclosed`: the robot fits
    nowhere. `between`: (k, k) m to drive between the first k = min(n, 20), on a grid three times as coarse.
    """

    frontiers: tuple[Frontier, ...]
    unreachable: tuple[Int64s, ...]
    enclosed: bool
    between: Float64s


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """Input of a search.

    `cells`: (h, w) int8, percent, -1 unknown; its lower left cell is (first_row, first_column) of `map`. `resolution`:
    m. `x`, `y`: m, the robot. `robot_radius`: m, inscribed. `dropped`: (n, 2) int64 cells of `map` that are no
    frontiers, with their neighbours.
    """

    cells: Int8s
    first_row: int
    first_column: int
    resolution: float
    x: float
    y: float
    robot_radius: float
    dropped: Int64s


def find_frontiers(snapshot: Snapshot, config: FrontierConfig) -> Frontiers:
    """The reachable frontiers of a map, the nearest first."""
    cells, resolution = snapshot.cells, snapshot.resolution
    clearance = snapshot.robot_radius + config.margin
    distance = distance_field(cells >= OCCUPIED_FROM, resolution)
    column, row = snapshot.x / resolution - snapshot.first_column, snapshot.y / resolution - snapshot.first_row
    h, w = cells.shape
    if not (0 <= row < h and 0 <= column < w):
        return Frontiers((), (), True, np.zeros((0, 0)))
    free = _free_cells(cells, row, column, snapshot.robot_radius / resolution)
    passable = free & (distance >= clearance - 1e-6)
    travelled = _travel_costs(passable, distance, int(row), int(column), _MAX_ESCAPE_M / resolution)
    if (
        np.count_nonzero(travelled < _UNREACHED) * resolution**2 < _MIN_REACHABLE_M2
    ):  # a gap may have narrowed since the robot drove in
        tight = free & (distance >= snapshot.robot_radius + min(config.min_margin, config.margin) - 1e-6)
        travelled = _travel_costs(tight, distance, int(row), int(column), _MAX_ESCAPE_M / resolution)
    enclosed = not bool((passable & (travelled < _UNREACHED)).any())
    # a desk seen along its edge leaves few hits, so unknown space bounds the room like an obstacle
    room = np.minimum(distance, distance_field(_surrounded_unknown(free, cells), resolution) - resolution)
    room_wanted = max(clearance, snapshot.robot_radius + config.goal_margin)
    places = passable & (room >= room_wanted - 1e-6)
    n_steps = ceil(room_wanted / resolution) + 3
    seen_from = _nearest_places(free, places & (travelled < _UNREACHED), n_steps)
    cut_off_from = _nearest_places(free, places & (travelled == _UNREACHED), n_steps)
    border = _border_cells(free, cells)
    dropped = snapshot.dropped - (snapshot.first_row, snapshot.first_column)
    dropped = dropped[((dropped >= 0) & (dropped < (h, w))).all(axis=1)]
    for dr in (-1, 0, 1):
        for dc in (-1, 0, 1):
            border[np.clip(dropped[:, 0] + dr, 0, h - 1), np.clip(dropped[:, 1] + dc, 0, w - 1)] = False
    n_min, n_max = config.min_size / resolution, max(int(config.max_size / resolution), 1)
    deep = distance >= snapshot.robot_radius
    pieces, ends = _split_border(border & (seen_from >= 0), deep, n_min, n_max)
    others, other_ends = _split_border(border & (seen_from < 0) & (cut_off_from >= 0), deep, n_min, n_max)
    unknown = np.pad((cells < 0) | ((cells > FREE_UP_TO) & (cells < OCCUPIED_FROM)), 1, constant_values=True)
    frontiers = sorted(
        (
            _frontier(pieces[begin:end], snapshot, unknown, seen_from, travelled)
            for begin, end in zip((0, *ends[:-1]), ends)
        ),
        key=attrgetter("distance"),
    )
    unreachable = tuple(
        _map_cells(others[begin:end], snapshot) for begin, end in zip((0, *other_ends[:-1]), other_ends)
    )
    return Frontiers(
        tuple(frontiers),
        unreachable,
        enclosed,
        _distances_between(np.asarray(travelled < _UNREACHED), snapshot, frontiers[:_MAX_TOURED]),
    )


def _distances_between(reached: Bools, snapshot: Snapshot, frontiers: list[Frontier]) -> Float64s:
    """(k, k) m to drive between the frontiers, over the cells that the robot can reach."""
    h, w = (-(-n // _COARSE_CELLS) * _COARSE_CELLS for n in reached.shape)
    padded = np.zeros((h, w), np.bool_)
    padded[: reached.shape[0], : reached.shape[1]] = reached
    coarse: Bools = np.asarray(
        padded.reshape(h // _COARSE_CELLS, _COARSE_CELLS, w // _COARSE_CELLS, _COARSE_CELLS).any(axis=(1, 3))
    )
    nowhere = np.zeros(coarse.shape, np.float32)  # no escape is needed: the robot fits at these poses
    side = snapshot.resolution * _COARSE_CELLS
    x0, y0 = snapshot.first_column * snapshot.resolution, snapshot.first_row * snapshot.resolution
    rows = [int((f.y - y0) / side) for f in frontiers]
    columns = [int((f.x - x0) / side) for f in frontiers]
    between = np.zeros((len(frontiers), len(frontiers)))
    for i, (row, column) in enumerate(zip(rows, columns)):
        between[i] = _travel_costs(coarse, nowhere, row, column, 0.0)[rows, columns] / _STRAIGHT * side
    return np.asarray(np.maximum(between, between.T))


def _map_cells(piece: Int32s, snapshot: Snapshot) -> Int64s:
    """(n, 2) int64: rows and columns of `map`."""
    rows, columns = np.divmod(piece.astype(np.int64), snapshot.cells.shape[1])
    return np.column_stack((rows + snapshot.first_row, columns + snapshot.first_column))


def _frontier(piece: Int32s, snapshot: Snapshot, unknown: Bools, seen_from: Int32s, travelled: Int32s) -> Frontier:
    """The frontier of a section of border. unknown: (h + 2, w + 2) bool, with a ring for the outside."""
    resolution, row0, column0 = snapshot.resolution, snapshot.first_row, snapshot.first_column
    w = snapshot.cells.shape[1]
    rows, columns = np.divmod(piece.astype(np.int64), w)
    middle = int(piece[int(np.argmin((rows - rows.mean()) ** 2 + (columns - columns.mean()) ** 2))])
    goal_row, goal_column = divmod(int(seen_from.reshape(-1)[middle]), w)
    up = across = 0
    for dr, dc in ((0, 1), (1, 0), (0, -1), (-1, 0)):
        n = int(np.count_nonzero(unknown[rows + 1 + dr, columns + 1 + dc]))
        up, across = up + dr * n, across + dc * n
    return Frontier(
        x=(column0 + goal_column + 0.5) * resolution,
        y=(row0 + goal_row + 0.5) * resolution,
        yaw=atan2(up, across),
        size=len(piece) * resolution,
        distance=float(travelled[goal_row, goal_column]) / _STRAIGHT * resolution,
        cells=_map_cells(piece, snapshot),
    )


@njit(cache=True, nogil=True)
def _free_cells(cells: Int8s, row: float, column: float, radius: float) -> Bools:
    """Cells known to be free by the map, or because the robot stands there. row, column, radius: in cells."""
    h, w = cells.shape
    free = np.empty((h, w), np.bool_)
    for r in range(h):
        for c in range(w):
            under = (r + 0.5 - row) ** 2 + (c + 0.5 - column) ** 2 <= radius * radius
            free[r, c] = 0 <= cells[r, c] <= FREE_UP_TO or (under and cells[r, c] < OCCUPIED_FROM)
    return free


@njit(cache=True, nogil=True)
def _surrounded_unknown(free: Bools, cells: Int8s) -> Bools:
    """Unknown cells with unknown neighbours only, so no gaps between beams. The rim of the grid is left out."""
    h, w = free.shape
    deep = np.zeros((h, w), np.bool_)
    for r in range(1, h - 1):
        for c in range(1, w - 1):
            unknown = True
            for i in range(r - 1, r + 2):
                for k in range(c - 1, c + 2):
                    unknown = unknown and not free[i, k] and cells[i, k] < OCCUPIED_FROM
            deep[r, c] = unknown
    return deep


@njit(cache=True, nogil=True)
def _border_cells(free: Bools, cells: Int8s) -> Bools:
    """Free cells beside an unknown one; outside the grid everything is unknown."""
    h, w = cells.shape
    border = np.zeros((h, w), np.bool_)
    for r in range(h):
        for c in range(w):
            if not free[r, c]:
                continue
            for dr, dc in ((0, 1), (1, 0), (0, -1), (-1, 0)):
                i, k = r + dr, c + dc
                outside = i < 0 or k < 0 or i >= h or k >= w
                if outside or (not free[i, k] and cells[i, k] < OCCUPIED_FROM):
                    border[r, c] = True
                    break
    return border


@njit(cache=True, nogil=True)
def _travel_costs(passable: Bools, distance: Float32s, row: int, column: int, escape: float) -> Int32s:
    """Least travel from a cell over passable ones, in 1/70 cells; _UNREACHED elsewhere.

    Where the robot's own cell is not passable, up to `escape` cells of unoccupied ones lead out.
    """
    h, w = passable.shape
    travelled = np.full((h, w), _UNREACHED, np.int32)
    queue = np.empty(h * w + 1, np.int32)  # a ring: each cell is in it at most once
    queued = np.zeros((h, w), np.bool_)
    travelled[row, column] = 0
    queue[0] = row * w + column
    first, n = 0, 1
    while n:
        cell = queue[first]
        first = (first + 1) % len(queue)
        n -= 1
        r, c = cell // w, cell % w
        queued[r, c] = False
        for dr in range(-1, 2):
            for dc in range(-1, 2):
                i, k = r + dr, c + dc
                if (dr == 0 and dc == 0) or i < 0 or k < 0 or i >= h or k >= w:
                    continue
                if passable[r, c]:
                    if not (passable[i, k] and passable[r, k] and passable[i, c]):
                        continue
                elif distance[i, k] == 0 or (i - row) ** 2 + (k - column) ** 2 > escape * escape:
                    continue
                new = travelled[r, c] + (_DIAGONAL if dr and dc else _STRAIGHT)
                if new < travelled[i, k]:
                    travelled[i, k] = new
                    if not queued[i, k]:
                        queued[i, k] = True
                        queue[(first + n) % len(queue)] = i * w + k
                        n += 1
    return travelled


@njit(cache=True, nogil=True)
def _nearest_places(free: Bools, places: Bools, n_steps: int) -> Int32s:
    """For each free cell within n_steps of a place: the index of the nearest place, else -1."""
    h, w = free.shape
    source = np.full((h, w), -1, np.int32)
    queue = np.empty(h * w, np.int32)
    n = 0
    for r in range(h):
        for c in range(w):
            if places[r, c]:
                source[r, c] = r * w + c
                queue[n] = r * w + c
                n += 1
    begin = 0
    for _ in range(n_steps):
        end = n
        for q in range(begin, end):
            r, c = queue[q] // w, queue[q] % w
            for dr, dc in ((0, 1), (1, 0), (0, -1), (-1, 0)):
                i, k = r + dr, c + dc
                if 0 <= i < h and 0 <= k < w and free[i, k] and source[i, k] < 0:
                    source[i, k] = source[r, c]
                    queue[n] = i * w + k
                    n += 1
        begin = end
    return source


@njit(cache=True, nogil=True)
def _split_border(border: Bools, deep: Bools, n_min: float, n_max: int) -> tuple[Int32s, list[int]]:
    """8-connected sections of the border: their cells one after the other, and the end of each.

    Borders under n_min cells across, or without a deep cell, are left out: the robot could not drive through. Borders
    of over n_max cells are split.
    """
    h, w = border.shape
    todo = border.copy()
    whole = np.empty(np.count_nonzero(border), np.int32)
    cells = np.empty(len(whole), np.int32)
    n_cells = 0
    ends = [0 for _ in range(0)]
    for start in range(h * w):
        if not todo[start // w, start % w]:
            continue
        n = _flood(todo, start, whole, len(whole))
        rows, columns = whole[:n] // w, whole[:n] % w
        if max(rows.max() - rows.min(), columns.max() - columns.min()) + 1 < n_min:
            continue
        n_deep = 0
        for cell in whole[:n]:
            n_deep += deep[cell // w, cell % w]
        if not n_deep:
            continue
        for i in range(n):
            todo[whole[i] // w, whole[i] % w] = True
        for i in range(n):
            if todo[whole[i] // w, whole[i] % w]:
                n_cells += _flood(todo, int(np.int64(whole[i])), cells[n_cells:], n_max)
                ends.append(n_cells)
    return cells, ends


@njit(cache=True, nogil=True)
def _flood(todo: Bools, start: int, cells: Int32s, n_max: int) -> int:
    """Moves at most n_max cells connected with `start`, nearest first, from `todo` to `cells`. Returns their number."""
    h, w = todo.shape
    todo[start // w, start % w] = False
    cells[0] = start
    n, q = 1, 0
    while q < n:
        r, c = cells[q] // w, cells[q] % w
        q += 1
        for i in range(max(r - 1, 0), min(r + 2, h)):
            for k in range(max(c - 1, 0), min(c + 2, w)):
                if todo[i, k] and n < n_max:
                    todo[i, k] = False
                    cells[n] = i * w + k
                    n += 1
    return n
