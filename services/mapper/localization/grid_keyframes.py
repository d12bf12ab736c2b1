# SPDX-License-Identifier: Apache-2.0
"""Virtual keyframes for a grid map without a pose graph, such as one of ROS map_server: they make it a saved map.

A virtual laser at viewpoints all over the free space is ray-cast against the grid's occupied cells. Its sweeps are the
keyframes, and their poses are exact. With them, the mapper treats the grid as a map of its own. Global localization,
loop closure, kidnap detection and further mapping work on it.

The method is our own: it makes the scans that would draw the grid again.
"""

from math import pi, sqrt

import numpy as np
from numba import njit

from services.mapper.back_end.keyframe import Keyframe
from services.mapper.back_end.pose_graph import Graph, relative_poses
from services.mapper.front_end.surface_normals import cell_surface
from services.mapper.grid.occupancy import Occupancy, OccupancyConfig
from services.mapper.maps.map_file import SavedMap
from shared.config import UserError
from shared.distance_field import distance_field
from shared.geometry import Pose2
from shared.grid import FREE_UP_TO, OCCUPIED_FROM, UNKNOWN, OccupancyGrid, update_of_cells
from shared.messages import TILE_CELLS, MapUpdate
from shared.service import Job, Out
from shared.types import Bools, Float64s, Int64s

MAX_TILES = 20_000  # that the map may span, 80 MB of cells: a square of 450 m at 0.05 m per cell
MAX_KEYFRAMES = 3000  # in a larger map the viewpoints are farther apart
VIEWPOINT_SPACING_M = 1.5  # between viewpoints: a block of this size has one for each connected free region
MIN_CLEARANCE_M = 0.1  # of a viewpoint from cells that are not free, which leaves out gaps and specks
N_BEAMS = 480
EDGE_CELLS = 1e-2  # distance of a beam's end from the edge of a cell
BEAM_RANGE_M = 10.0
N_SWEEPS = 3  # keyframes that draw a hidden cell: so many are needed until it is free
EXACT_INFORMATION = 1e8 * np.eye(3)
"""Information of an edge: the poses of the viewpoints are known."""


def saved_map_from_tiles(tiles: MapUpdate, resolution: float) -> SavedMap:
    """Returns a map of tiles as a saved map with keyframes, in the same frame, with cells of `resolution` m.

    Larger cells are divided. Of several smaller cells the occupied one counts, then the free one. Every node of the
    graph is fixed. Raises UserError if the tiles hold no occupied or no free cell, or span more than MAX_TILES.
    """
    growth = max(tiles.resolution / resolution, 1.0) ** 2  # of the number of tiles, where larger cells are divided
    if len(tiles.rows) and (int(np.ptp(tiles.rows)) + 1) * (int(np.ptp(tiles.columns)) + 1) * growth > MAX_TILES:
        raise UserError(
            "the map's tiles lie too far apart to be one building",
            "is `resolution` right? are there stray cells far away? cut the picture in a drawing program",
        )
    source = OccupancyGrid(tiles.resolution, tiles.map_id)
    source.apply(tiles)
    if not source.occupied.any():
        raise UserError(
            "the map holds no occupied cell to find the robot by", "look at it with zenav map show: is `negate` right?"
        )
    tiles = resample(source, resolution)
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
    keyframes = _add_hidden_cells(keyframes, grid)
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    return SavedMap(_exact(poses), tuple(keyframes), np.concatenate(((0.0,), np.cumsum(steps))), tiles)


def order_virtual_keyframes(grid: Occupancy, tiles: MapUpdate) -> Out:
    """Orders the keyframes of a grid that was loaded without a graph, unless its cells are not of the set size.

    tiles: of the grid, without edits.
    """
    if tiles.resolution == grid.config.resolution:
        yield Job(add_virtual_keyframes, (grid.map_id, tiles), "on_virtual_keyframes", 1.0)


def add_virtual_keyframes(map_id: int, tiles: MapUpdate) -> tuple[int, SavedMap | None]:
    """Returns the map's id, and the map with keyframes at its own resolution; None without occupied or free cells."""
    try:
        return map_id, saved_map_from_tiles(tiles, tiles.resolution)
    except UserError:
        return map_id, None


def resample(grid: OccupancyGrid, resolution: float) -> MapUpdate:
    """Returns a grid's cells at another resolution, m per cell."""
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
    """Returns (n, 2) rows and columns of cells that together see the free space, in the order of a tour.

    free: (h, w) bool.  resolution: m per cell.  Each connected region of each block of VIEWPOINT_SPACING_M has one, the
    cell with the greatest clearance.
    """
    clearance = distance_field(~np.pad(free, 1), resolution)[1:-1, 1:-1]
    wide = max(VIEWPOINT_SPACING_M, sqrt(float((clearance >= MIN_CLEARANCE_M).sum()) * resolution**2 / MAX_KEYFRAMES))
    while True:
        cells = _clearest_cells(
            free, np.ascontiguousarray(clearance), max(round(wide / resolution), 1), MIN_CLEARANCE_M
        )
        if len(cells) <= MAX_KEYFRAMES:
            return np.asarray(cells[_tour(cells)])
        wide *= 1.2


def _keyframe(grid: OccupancyGrid, coarsest: float, k: int, pose: Pose2) -> Keyframe:
    """Returns the k-th keyframe, from a pose with yaw 0.  coarsest: m, cell size of the original map."""
    size = max(grid.resolution, coarsest)
    row, column = grid.cell(pose.x, pose.y)
    # the first angle differs from sweep to sweep: a cell between two beams of one is hit by the next
    angles = 2 * pi / N_BEAMS * (np.arange(N_BEAMS) + (k * 0.618) % 1)
    hits, ends = _cast_beams(grid.cells, row, column, angles, BEAM_RANGE_M / grid.resolution)
    ends = (ends - (column + 0.5, row + 0.5)) * grid.resolution
    seen = hits[:, 0] >= 0
    centres = (hits[:, ::-1] + 0.5) * grid.resolution + (grid.x0, grid.y0)
    cells = np.floor(centres[seen] / size + 1e-6)
    _, first = np.unique(cells, axis=0, return_index=True)
    points, normals = cell_surface(np.ascontiguousarray((cells[np.sort(first)] + 0.5) * size - (pose.x, pose.y)), size)
    silent = np.where(seen[:, None], np.nan, ends) if not seen.all() else np.zeros((0, 2))
    hit_ends = np.where(seen[:, None], ends, np.nan)
    return Keyframe.of(
        stamp=k + 1,
        local_from_base=pose,
        origins=np.zeros_like(hit_ends),
        ends=hit_ends,
        points=points,
        normals=normals,
        silent=silent,
    )


def _add_hidden_cells(keyframes: list[Keyframe], grid: OccupancyGrid) -> list[Keyframe]:
    """Returns the keyframes with extra beams for cells that no sweep shows, in the nearest keyframes.

    The beams begin and end in these cells. So walls behind a gap, where no viewpoint is, stay when the map is redrawn.
    Cells behind a surface are left out.
    """
    occupancy = Occupancy(OccupancyConfig(resolution=grid.resolution), grid.map_id)
    for keyframe in keyframes:
        keyframe.draw(occupancy, keyframe.local_from_base)
    occupancy.update_cells()
    shown_cells = np.full_like(grid.cells, UNKNOWN)
    for (row, column), i in occupancy.tile_index.items():
        r, c = (row - grid.first_row) * TILE_CELLS, (column - grid.first_column) * TILE_CELLS
        shown_cells[r : r + TILE_CELLS, c : c + TILE_CELLS] = occupancy.cells[i].reshape(TILE_CELLS, TILE_CELLS) - 1
    free = np.pad(grid.free, 1)
    beside = free[2:, 1:-1] | free[:-2, 1:-1] | free[1:-1, 2:] | free[1:-1, :-2]
    walls = np.argwhere(grid.occupied & beside & (shown_cells < OCCUPIED_FROM))
    gaps = np.argwhere(grid.free & ((shown_cells < 0) | (shown_cells > FREE_UP_TO)))
    centres = (np.concatenate((walls, gaps))[:, ::-1] + 0.5) * grid.resolution + (grid.x0, grid.y0)
    at = np.array([(k.local_from_base.x, k.local_from_base.y) for k in keyframes])
    nearest = nearest_places(centres, at, min(N_SWEEPS, len(at)))
    is_wall = np.arange(len(centres)) < len(walls)
    return [
        _add_beams(keyframe, centres[mine & is_wall], centres[mine & ~is_wall], grid.resolution)
        for k, keyframe in enumerate(keyframes)
        for mine in [(nearest == k).any(axis=1)]
    ]


@njit(cache=True, nogil=True)
def nearest_places(points, places, count):  # type: ignore[no-untyped-def]  # compiled
    """(n, count) int64: rows of the places (k, 2) nearest to each point (n, 2), from near to far."""
    nearest = np.empty((len(points), count), np.int64)
    distances = np.empty(count)
    for i in range(len(points)):
        distances[:] = np.inf
        for k in range(len(places)):
            distance = (points[i, 0] - places[k, 0]) ** 2 + (points[i, 1] - places[k, 1]) ** 2
            place = count
            while place > 0 and distance < distances[place - 1]:
                if place < count:
                    distances[place], nearest[i, place] = distances[place - 1], nearest[i, place - 1]
                place -= 1
            if place < count:
                distances[place], nearest[i, place] = distance, k
    return nearest


def _add_beams(keyframe: Keyframe, walls: Float64s, gaps: Float64s, resolution: float) -> Keyframe:
    """Returns the keyframe with beams in occupied cells (n, 2) m, and free beams in free cells (k, 2) m."""
    at = np.array((keyframe.local_from_base.x, keyframe.local_from_base.y))
    origins = np.concatenate((walls, gaps)) - at
    nothing = np.full_like(gaps, np.nan)
    ends = np.concatenate((walls - at, nothing))
    silent = np.concatenate((np.full_like(walls, np.nan), gaps - at + (resolution, 0.0)))  # the last cell is not drawn
    before = keyframe.silent if len(keyframe.silent) else np.full_like(keyframe.ends, np.nan)
    return Keyframe.of(
        stamp=keyframe.stamp,
        local_from_base=keyframe.local_from_base,
        origins=np.concatenate((keyframe.origins, origins)),
        ends=np.concatenate((keyframe.ends, ends)),
        points=keyframe.points,
        normals=keyframe.normals,
        silent=np.concatenate((before, silent)),
    )


def _exact(poses: Float64s) -> Graph:
    """Returns a graph of fixed nodes at poses (n, 3), each with an exact edge from the first."""
    n = len(poses)
    loops = np.zeros(n - 1, np.bool_)
    return Graph(
        nodes=np.arange(n),
        poses=poses,
        fixed=np.ones(n, np.bool_),
        edges=np.arange(n - 1),
        i=np.zeros(n - 1, np.int64),
        j=np.arange(1, n),
        relative=relative_poses(poses[:1], poses[1:]),
        information=np.tile(EXACT_INFORMATION, (n - 1, 1, 1)),
        loop=loops,
        on=~loops,
    )


@njit(cache=True, nogil=True)
def _clearest_cells(free, clearance, side, min_clearance):  # type: ignore[no-untyped-def]  # compiled; (h, w), (h, w) m, cells, m -> (n, 2) rows and columns
    """Returns the cell with the greatest clearance, `min_clearance` or more, of each free region of each block.

    Blocks have side x side cells; regions are 4-connected.
    """
    h, w = free.shape
    done = np.zeros((h, w), np.bool_)
    stack = np.empty((side * side, 2), np.int64)
    cells = np.empty((1024, 2), np.int64)
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
                    if best >= min_clearance:
                        if n == len(cells):
                            cells = np.concatenate((cells, np.empty_like(cells)))
                        cells[n, 0], cells[n, 1] = best_r, best_c
                        n += 1
    return cells[:n].copy()


@njit(cache=True, nogil=True)
def _tour(cells):  # type: ignore[no-untyped-def]  # compiled; (n, 2) -> (n,) int64, nearest-neighbour order
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
def _cast_beams(cells, row, column, angles, reach):  # type: ignore[no-untyped-def]  # compiled; (h, w) percent, (n,) rad -> (n, 2) int64, (n, 2) float64
    """Casts beams from the middle of a free cell up to `reach` cells (Amanatides and Woo 1987).

    Returns the row and column of the occupied cell that each hits, or -1; and its end, (x, y) in cells. The end is just
    inside the occupied cell, or the end of the free range. No beam passes between two cells that touch.
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
        # the end is not on the edge between two cells
        there = along + EDGE_CELLS if hits[k, 0] >= 0 else max(along - EDGE_CELLS, 0.5 * before)
        ends[k, 0], ends[k, 1] = x0 + there * dx, y0 + there * dy
    return hits, ends
