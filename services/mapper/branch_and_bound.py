# SPDX-License-Identifier: Apache-2.0
"""Where in a wide window a scan fits a map best, and where it fits next best: exact on a lattice of poses.

Hess et al., "Real-time loop closure in 2D lidar SLAM", ICRA 2016, section V-B: branch and bound, depth first, over
pictures of the map that hold the maximum of ever larger windows. Olson, "M3RSM: many-to-many multi-resolution scan
matching", ICRA 2015, has the same bound. Sums are of integers: what is found is the same on every machine.
"""

from dataclasses import dataclass
from math import ceil, cos, floor, pi, sin

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from services.mapper.voxel_filter import thinned
from shared.config import Section
from shared.geometry import Pose2, wrapped

Float64s = NDArray[np.float64]
Int32s = NDArray[np.int32]
UInt8s = NDArray[np.uint8]
Bools = NDArray[np.bool_]

FULL = 255  # a picture's value at a point of the map
COARSEST_TURN = 0.1  # rad between headings at most, for scans of near points
GOLDEN = 0.6180339887498949  # a stride of this share of a ring visits all of it evenly
PARTS = 4  # of a cell in x and y that a point of the map is rounded to
ROOTS = 32  # windows a side that a search begins with at most, where they are no wider than those of WIDE
WIDE = 4  # level of windows (0.8 m) beyond which they bound so little in a building that more of these are faster
MOST_ROOTS = 128  # windows a side from which a search begins with still wider ones
BLOCK = 16  # beams summed between two looks at whether the rest can still help


class BranchAndBoundConfig(Section):
    """The search of a wide window, for loop closures and for a place in a saved map."""

    resolution: float = Field(0.05, ge=0.01, le=0.5, description="m, side of a cell and step between poses")
    radius: float = Field(0.2, ge=0.02, le=2, description="m from the map's surface at which a beam scores nothing")
    levels: int = Field(6, ge=1, le=10, description="pictures; the last one's windows are 2^(levels - 1) cells wide")
    most_cells: int = Field(
        8_000_000, ge=10_000, le=100_000_000, description="cells of a picture; a wider map has larger cells"
    )
    beams: int = Field(180, ge=10, le=256, description="points of a scan that are looked at, at most")
    finest_turn: float = Field(0.005, ge=0.001, le=0.1, description="rad between headings at least")
    rival: float = Field(0.8, ge=0, le=1, description="share of the best score from which another pose is a rival")
    apart: float = Field(0.5, ge=0, le=10, description="m from the best pose beyond which another is a rival")
    apart_turn: float = Field(0.26, ge=0, le=pi, description="rad from the best pose beyond which another is a rival")
    budget: int = Field(
        1_000_000, ge=1000, le=10_000_000_000, description="windows that a search may look at; then it found nothing"
    )


@dataclass(frozen=True, slots=True)
class Candidate:
    """A pose of the lattice. score: mean over the beams of 1 on a surface of the map .. 0 at `radius`."""

    pose: Pose2
    score: float


@dataclass(frozen=True, slots=True)
class Pyramid:
    """Pictures of a map on the same cells: levels[k, r, c] is the largest value of the 2^k x 2^k cells from (r, c) on.

    levels: (n, h, w) uint8, 255 on a surface; the outermost cells are 0 on every level, and so is all beyond.
    x0, y0: m, the lower left corner of cell (0, 0).  resolution: m a cell.
    """

    levels: UInt8s
    x0: float
    y0: float
    resolution: float


def drawn(points: Float64s, config: BranchAndBoundConfig) -> Pyramid:
    """The pyramid of a map's surface points (m, 2) m, in their frame. A point's value falls as 1 - (d / radius)^2.

    Flat at the top: the lattice is half a cell off in each axis and in heading, and the cells of beams and points are
    rounded, 5 cm in all. A right pose keeps 0.9 of its score by that, and would keep 0.7 of a cone.
    """
    low = points.min(axis=0) if len(points) else np.zeros(2)
    high = points.max(axis=0) if len(points) else np.zeros(2)
    border = 1 << (config.levels - 1)  # windows of the last level that begin before it hold nothing
    resolution, radius = config.resolution, config.radius
    while True:
        reach = ceil(radius / resolution) + 1
        first = np.floor(low / resolution).astype(np.int64) - reach - border
        width, height = (int(n) for n in np.floor(high / resolution).astype(np.int64) + reach + 2 - first)
        if width * height <= config.most_cells or resolution > np.max(high - low):
            break
        resolution *= 2
        radius = max(radius, 2 * resolution)  # narrower, a beam between two cells would miss the surface
    levels = np.zeros((config.levels, height, width), np.uint8)
    x0, y0 = (float(n) * resolution for n in first)
    _draw(points, levels[0], x0, y0, resolution, radius)
    for level in range(1, config.levels):
        _pool(levels[level - 1], levels[level], 1 << (level - 1))
    return Pyramid(levels, x0, y0, resolution)


def _pool(lower: UInt8s, upper: UInt8s, half: int) -> None:
    """Fills upper with the maxima of windows of twice `half` cells from lower's, of windows of `half`."""
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
    least: float,
    config: BranchAndBoundConfig,
) -> list[Candidate]:
    """The best pose of the window whose score is at least `least`, and its best rival, if there is one; [] if neither.

    points: (n, 2) m in `base`.  centre: the window's, in the pyramid's frame; it reaches `reach` m to each side in x
    and y, rounded up to cells, and `turn` rad; pi is all the way round.  The rival is the best pose `apart` m or
    `apart_turn` rad away from the best. Of poses with equal scores the one nearest to the centre counts, in steps of
    the lattice.
    """
    return search_counted(points, pyramid, centre, reach, turn, least, config)[0]


def search_counted(
    points: Float64s,
    pyramid: Pyramid,
    centre: Pose2,
    reach: float,
    turn: float,
    least: float,
    config: BranchAndBoundConfig,
) -> tuple[list[Candidate], int]:
    """What `search` finds, and the number of windows that it looked at. Nothing where they are more than the budget."""
    points = thinned(points, config.beams, pyramid.resolution)
    n = len(points)
    if n == 0:
        return [], 0
    turns, k, top = _lattice(points, pyramid, reach, turn, config)
    middle = len(turns) // 2
    least_sum = max(ceil(least * FULL * n), 1)
    rows, columns = _cells(points, centre.x - pyramid.x0, centre.y - pyramid.y0, centre.yaw + turns, pyramid.resolution)
    levels = pyramid.levels[: top + 1]
    roots = _roots(_phases(levels[top], 1 << top), top, rows, columns, k, least_sum)

    found: list[Candidate] = []
    near = np.zeros(len(turns), np.bool_)
    best_i = best_j = n_windows = 0
    for _ in range(2):
        total, h, best_i, best_j, n_looked = _best(
            levels, rows, columns, k, middle, roots, least_sum, near, best_i, best_j, config.apart / pyramid.resolution,
            config.budget - n_windows,
        )  # fmt: skip
        n_windows += n_looked
        if n_windows > config.budget:
            return [], n_windows
        if total < 0:
            break
        pose = Pose2(
            centre.x + best_i * pyramid.resolution,
            centre.y + best_j * pyramid.resolution,
            wrapped(centre.yaw + float(turns[h])),
        )
        found.append(Candidate(pose, total / (FULL * n)))
        least_sum = max(least_sum, ceil(config.rival * total))
        near = np.array([abs(wrapped(t - turns[h])) <= config.apart_turn for t in turns])
    return found, n_windows


def search_cost(points: Float64s, pyramid: Pyramid, reach: float, turn: float, config: BranchAndBoundConfig) -> int:
    """Cells that `search` looks up at least, for its first bounds: about 1e9 a second. Arguments as there."""
    points = thinned(points, config.beams, pyramid.resolution)
    if not len(points):
        return 0
    turns, k, top = _lattice(points, pyramid, reach, turn, config)
    across = min(2 * k, max(pyramid.levels.shape[1:])) + (1 << top) >> top
    return int(len(turns) * len(points) * across**2)


def _lattice(
    points: Float64s, pyramid: Pyramid, reach: float, turn: float, config: BranchAndBoundConfig
) -> tuple[Float64s, int, int]:
    """Headings (n,) rad about the window's, cells to each side, and the level of the windows that a search begins with.

    points: (n, 2) m, thinned.
    """
    k = ceil(reach / pyramid.resolution - 1e-9)
    far = float(np.percentile(np.hypot(points[:, 0], points[:, 1]), 90))
    turns = headings(far, turn, pyramid.resolution, config.finest_turn)
    top = min((2 * k // ROOTS).bit_length(), max(WIDE, (2 * k // MOST_ROOTS).bit_length()), len(pyramid.levels) - 1)
    return turns, k, top


def _phases(level: UInt8s, side: int) -> UInt8s:
    """(side, side, h / side, w / side) of a level (h, w): every side-th cell beside each other, 0 beyond.

    What one beam adds to the bounds of all roots of a heading then lies in a few rows.
    """
    h, w = (-(-n // side) for n in level.shape)
    whole = np.zeros((h * side, w * side), np.uint8)
    whole[: level.shape[0], : level.shape[1]] = level
    return np.ascontiguousarray(whole.reshape(h, side, w, side).transpose(1, 3, 0, 2))


def headings(far: float, turn: float, resolution: float, finest: float) -> Float64s:
    """(n,) rad about 0, even, none twice: at most `resolution` m apart at `far` m, if `finest` rad allows it.

    From -turn to turn; where that leaves less than a step of the circle it is the whole, without its end.
    """
    step = min(max(resolution / max(far, resolution), finest), COARSEST_TURN)
    if turn + step / 2 >= pi:
        n = ceil(2 * pi / step)
        return np.arange(-(n // 2), n - n // 2, dtype=np.float64) * (2 * pi / n)
    k = ceil(turn / step)
    return np.arange(-k, k + 1, dtype=np.float64) * (turn / max(k, 1))


@njit(cache=True, nogil=True)
def _draw(points, picture, x0, y0, resolution, radius):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    reach = ceil(radius / resolution)
    side = 2 * reach + 1
    # what a point leaves about its cell, by the part of the cell that it lies in
    stamps = np.zeros((PARTS, PARTS, side, side), np.uint8)
    for u in range(PARTS):
        for v in range(PARTS):
            for r in range(side):
                for c in range(side):
                    dx, dy = c - reach + 0.5 - (v + 0.5) / PARTS, r - reach + 0.5 - (u + 0.5) / PARTS
                    away = (dx * dx + dy * dy) * (resolution / radius) ** 2
                    stamps[u, v, r, c] = np.uint8(FULL * max(1.0 - away, 0.0) + 0.5)
    left = np.zeros((picture.shape[0], picture.shape[1]), np.uint16)  # a bit a part: most points repeat another
    for k in range(len(points)):
        x, y = (points[k, 0] - x0) / resolution, (points[k, 1] - y0) / resolution
        column, row = floor(x), floor(y)
        u, v = int((y - row) * PARTS), int((x - column) * PARTS)
        bit = np.uint16(1 << (u * PARTS + v))
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
    """The cells of the points at each heading, at (x, y) m from the picture's corner.

    Neighbours of a sweep tell the same: their order is mixed, so that a bad pose shows after a few.
    """
    n = len(points)
    stride = max(int(n * GOLDEN), 1)
    while np.gcd(stride, n) != 1:
        stride += 1
    rows = np.empty((len(yaws), n), np.int32)
    columns = np.empty((len(yaws), n), np.int32)
    beyond = 1e8  # cells; a place that far out is as empty as any
    for h in range(len(yaws)):
        c, s = cos(yaws[h]), sin(yaws[h])
        for b in range(n):
            px, py = points[b * stride % n, 0], points[b * stride % n, 1]
            rows[h, b] = floor(min(max((y + s * px + c * py) / resolution, -beyond), beyond))
            columns[h, b] = floor(min(max((x + c * px - s * py) / resolution, -beyond), beyond))
    return rows, columns


@njit(cache=True, nogil=True)
def _sum(level, rows, columns, i, j, least):  # type: ignore[no-untyped-def]  # compiled; -> the sum over beams, or -1 if under least
    last_row, last_column = level.shape[0] - 1, level.shape[1] - 1
    n = len(rows)
    total = 0
    b = 0
    while b < n:
        end = min(b + BLOCK, n)
        for k in range(b, end):
            # the outermost cells are 0: they stand for all that lies beyond
            r = np.uint64(min(max(rows[k] + j, 0), last_row))
            c = np.uint64(min(max(columns[k] + i, 0), last_column))
            total += level[r, c]
        b = end
        if total + FULL * (n - b) < least:
            return -1
    return total


@njit(cache=True, nogil=True)
def _roots(phases, top, rows, columns, k, least):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    """(n, 4) int32: bound, heading, i, j of the windows of the level `top` that may hold `least`, best first."""
    n_headings, n = rows.shape
    side = 1 << top
    m = (2 * k + side) >> top
    n_rows, n_columns = phases.shape[2], phases.shape[3]
    bounds = np.zeros((n_headings, m, m), np.uint16)
    starts = np.zeros(FULL * n + 2, np.int64)
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
                if sums[a, i] >= least:
                    starts[FULL * n - sums[a, i] + 1] += 1
    for place in range(1, len(starts)):
        starts[place] += starts[place - 1]
    roots = np.empty((starts[-1], 4), np.int32)
    for h in range(n_headings):
        for a in range(m):
            for i in range(m):
                if bounds[h, a, i] >= least:
                    place = FULL * n - bounds[h, a, i]
                    at = starts[place]
                    starts[place] += 1
                    roots[at, 0], roots[at, 1] = bounds[h, a, i], h
                    roots[at, 2], roots[at, 3] = i * side - k, a * side - k
    return roots


@njit(cache=True, nogil=True)
def _steps(h, i, j, side):  # type: ignore[no-untyped-def]  # compiled; -> squared steps from the centre to a window's nearest cell
    di = max(max(i, -(i + side - 1)), 0)
    dj = max(max(j, -(j + side - 1)), 0)
    return h * h + di * di + dj * dj


@njit(cache=True, nogil=True)
def _best(  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    levels, rows, columns, k, middle, roots, least, near, near_i, near_j, apart, budget
):
    """Sum, heading, i, j of the best pose that is not within `apart` cells of (near_i, near_j) at a heading that is
    near; the sum is -1 where none has `least`. And the number of windows looked at; it ends soon over the budget."""
    top = len(levels) - 1
    best, best_steps, best_h, best_i, best_j = least, np.int64(2**62), -1, 0, 0
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
            steps = _steps(h - middle, i, j, side)
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
                    bound = _sum(levels[level - 1], rows[h], columns[h], ci, cj, best)
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
