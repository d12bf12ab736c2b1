# SPDX-License-Identifier: Apache-2.0
"""Cells of the map that a user's edits change: erased cells, and cells of virtual walls.

Edits lie over the cells that the laser drew. An erased cell is free if it is known. A cell of a wall is occupied. Where
both lie, the wall counts. Polygons are filled by scan lines and the even-odd rule (Foley et al., "Computer Graphics:
Principles and Practice", 1990, section 3.6). The band of cells of a wall is our own.
"""

from collections.abc import Collection, Iterable, Sequence
from itertools import pairwise
from math import floor

import numpy as np

from shared.messages import MAX_EDITS, TILE_CELLS, EditKind, MapEdit, MapUpdate
from shared.types import Bools, Float64s, Int8s, Int64s, UInt8s

ERASED, WALL = np.uint8(1), np.uint8(2)
"""Values of a mask; 0 is a cell without an edit."""
FREE, OCCUPIED = np.int8(0), np.int8(100)  # percent
CROSSED_CELLS = 0.7072  # from a line to the centre of a cell that it crosses, at most: half a diagonal
MAX_DRAWN_M2 = 10_000.0  # of all edits of a map: some 0.2 s to draw at 0.05 m per cell

EditMasks = dict[tuple[int, int], UInt8s]
"""(64, 64) cells of each edited tile, by the tile's row and column."""


def edit_masks(edits: Iterable[MapEdit], resolution: float) -> EditMasks:
    """Returns the masks of edits.  resolution: m per cell."""
    masks: EditMasks = {}
    for edit in sorted(edits, key=lambda edit: edit.kind is EditKind.WALL):
        cells = edited_rows_and_columns(edit, resolution)
        value = WALL if edit.kind is EditKind.WALL else ERASED
        tiles = cells // TILE_CELLS
        for row, column in np.unique(tiles, axis=0).tolist():
            mine = cells[(tiles == (row, column)).all(axis=1)] % TILE_CELLS
            mask = masks.setdefault((row, column), np.zeros((TILE_CELLS, TILE_CELLS), np.uint8))
            mask[mine[:, 0], mine[:, 1]] = value
    return masks


def edits_problem(edits: Sequence[MapEdit]) -> str | None:
    """Returns what is wrong with the edits of a map taken together, or None."""
    if len(edits) > MAX_EDITS:
        return f"a map has at most {MAX_EDITS} edits"
    if sum(bounding_area(edit) for edit in edits) > MAX_DRAWN_M2:
        return f"the edits of a map span at most {MAX_DRAWN_M2:g} m2 together"
    return None


def is_outside(edit: MapEdit, tiles: Collection[tuple[int, int]], resolution: float) -> bool:
    """Whether a point of an edit lies outside the rectangle of a map's tiles.  resolution: m per cell."""
    places, points = np.array(list(tiles)) * TILE_CELLS * resolution, np.column_stack((edit.ys, edit.xs))
    beyond = points > places.max(axis=0) + TILE_CELLS * resolution
    return bool((points < places.min(axis=0)).any() or beyond.any())


def shown_masks(masks: EditMasks, tiles: Collection[tuple[int, int]]) -> EditMasks:
    """Returns the masks near a map of these tiles, by row and column: in their rectangle, or beside it."""
    if not tiles:
        return {}
    rows, columns = zip(*tiles)
    first_row, last_row, first_column, last_column = min(rows), max(rows), min(columns), max(columns)
    return {
        (row, column): mask
        for (row, column), mask in masks.items()
        if first_row - 1 <= row <= last_row + 1 and first_column - 1 <= column <= last_column + 1
    }


def edited_cells(cells: Int8s, mask: UInt8s) -> Int8s:
    """Returns cells in percent, -1 unknown, with the edits of a mask of the same shape."""
    erased = np.where((mask == ERASED) & (cells >= 0), FREE, cells)
    return np.where(mask == WALL, OCCUPIED, erased).astype(np.int8)


def with_edits(tiles: MapUpdate, edits: Iterable[MapEdit]) -> MapUpdate:
    """Returns tiles without edits with these edits. A wall in a tile that does not exist adds the tile."""
    cells = dict(zip(zip(tiles.rows.tolist(), tiles.columns.tolist()), tiles.cells))
    for tile, mask in shown_masks(edit_masks(edits, tiles.resolution), cells).items():
        if tile in cells or (mask == WALL).any():
            before = cells.get(tile, np.full(TILE_CELLS**2, -1, np.int8))
            cells[tile] = edited_cells(before, mask.reshape(-1))
    return _replaced(tiles, cells)


def without_walls(tiles: MapUpdate, edits: Iterable[MapEdit]) -> MapUpdate:
    """Returns tiles with unknown cells where they show walls, which no laser can see."""
    cells = dict(zip(zip(tiles.rows.tolist(), tiles.columns.tolist()), tiles.cells))
    for tile, mask in edit_masks(edits, tiles.resolution).items():
        if tile in cells:
            cells[tile] = np.where(mask.reshape(-1) == WALL, np.int8(-1), cells[tile])
    return _replaced(tiles, cells)


def _replaced(tiles: MapUpdate, cells: dict[tuple[int, int], Int8s]) -> MapUpdate:
    places = sorted(cells)
    return MapUpdate(
        stamp=tiles.stamp,
        map_id=tiles.map_id,
        version=tiles.version,
        resolution=tiles.resolution,
        rows=np.array([row for row, _ in places], np.int32),
        columns=np.array([column for _, column in places], np.int32),
        cells=np.array([cells[place] for place in places], np.int8).reshape(len(places), TILE_CELLS**2),
    )


def erased_points(masks: EditMasks, points: Float64s, resolution: float) -> Bools:
    """(n,) bool: which points (n, 2) m in `map` lie in erased cells."""
    erased = np.zeros(len(points), np.bool_)
    cells = np.floor(points[:, ::-1] / resolution).astype(np.int64)
    tiles, inside = cells // TILE_CELLS, cells % TILE_CELLS
    for tile, mask in masks.items():
        here = (tiles == tile).all(axis=1)
        erased[here] = mask[inside[here, 0], inside[here, 1]] == ERASED
    return erased


def edited_rows_and_columns(edit: MapEdit, resolution: float) -> Int64s:
    """(n, 2) rows and columns of the cells of an edit, counted from the origin of `map`."""
    points = np.column_stack((edit.xs, edit.ys)) / resolution
    if edit.width == 0:
        return _polygon_cells(points)
    reach = max(edit.width / 2 / resolution, CROSSED_CELLS)
    pieces = pairwise(points) if len(points) > 1 else ((points[0], points[0]),)
    return np.concatenate([_band_cells(start, end, reach) for start, end in pieces])


def bounding_area(edit: MapEdit) -> float:
    """Returns the area, m^2, of the rectangles that a drawing of an edit goes through."""
    points = np.column_stack((edit.xs, edit.ys))
    if edit.width == 0:
        return float(np.prod(np.ptp(points, axis=0)))
    steps = np.abs(np.diff(points, axis=0)) if len(points) > 1 else np.zeros((1, 2))
    return float(np.prod(steps + edit.width, axis=1).sum())


def _polygon_cells(points: Float64s) -> Int64s:
    """Rows and columns of the cells with their centre in a polygon (k, 2), in cells: scan lines, even-odd rule."""
    low, high = np.floor(points.min(axis=0)).astype(np.int64), np.floor(points.max(axis=0)).astype(np.int64) + 1
    (first_column, first_row), (width, height) = low.tolist(), (high - low).tolist()
    y = np.arange(height)[:, None] + first_row + 0.5
    starts, ends = points, np.roll(points, -1, axis=0)
    rows, edges = np.nonzero((starts[:, 1] > y) != (ends[:, 1] > y))
    start, end = starts[edges], ends[edges]
    x = start[:, 0] + (y[rows, 0] - start[:, 1]) * (end[:, 0] - start[:, 0]) / (end[:, 1] - start[:, 1])
    columns = np.clip(np.floor(x - 0.5).astype(np.int64) + 1 - first_column, 0, width)  # first centre beyond the edge
    crossings = np.zeros((height, width + 1), np.int64)
    np.add.at(crossings, (rows, columns), 1)
    inside = np.argwhere(np.cumsum(crossings, axis=1)[:, :width] % 2 == 1)
    return np.asarray(inside + np.array((first_row, first_column)))


def _band_cells(start: Float64s, end: Float64s, reach: float) -> Int64s:
    """Rows and columns of the cells with their centre within `reach` of a segment; all in cells."""
    (x0, y0), (x1, y1) = start.tolist(), end.tolist()
    first_row, last_row = floor(min(y0, y1) - reach), floor(max(y0, y1) + reach)
    first_column, last_column = floor(min(x0, x1) - reach), floor(max(x0, x1) + reach)
    y = np.arange(first_row, last_row + 1)[:, None] + 0.5 - y0
    x = np.arange(first_column, last_column + 1)[None] + 0.5 - x0
    dx, dy = x1 - x0, y1 - y0
    along = np.clip((x * dx + y * dy) / max(dx * dx + dy * dy, 1e-12), 0, 1)
    near = np.argwhere(np.hypot(x - along * dx, y - along * dy) <= reach)
    return np.asarray(near + np.array((first_row, first_column)))
