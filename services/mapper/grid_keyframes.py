# SPDX-License-Identifier: Apache-2.0
"""A grid map without a pose graph, such as one of ROS map_server, as a saved map: with keyframes that are ray-cast.

A virtual laser stands on viewpoints all over the free space and sees the grid's occupied cells. Its sweeps are the
keyframes, and each pose is exact. So all that works on a map of the mapper's own works on it: global localization,
closures, noticing that the robot was carried away, and going on with the map.
"""

from dataclasses import replace
from math import pi, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from services.mapper.keyframe import Keyframe
from services.mapper.occupancy import Occupancy, OccupancyConfig
from services.mapper.pose_graph import Graph, between
from services.mapper.saved_map import SavedMap
from services.mapper.surface import cell_surface
from shared.config import UserError
from shared.distance_field import distance_field
from shared.geometry import Bools, Float64s, Pose2
from shared.grid import FREE_UP_TO, OCCUPIED_FROM, UNKNOWN, OccupancyGrid, update_of_cells
from shared.messages import TILE_CELLS, MapUpdate

Int8s = NDArray[np.int8]
Int64s = NDArray[np.int64]

MAX_TILES = 20_000  # that the map may span, 80 MB of cells: a square of 450 m at 0.05 m a cell
MAX_KEYFRAMES = 3000  # of a larger map the viewpoints lie farther apart
SPACING = 1.5  # m between viewpoints: blocks so wide hold one for each of their connected free parts
MIN_CLEARANCE = 0.1  # m from a viewpoint to what is not free: gaps and specks have none
N_BEAMS = 480
EDGE = 1e-2  # cells
RANGE = 10.0  # m of a beam
N_SWEEPS = 3  # that must draw a cell before it is free
EXACT = 1e8 * np.eye(3)
"""Information of an edge: the grid says where the viewpoints are."""


def saved_map_of(tiles: MapUpdate, resolution: float) -> SavedMap:
    """A map of tiles as one with keyframes, in the same frame, its cells of `resolution` m.

    A map of larger cells has each of them cut up; of smaller ones an occupied cell counts, then a free one. Every node
    of the graph is fixed. Raises UserError where the tiles hold nothing to find a robot by, or lie too far apart.
    """
    if len(tiles.rows) and (int(np.ptp(tiles.rows)) + 1) * (int(np.ptp(tiles.columns)) + 1) > MAX_TILES:
        raise UserError(
            "the map's tiles lie too far apart to be one building",
            "are there stray cells far away? cut the picture in a drawing program",
        )
    source = OccupancyGrid(tiles.resolution, tiles.map_id)
    source.apply(tiles)
    if not source.occupied.any():
        raise UserError(
            "the map holds no occupied cell to find the robot by", "look at it with zenav map show: is `negate` right?"
        )
    tiles = resampled(source, resolution)
    grid = OccupancyGrid(resolution, tiles.map_id)
    grid.apply(tiles)
    cells = viewpoints(grid.free, resolution)
    if not len(cells):
        raise UserError(
            "the map holds no free space for a robot",
            "look at it with zenav map show: are `negate` and the mode right?",
        )
    at = cells[:, ::-1] + 0.5
    poses = np.column_stack((at * resolution + (grid.x0, grid.y0), np.zeros(len(at))))
    keyframes = [_keyframe(grid, source.resolution, k, Pose2(*row)) for k, row in enumerate(poses.tolist())]
    keyframes = _completed(keyframes, grid)
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    return SavedMap(_exact(poses), tuple(keyframes), np.concatenate(((0.0,), np.cumsum(steps))), tiles)


def cast(map_id: int, tiles: MapUpdate) -> tuple[int, SavedMap | None]:
    """The map of that id with keyframes in cells as they are; None where it holds nothing to find a robot by."""
    try:
        return map_id, saved_map_of(tiles, tiles.resolution)
    except UserError:
        return map_id, None


def resampled(grid: OccupancyGrid, resolution: float) -> MapUpdate:
    """A grid's cells on cells of `resolution` m."""
    if grid.resolution == resolution:
        return grid.update_of(np.asarray(grid.cells != UNKNOWN), 0)
    h, w = grid.cells.shape
    row0, column0 = round(grid.y0 / resolution), round(grid.x0 / resolution)
    ratio = grid.resolution / resolution
    shape = max(round(h * ratio), 1), max(round(w * ratio), 1)
    if ratio >= 1:
        rows, columns = (
            np.minimum(((np.arange(n) + 0.5) / ratio).astype(np.int64), m - 1) for n, m in zip(shape, (h, w))
        )
        cells = grid.cells[np.ix_(rows, columns)]
    else:
        cells = np.full(shape, UNKNOWN, np.int8)
        rows, columns = (
            np.minimum(((np.arange(m) + 0.5) * ratio).astype(np.int64), n - 1) for n, m in zip(shape, (h, w))
        )
        np.maximum.at(cells, np.ix_(rows, columns), grid.cells)
    return update_of_cells(cells, resolution, column0 * resolution, row0 * resolution)


def viewpoints(free: Bools, resolution: float) -> Int64s:
    """(n, 2) rows and columns of cells from which together all free space is seen, in the order of a tour.

    free: (h, w) bool.  One for each connected part of each block of SPACING m, the farthest from what is not free.
    """
    clearance = distance_field(~np.pad(free, 1), resolution)[1:-1, 1:-1]
    wide = max(SPACING, sqrt(float((clearance >= MIN_CLEARANCE).sum()) * resolution**2 / MAX_KEYFRAMES))
    while True:
        found = _widest(free, np.ascontiguousarray(clearance), max(round(wide / resolution), 1), MIN_CLEARANCE)
        if len(found) <= MAX_KEYFRAMES:
            return np.asarray(found[_tour(found)])
        wide *= 1.2


def _keyframe(grid: OccupancyGrid, coarsest: float, k: int, pose: Pose2) -> Keyframe:
    """The k-th sweep, from a pose with heading 0. coarsest: m, cells of the map as it was given."""
    size = max(grid.resolution, coarsest)
    row, column = grid.cell(pose.x, pose.y)
    # every sweep begins elsewhere between two beams: what one misses, the next one sees
    angles = 2 * pi / N_BEAMS * (np.arange(N_BEAMS) + (k * 0.618) % 1)
    hits, ends = _swept(grid.cells, row, column, angles, RANGE / grid.resolution)
    ends = (ends - (column + 0.5, row + 0.5)) * grid.resolution
    seen = hits[:, 0] >= 0
    centres = (hits[:, ::-1] + 0.5) * grid.resolution + (grid.x0, grid.y0)
    cells = np.floor(centres[seen] / size + 1e-6)
    _, first = np.unique(cells, axis=0, return_index=True)
    points, normals = cell_surface(np.ascontiguousarray((cells[np.sort(first)] + 0.5) * size - (pose.x, pose.y)), size)
    silent = np.where(seen[:, None], np.nan, ends) if not seen.all() else np.zeros((0, 2))
    drawn = np.where(seen[:, None], ends, np.nan)
    arrays = (array.astype(np.float32) for array in (np.zeros_like(drawn), drawn, points, normals, silent))
    return Keyframe(k + 1, pose, *arrays)


def _completed(keyframes: list[Keyframe], grid: OccupancyGrid) -> list[Keyframe]:
    """With beams for the cells that the sweeps do not show, each drawn from within by the nearest keyframes.

    Behind a gap, where no viewpoint is, walls stay walls when the map is drawn again. What lies behind a surface is
    left out.
    """
    drawn = Occupancy(OccupancyConfig(resolution=grid.resolution), grid.map_id)
    for keyframe in keyframes:
        keyframe.draw(drawn, keyframe.local_from_base)
    drawn.settle()
    shown = np.full_like(grid.cells, UNKNOWN)
    for (row, column), i in drawn.places.items():
        r, c = (row - grid.first_row) * TILE_CELLS, (column - grid.first_column) * TILE_CELLS
        shown[r : r + TILE_CELLS, c : c + TILE_CELLS] = drawn.known[i].reshape(TILE_CELLS, TILE_CELLS) - 1
    free = np.pad(grid.free, 1)
    beside = free[2:, 1:-1] | free[:-2, 1:-1] | free[1:-1, 2:] | free[1:-1, :-2]
    walls = np.argwhere(grid.occupied & beside & (shown < OCCUPIED_FROM))
    gaps = np.argwhere(grid.free & ((shown < 0) | (shown > FREE_UP_TO)))
    centres = (np.concatenate((walls, gaps))[:, ::-1] + 0.5) * grid.resolution + (grid.x0, grid.y0)
    at = np.array([(k.local_from_base.x, k.local_from_base.y) for k in keyframes])
    _, nearest = cKDTree(at).query(centres, np.arange(1, min(N_SWEEPS, len(at)) + 1))
    is_wall = np.arange(len(centres)) < len(walls)
    return [
        _with(keyframe, centres[mine & is_wall], centres[mine & ~is_wall], grid.resolution)
        for k, keyframe in enumerate(keyframes)
        for mine in [(nearest == k).any(axis=1)]
    ]


def _with(keyframe: Keyframe, walls: Float64s, gaps: Float64s, resolution: float) -> Keyframe:
    """The keyframe with beams that begin and end in occupied cells (n, 2) m, and that begin in free ones (k, 2) m."""
    at = np.array((keyframe.local_from_base.x, keyframe.local_from_base.y))
    origins = np.concatenate((walls, gaps)) - at
    nothing = np.full_like(gaps, np.nan)
    ends = np.concatenate((walls - at, nothing))
    silent = np.concatenate((np.full_like(walls, np.nan), gaps - at + (resolution, 0.0)))  # the last cell is not drawn
    before = keyframe.silent if len(keyframe.silent) else np.full_like(keyframe.ends, np.nan)
    return replace(
        keyframe,
        origins=np.concatenate((keyframe.origins, origins.astype(np.float32))),
        ends=np.concatenate((keyframe.ends, ends.astype(np.float32))),
        silent=np.concatenate((before, silent.astype(np.float32))),
    )


def _exact(poses: Float64s) -> Graph:
    """A graph of fixed nodes at poses (n, 3), each known exactly from the first."""
    n = len(poses)
    others = np.arange(1, n)
    loops = np.zeros(n - 1, np.bool_)
    return Graph(
        np.arange(n), poses, np.ones(n, np.bool_), np.arange(n - 1), np.zeros(n - 1, np.int64), others,
        between(poses[:1], poses[1:]), np.tile(EXACT, (n - 1, 1, 1)), loops, ~loops,
    )  # fmt: skip


@njit(cache=True, nogil=True)
def _widest(free, clearance, side, least):  # type: ignore[no-untyped-def]  # compiled; (h, w), (h, w) m, cells, m -> (n, 2) rows and columns
    """The cell with the most clearance, over `least`, of each 4-connected free part of each block of side x side."""
    h, w = free.shape
    done = np.zeros((h, w), np.bool_)
    stack = np.empty((side * side, 2), np.int64)
    found = np.empty((1024, 2), np.int64)
    n = 0
    for r0 in range(0, h, side):
        for c0 in range(0, w, side):
            r1, c1 = min(r0 + side, h), min(c0 + side, w)
            for r in range(r0, r1):
                for c in range(c0, c1):
                    if done[r, c] or not free[r, c]:
                        continue
                    best, best_r, best_c = -1.0, r, c
                    stack[0, 0], stack[0, 1], top = r, c, 1
                    done[r, c] = True
                    while top > 0:
                        top -= 1
                        rr, cc = stack[top, 0], stack[top, 1]
                        if clearance[rr, cc] > best:
                            best, best_r, best_c = clearance[rr, cc], rr, cc
                        for dr, dc in ((0, 1), (1, 0), (0, -1), (-1, 0)):
                            nr, nc = rr + dr, cc + dc
                            if r0 <= nr < r1 and c0 <= nc < c1 and free[nr, nc] and not done[nr, nc]:
                                done[nr, nc] = True
                                stack[top, 0], stack[top, 1] = nr, nc
                                top += 1
                    if best >= least:
                        if n == len(found):
                            found = np.concatenate((found, np.empty_like(found)))
                        found[n, 0], found[n, 1] = best_r, best_c
                        n += 1
    return found[:n].copy()


@njit(cache=True, nogil=True)
def _tour(cells):  # type: ignore[no-untyped-def]  # compiled; (n, 2) -> (n,) int64, the order in which each is the nearest that is left
    n = len(cells)
    order = np.arange(n)
    for k in range(1, n):
        last = cells[order[k - 1]]
        best, nearest = k, np.int64(2**62)
        for m in range(k, n):
            dr, dc = cells[order[m], 0] - last[0], cells[order[m], 1] - last[1]
            if dr * dr + dc * dc < nearest:
                best, nearest = m, dr * dr + dc * dc
        order[k], order[best] = order[best], order[k]
    return order


@njit(cache=True, nogil=True)
def _swept(cells, row, column, angles, reach):  # type: ignore[no-untyped-def]  # compiled; (h, w) percent, (n,) rad -> (n, 2) int64, (n, 2) float64
    """Beams from the middle of a free cell up to `reach` cells.

    Returns the row and column of the occupied cell that each hits, or -1, and where it ends: (x, y) in cells, just
    inside that cell; or as far as it is free. Amanatides & Woo 1987; no beam slips between two cells that touch.
    """
    h, w = cells.shape
    n = len(angles)
    hits, ends = np.full((n, 2), -1, np.int64), np.empty((n, 2))
    x0, y0 = column + 0.5, row + 0.5
    for k in range(n):
        dx, dy = np.cos(angles[k]), np.sin(angles[k])
        r, c, along = row, column, 0.0
        step_c, step_r = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
        each_c, each_r = 1 / max(abs(dx), 1e-12), 1 / max(abs(dy), 1e-12)
        next_c, next_r = 0.5 * each_c, 0.5 * each_r
        while True:
            before = along
            if next_c < next_r:
                along, c = next_c, c + step_c
                next_c += each_c
            else:
                along, r = next_r, r + step_r
                next_r += each_r
            if along > reach or r < 0 or c < 0 or r >= h or c >= w:
                along = min(along, reach)
                break
            if cells[r, c] >= OCCUPIED_FROM:
                hits[k, 0], hits[k, 1] = r, c
                break
            if cells[r, c] < 0 or cells[r, c] > FREE_UP_TO:
                break
        # not on the edge between two cells
        there = along + EDGE if hits[k, 0] >= 0 else max(along - EDGE, 0.5 * before)
        ends[k, 0], ends[k, 1] = x0 + there * dx, y0 + there * dy
    return hits, ends
