# SPDX-License-Identifier: Apache-2.0
"""Branch and bound: the best pose of a scan in a wide window, and its best rival, exact on a lattice of poses.

Source: Hess et al., "Real-time loop closure in 2D lidar SLAM", ICRA 2016, section V-B. The search is depth first, over
images of the map that hold the maximum over windows of doubling size. Olson, "M3RSM: many-to-many multi-resolution scan
matching", ICRA 2015, has the same bound. Sums are integers, so the result is the same on every machine.
"""

from dataclasses import dataclass
from math import ceil, cos, floor, pi, sin
from typing import ClassVar

import numpy as np
from numba import njit
from pydantic import Field

from services.mapper.front_end.voxel_filter import voxel_downsample
from shared.config import Section
from shared.geometry import Pose2, wrapped
from shared.types import Float64s, UInt8s

MAX_VALUE = 255  # of an image, at a point of the map
MAX_TURN_STEP_RAD = 0.1  # between headings, for scans of near points
GOLDEN_RATIO = 0.6180339887498949  # a stride of this fraction of a ring visits all of it evenly
N_SUBCELLS = 4  # in x and y of a cell; a point of the map is rounded to one
N_ROOTS = 32  # windows to a side that a search begins with, up to windows of ROOT_LEVEL
ROOT_LEVEL = 4  # windows of 0.8 m; wider ones bound little in a building, so more of these are faster
MAX_ROOTS = 128  # windows to a side, from which a search begins with wider ones all the same
BEAMS_PER_CHECK = 16  # beams that are summed between two checks of the bound


class BranchAndBoundConfig(Section):
    """The search of a wide window, for loop closures and for global localization."""

    RENAMED: ClassVar[dict[str, str]] = {
        "most_cells": "max_cells", "beams": "max_points", "finest_turn": "min_turn_step", "rival": "min_rival_ratio",
        "apart": "min_rival_distance", "apart_turn": "min_rival_turn", "budget": "max_windows",
    }  # fmt: skip

    resolution: float = Field(0.05, ge=0.01, le=0.5, description="m, side of a cell and step between poses")
    radius: float = Field(0.2, ge=0.02, le=2, description="m from the map's surface at which a beam scores 0")
    levels: int = Field(6, ge=1, le=10, description="images; the windows of the last are 2^(levels - 1) cells wide")
    max_cells: int = Field(8_000_000, ge=10_000, le=100_000_000, description="cells of an image; then cells get larger")
    max_points: int = Field(180, ge=10, le=256, description="points of a scan that are scored, at most")
    min_turn_step: float = Field(0.005, ge=0.001, le=0.1, description="rad between two headings, at least")
    min_rival_ratio: float = Field(0.8, ge=0, le=1, description="score of a rival, as a share of the best, at least")
    min_rival_distance: float = Field(0.5, ge=0, le=10, description="m between the best pose and a rival, at least")
    min_rival_turn: float = Field(0.26, ge=0, le=pi, description="or rad between the best pose and a rival, at least")
    max_windows: int = Field(1_000_000, ge=1000, le=10_000_000_000, description="windows that a search evaluates")


@dataclass(frozen=True, slots=True)
class Candidate:
    """A pose of the lattice.  score: mean over the beams, from 1 on a surface of the map to 0 at `radius`."""

    pose: Pose2
    score: float


@dataclass(frozen=True, slots=True)
class Pyramid:
    """Images of a map on the same cells: levels[k, r, c] is the maximum of 2^k x 2^k cells, beginning at (r, c).

    levels: (n, h, w) uint8, 255 on a surface. The outermost cells of each level are 0, as is all outside.
    x0, y0: m, the lower left corner of cell (0, 0).  resolution: m per cell.
    """

    levels: UInt8s
    x0: float
    y0: float
    resolution: float


def build_pyramid(points: Float64s, config: BranchAndBoundConfig) -> Pyramid:
    """Returns the pyramid of a map's surface points (m, 2) m, in their frame.

    The value at distance d of a point is 1 - (d / radius)^2. It is flat at the top, as the lattice is half a cell off
    in each axis and in heading, and cells are rounded: 5 cm in all. A right pose keeps 0.9 of its score; with a linear
    falloff it would keep 0.7.
    """
    low = points.min(axis=0) if len(points) else np.zeros(2)
    high = points.max(axis=0) if len(points) else np.zeros(2)
    border = 1 << (config.levels - 1)  # windows of the last level that begin before it are empty
    resolution, radius = config.resolution, config.radius
    while True:
        reach = ceil(radius / resolution) + 1
        first = np.floor(low / resolution).astype(np.int64) - reach - border
        width, height = (int(n) for n in np.floor(high / resolution).astype(np.int64) + reach + 2 - first)
        if width * height <= config.max_cells or resolution > np.max(high - low):
            break
        resolution *= 2
        radius = max(radius, 2 * resolution)  # narrower, a beam between two cells would miss the surface
    levels = np.zeros((config.levels, height, width), np.uint8)
    x0, y0 = (float(n) * resolution for n in first)
    _draw_points(points, levels[0], x0, y0, resolution, radius)
    for level in range(1, config.levels):
        _max_pool(levels[level - 1], levels[level], 1 << (level - 1))
    return Pyramid(levels, x0, y0, resolution)


def _max_pool(lower: UInt8s, upper: UInt8s, half: int) -> None:
    """Fills `upper` with the maxima over windows of 2 * half cells from those over windows of half cells in `lower`."""
    across = lower.copy()
    np.maximum(lower[:, :-half], lower[:, half:], out=across[:, :-half])
    upper[:] = across
    np.maximum(across[:-half], across[half:], out=upper[:-half])


def search(
    points: Float64s,
    pyramid: Pyramid,
    centre: Pose2,
    reach: float,
    turn: float,
    min_score: float,
    config: BranchAndBoundConfig,
    farther: tuple[float, ...] = (),
) -> tuple[list[Candidate], int]:
    """Returns the best pose of the window with a score of `min_score`, and its best rivals, where they exist.

    points: (n, 2) m in `base`.  centre: of the window, in the pyramid's frame.
    reach: half the window's width in x and y, m, rounded up to cells.  turn: the same in yaw, rad; pi is a circle.
    farther: further distances, m, that rise.
    A rival is the best pose at `min_rival_distance` m or `min_rival_turn` rad from the best one. For each of the
    `farther` distances there is one more, which may be the same. Of poses with equal scores the one nearest to the
    centre is chosen, in steps of the lattice. The second result is the number of windows evaluated. There is no pose
    where the best one and its first rival need more than `max_windows`, and no further rival that needs more.
    """
    points = voxel_downsample(points, config.max_points, pyramid.resolution)
    n = len(points)
    if n == 0:
        return [], 0
    turns, k, top = _lattice(points, pyramid, reach, turn, config)
    middle = len(turns) // 2
    min_sum = max(ceil(min_score * MAX_VALUE * n), 1)
    rows, columns = _cells(points, centre.x - pyramid.x0, centre.y - pyramid.y0, centre.yaw + turns, pyramid.resolution)
    levels = pyramid.levels[: top + 1]
    roots = _sorted_roots(_phases(levels[top], 1 << top), top, rows, columns, k, min_sum)

    candidates: list[Candidate] = []
    near = np.zeros(len(turns), np.bool_)
    best_i = best_j = n_windows = n_for_best = 0
    for distance in (0.0, config.min_rival_distance, *farther):
        total, h, i, j, n_looked = _depth_first(
            levels, rows, columns, k, middle, roots, min_sum, near, best_i, best_j,
            distance / pyramid.resolution, config.max_windows - n_for_best,
        )  # fmt: skip
        n_windows += n_looked
        if n_for_best + n_looked > config.max_windows:
            return candidates if len(candidates) > 1 else [], n_windows
        if total < 0:
            break
        pose = Pose2(
            centre.x + i * pyramid.resolution,
            centre.y + j * pyramid.resolution,
            wrapped(centre.yaw + float(turns[h])),
        )
        candidates.append(Candidate(pose, total / (MAX_VALUE * n)))
        if len(candidates) == 1:
            best_i, best_j, n_for_best = i, j, n_looked
            min_sum = max(min_sum, ceil(config.min_rival_ratio * total))
            near = np.array([abs(wrapped(t - turns[h])) <= config.min_rival_turn for t in turns])
    return candidates, n_windows


def search_cost(points: Float64s, pyramid: Pyramid, reach: float, turn: float, config: BranchAndBoundConfig) -> int:
    """Returns the number of cells that `search` reads for its first bounds. Arguments as for `search`."""
    points = voxel_downsample(points, config.max_points, pyramid.resolution)
    if not len(points):
        return 0
    turns, k, top = _lattice(points, pyramid, reach, turn, config)
    across = min(2 * k, max(pyramid.levels.shape[1:])) + (1 << top) >> top
    return int(len(turns) * len(points) * across**2)


def _lattice(
    points: Float64s, pyramid: Pyramid, reach: float, turn: float, config: BranchAndBoundConfig
) -> tuple[Float64s, int, int]:
    """Returns headings (n,) rad about the window's, cells to each side, and the level where the search begins.

    points: (n, 2) m, after the voxel filter.
    """
    k = ceil(reach / pyramid.resolution - 1e-9)
    far = float(np.percentile(np.hypot(points[:, 0], points[:, 1]), 90))
    turns = headings(far, turn, pyramid.resolution, config.min_turn_step)
    top = min(
        (2 * k // N_ROOTS).bit_length(), max(ROOT_LEVEL, (2 * k // MAX_ROOTS).bit_length()), len(pyramid.levels) - 1
    )
    return turns, k, top


def _phases(level: UInt8s, side: int) -> UInt8s:
    """Returns a level (h, w) as (side, side, h / side, w / side): every side-th cell adjacent in memory, 0 beyond.

    The values that one beam adds to the bounds of all roots of a heading are then in a few rows.
    """
    h, w = (-(-n // side) for n in level.shape)
    whole = np.zeros((h * side, w * side), np.uint8)
    whole[: level.shape[0], : level.shape[1]] = level
    return np.ascontiguousarray(whole.reshape(h, side, w, side).transpose(1, 3, 0, 2))


def headings(far: float, turn: float, resolution: float, finest: float) -> Float64s:
    """Returns headings (n,) rad about 0 at even steps: `resolution` m at `far` m, but `finest` rad at least.

    They range from -turn to turn; where less than a step of the circle is left, they cover the circle once.
    """
    step = min(max(resolution / max(far, resolution), finest), MAX_TURN_STEP_RAD)
    if turn + step / 2 >= pi:
        n = ceil(2 * pi / step)
        return np.arange(-(n // 2), n - n // 2, dtype=np.float64) * (2 * pi / n)
    k = ceil(turn / step)
    return np.arange(-k, k + 1, dtype=np.float64) * (turn / max(k, 1))


@njit(cache=True, nogil=True)
def _draw_points(points, picture, x0, y0, resolution, radius):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    reach = ceil(radius / resolution)
    side = 2 * reach + 1
    # values about a point's cell, by the subcell of the point
    stamps = np.zeros((N_SUBCELLS, N_SUBCELLS, side, side), np.uint8)
    for u in range(N_SUBCELLS):
        for v in range(N_SUBCELLS):
            for r in range(side):
                for c in range(side):
                    dx, dy = c - reach + 0.5 - (v + 0.5) / N_SUBCELLS, r - reach + 0.5 - (u + 0.5) / N_SUBCELLS
                    away = (dx * dx + dy * dy) * (resolution / radius) ** 2
                    stamps[u, v, r, c] = np.uint8(MAX_VALUE * max(1.0 - away, 0.0) + 0.5)
    left = np.zeros(
        (picture.shape[0], picture.shape[1]), np.uint16
    )  # a bit per subcell: most points repeat another one
    for k in range(len(points)):
        x, y = (points[k, 0] - x0) / resolution, (points[k, 1] - y0) / resolution
        column, row = floor(x), floor(y)
        u, v = int((y - row) * N_SUBCELLS), int((x - column) * N_SUBCELLS)
        bit = np.uint16(1 << (u * N_SUBCELLS + v))
        if left[row, column] & bit:
            continue
        left[row, column] |= bit
        for r in range(side):
            below = picture[row - reach + r, column - reach : column + reach + 1]
            stamp = stamps[u, v, r]
            for c in range(side):
                below[c] = max(below[c], stamp[c])


@njit(cache=True, nogil=True)
def _cells(points, x, y, yaws, resolution):  # type: ignore[no-untyped-def]  # compiled; -> rows, columns (n_headings, n) int32
    """Returns the cells of the points at each heading, at (x, y) m from the image's corner.

    Neighbours of a sweep are similar. Their order is mixed, so that a few points reject a bad pose.
    """
    n = len(points)
    stride = max(int(n * GOLDEN_RATIO), 1)
    while np.gcd(stride, n) != 1:
        stride += 1
    rows = np.empty((len(yaws), n), np.int32)
    columns = np.empty((len(yaws), n), np.int32)
    beyond = 1e8  # cells; all beyond is empty
    for h in range(len(yaws)):
        c, s = cos(yaws[h]), sin(yaws[h])
        for b in range(n):
            px, py = points[b * stride % n, 0], points[b * stride % n, 1]
            rows[h, b] = floor(min(max((y + s * px + c * py) / resolution, -beyond), beyond))
            columns[h, b] = floor(min(max((x + c * px - s * py) / resolution, -beyond), beyond))
    return rows, columns


@njit(cache=True, nogil=True)
def _score_sum(level, rows, columns, i, j, min_sum):  # type: ignore[no-untyped-def]  # compiled; -> the sum over beams, or -1 if under min_sum
    last_row, last_column = level.shape[0] - 1, level.shape[1] - 1
    n = len(rows)
    total = 0
    b = 0
    while b < n:
        end = min(b + BEAMS_PER_CHECK, n)
        for k in range(b, end):
            # the outermost cells are 0, as is all beyond
            r = np.uint64(min(max(rows[k] + j, 0), last_row))
            c = np.uint64(min(max(columns[k] + i, 0), last_column))
            total += level[r, c]
        b = end
        if total + MAX_VALUE * (n - b) < min_sum:
            return -1
    return total


@njit(cache=True, nogil=True)
def _sorted_roots(phases, top, rows, columns, k, min_sum):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    """Returns (n, 4) int32: bound, heading, i, j of the windows of level `top` bounded by `min_sum`, best first."""
    n_headings, n = rows.shape
    side = 1 << top
    m = (2 * k + side) >> top
    n_rows, n_columns = phases.shape[2], phases.shape[3]
    bounds = np.zeros((n_headings, m, m), np.uint16)
    starts = np.zeros(MAX_VALUE * n + 2, np.int64)
    for h in range(n_headings):
        sums = bounds[h]
        for b in range(n):
            r, c = rows[h, b] - k, columns[h, b] - k
            row, column = r >> top, c >> top  # of the first root, in the phase
            phase = phases[r & (side - 1), c & (side - 1)]
            low, high = max(-column, 0), min(n_columns - column, m)
            if low >= high:
                continue
            for a in range(max(-row, 0), min(n_rows - row, m)):
                above, cells = sums[a, low:high], phase[row + a, column + low : column + high]
                for i in range(high - low):
                    above[i] += cells[i]
        for a in range(m):
            for i in range(m):
                if sums[a, i] >= min_sum:
                    starts[MAX_VALUE * n - sums[a, i] + 1] += 1
    for place in range(1, len(starts)):
        starts[place] += starts[place - 1]
    roots = np.empty((starts[-1], 4), np.int32)
    for h in range(n_headings):
        for a in range(m):
            for i in range(m):
                if bounds[h, a, i] >= min_sum:
                    place = MAX_VALUE * n - bounds[h, a, i]
                    at = starts[place]
                    starts[place] += 1
                    roots[at, 0], roots[at, 1] = bounds[h, a, i], h
                    roots[at, 2], roots[at, 3] = i * side - k, a * side - k
    return roots


@njit(cache=True, nogil=True)
def _squared_steps(h, i, j, side):  # type: ignore[no-untyped-def]  # compiled; -> squared steps from the centre to a window's nearest cell
    di = max(max(i, -(i + side - 1)), 0)
    dj = max(max(j, -(j + side - 1)), 0)
    return h * h + di * di + dj * dj


@njit(cache=True, nogil=True)
def _depth_first(  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    levels, rows, columns, k, middle, roots, min_sum, near, near_i, near_j, apart, budget
):
    """Returns the sum, heading, i, j of the best pose, and the number of windows evaluated.

    Excluded are poses within `apart` cells of (near_i, near_j) at a heading that is near.  The sum is -1 where no pose
    reaches `min_sum`. The search ends soon after `budget` windows.
    """
    top = len(levels) - 1
    best, best_steps, best_h, best_i, best_j = min_sum, np.int64(2**62), -1, 0, 0
    stack = np.empty((4 * top + 1, 4), np.int64)  # bound, level, i, j
    looked = 0
    for m in range(len(roots)):
        if roots[m, 0] < best or looked > budget:
            break
        h = roots[m, 1]
        stack[0, 0], stack[0, 1], stack[0, 2], stack[0, 3] = roots[m, 0], top, roots[m, 2], roots[m, 3]
        n = 1
        while n > 0:
            n -= 1
            bound, level, i, j = stack[n, 0], stack[n, 1], stack[n, 2], stack[n, 3]
            side = 1 << level
            steps = _squared_steps(h - middle, i, j, side)
            if bound < best or (bound == best and steps > best_steps):
                continue
            if near[h]:
                di = max(abs(i - near_i), abs(min(i + side - 1, k) - near_i))
                dj = max(abs(j - near_j), abs(min(j + side - 1, k) - near_j))
                if di * di + dj * dj <= apart * apart:
                    continue
            if level == 0:
                if bound > best or steps < best_steps or (h, i, j) < (best_h, best_i, best_j):
                    best, best_steps, best_h, best_i, best_j = bound, steps, h, i, j
                continue
            half = side >> 1
            first = n
            for ci in (i, i + half):
                for cj in (j, j + half):
                    if ci > k or cj > k:
                        continue
                    looked += 1
                    bound = _score_sum(levels[level - 1], rows[h], columns[h], ci, cj, best)
                    if bound < 0:
                        continue
                    at = n
                    while at > first and stack[at - 1, 0] > bound:
                        stack[at] = stack[at - 1]
                        at -= 1
                    stack[at, 0], stack[at, 1], stack[at, 2], stack[at, 3] = bound, level - 1, ci, cj
                    n += 1
    if best_h < 0:
        return -1, 0, 0, 0, looked
    return best, best_h, best_i, best_j, looked
