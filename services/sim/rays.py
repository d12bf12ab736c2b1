# SPDX-License-Identifier: Apache-2.0
"""Ray casting in an indexed grid: exact against segments and circles, by cell against maps.

Each cell stores the distance to the nearest cell with content. So a ray crosses free space in a few jumps (proximity
clouds of Cohen and Sheffer, 1994, in the Chebyshev metric). It is intersected only with the shapes of its cells.
"""

from math import ceil, floor, inf, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from shared.types import Bools, Float64s, Int16s, Int32s

SOLID = -1  # Cells.skip: the whole cell is solid
MAX_CELLS = 16_000_000  # 80 MB of index; larger worlds get larger cells
MAX_SKIP = 32_000  # cells
EPSILON = 1e-9  # m: closes the gap between segments that meet in a corner


class Cells(NamedTuple):
    """Static shapes, sorted into square cells; world frame, m.

    - skip: (h, w) int16, row 0 at the lowest y. SOLID, or 0 in a cell with shapes; k > 0: no content within fewer than
      k cells (Chebyshev).
    - first, items: the shapes of cell c (row * w + column) are items[first[c]:first[c + 1]]. Item i is segment i, item
      ~i is circle i.
    - segments: (n, 4) x, y, x, y
    - circles: (m, 3) x, y, radius
    - x0, y0: lower left corner
    - size: side of a cell
    """

    skip: Int16s
    first: Int32s
    items: Int32s
    segments: Float64s
    circles: Float64s
    x0: float
    y0: float
    size: float


def index_shapes(segments: Float64s, circles: Float64s, size: float) -> Cells:
    """The index of a world of shapes, with cells of `size` m or larger; shapes as in `Cells`."""
    low_x, low_y, high_x, high_y = extent(segments, circles)
    size = max(size, sqrt((high_x - low_x + 2 * size) * (high_y - low_y + 2 * size) / MAX_CELLS))
    x0, y0 = low_x - size, low_y - size
    h, w = ceil((high_y - y0) / size) + 1, ceil((high_x - x0) / size) + 1
    return index_grid(segments, circles, np.zeros((h, w), bool), x0, y0, size)


def index_grid(segments: Float64s, circles: Float64s, solid: Bools, x0: float, y0: float, size: float) -> Cells:
    """The index over a given grid of cells, (h, w) bool, some of which are solid; shapes outside of it are lost."""
    h, w = solid.shape
    first, items = shapes_by_cell(segments, circles, x0, y0, size, h, w, 1e-6 * size)
    has_shapes = (np.diff(first) > 0).reshape(h, w)
    content = solid | has_shapes
    skip = _steps_to(content, min(max(h, w), MAX_SKIP))
    skip[solid] = SOLID
    return Cells(
        skip=skip,
        first=first,
        items=items,
        segments=segments,
        circles=circles,
        x0=float(x0),
        y0=float(y0),
        size=float(size),
    )


@njit(cache=True, nogil=True)
def _steps_to(content: Bools, farthest: int) -> Int16s:
    """(h, w) int16: cells to the nearest one with content, in the Chebyshev metric; `farthest` where none is nearer.

    Two passes over the eight neighbours: Rosenfeld and Pfaltz 1968, "Distance functions on digital pictures".
    scipy.ndimage has the same, and its import costs a simulator's start 0.1 s and 10 MB.
    """
    h, w = content.shape
    out = np.empty((h, w), np.int16)
    for row in range(h):
        for column in range(w):
            nearest = 0 if content[row, column] else farthest
            if row > 0:
                for near in range(max(column - 1, 0), min(column + 2, w)):
                    nearest = min(nearest, out[row - 1, near] + 1)
            if column > 0:
                nearest = min(nearest, out[row, column - 1] + 1)
            out[row, column] = nearest
    for row in range(h - 1, -1, -1):
        for column in range(w - 1, -1, -1):
            nearest = out[row, column]
            if row < h - 1:
                for near in range(max(column - 1, 0), min(column + 2, w)):
                    nearest = min(nearest, out[row + 1, near] + 1)
            if column < w - 1:
                nearest = min(nearest, out[row, column + 1] + 1)
            out[row, column] = nearest
    return out


def extent(segments: Float64s, circles: Float64s) -> tuple[float, float, float, float]:
    """The smallest box around all shapes: low x, low y, high x, high y; all 0 where there is no shape."""
    low = [segments.reshape(-1, 2), circles[:, :2] - circles[:, 2:]]
    high = [segments.reshape(-1, 2), circles[:, :2] + circles[:, 2:]]
    if not len(segments) + len(circles):
        return 0.0, 0.0, 0.0, 0.0
    (low_x, low_y), (high_x, high_y) = np.concatenate(low).min(axis=0), np.concatenate(high).max(axis=0)
    return float(low_x), float(low_y), float(high_x), float(high_y)


@njit(cache=True, nogil=True)
def shapes_by_cell(
    segments: Float64s, circles: Float64s, x0: float, y0: float, size: float, h: int, w: int, margin: float
) -> tuple[Int32s, Int32s]:
    """`first` and `items` of Cells: the shapes that touch each cell grown by `margin` m (shrunk where negative)."""
    count = np.zeros(h * w + 1, np.int32)
    items = np.zeros(0, np.int32)
    for fill in (False, True):
        if fill:
            count = np.cumsum(count).astype(np.int32)
            items = np.zeros(count[-1], np.int32)
            place = count[:-1].copy()
        for k in range(len(segments) + len(circles)):
            i = k if k < len(segments) else ~(k - len(segments))
            if i >= 0:
                ax, ay, bx, by = segments[i]
                low_x, high_x, low_y, high_y = min(ax, bx), max(ax, bx), min(ay, by), max(ay, by)
            else:
                x, y, r = circles[~i]
                low_x, high_x, low_y, high_y = x - r, x + r, y - r, y + r
            for row in range(max(0, floor((low_y - y0) / size) - 1), min(h, floor((high_y - y0) / size) + 2)):
                for column in range(max(0, floor((low_x - x0) / size) - 1), min(w, floor((high_x - x0) / size) + 2)):
                    left, low = x0 + column * size - margin, y0 + row * size - margin
                    right, high = left + size + 2 * margin, low + size + 2 * margin
                    if i >= 0:
                        touches = segment_in_box(ax, ay, bx, by, left, low, right, high)
                    else:
                        dx, dy = x - min(max(x, left), right), y - min(max(y, low), high)
                        touches = dx * dx + dy * dy <= r * r
                    if touches and fill:
                        items[place[row * w + column]] = i
                        place[row * w + column] += 1
                    elif touches:
                        count[row * w + column + 1] += 1
    return count, items


@njit(cache=True, nogil=True)
def segment_in_box(
    ax: float, ay: float, bx: float, by: float, left: float, low: float, right: float, high: float
) -> bool:
    """Whether a segment touches a box (Liang & Barsky 1984)."""
    enter, leave = 0.0, 1.0
    for a, d, near, far in ((ax, bx - ax, left, right), (ay, by - ay, low, high)):
        if d == 0.0:
            if a < near or a > far:
                return False
            continue
        u, v = (near - a) / d, (far - a) / d
        enter, leave = max(enter, min(u, v)), min(leave, max(u, v))
    return enter <= leave


@njit(cache=True, nogil=True)
def ray_to_segment(ox: float, oy: float, c: float, s: float, ax: float, ay: float, bx: float, by: float) -> float:
    """Metres along the ray from (ox, oy) in direction (c, s) to a segment; inf where it misses."""
    ex, ey = bx - ax, by - ay
    across = c * ey - s * ex
    if across == 0.0:
        return inf
    dx, dy = ax - ox, ay - oy
    t = (dx * ey - dy * ex) / across
    u = (dx * s - dy * c) / across
    slack = EPSILON / sqrt(ex * ex + ey * ey)
    return t if t >= 0.0 and -slack <= u <= 1.0 + slack else inf


@njit(cache=True, nogil=True)
def ray_to_circle(ox: float, oy: float, c: float, s: float, x: float, y: float, r: float) -> float:
    """Metres along the ray to a disc; 0 from inside, inf where it misses."""
    dx, dy = x - ox, y - oy
    along = dx * c + dy * s
    beyond = dx * dx + dy * dy - r * r
    if beyond <= 0.0:
        return 0.0
    inside = along * along - beyond
    return along - sqrt(inside) if along > 0.0 and inside >= 0.0 else inf


@njit(cache=True, nogil=True)
def _nearest_in(cells: Cells, cell: int, ox: float, oy: float, c: float, s: float) -> float:
    """Metres along the ray to the nearest shape listed in one cell."""
    nearest = inf
    for k in range(cells.first[cell], cells.first[cell + 1]):
        i = cells.items[k]
        if i >= 0:
            ax, ay, bx, by = cells.segments[i]
            t = ray_to_segment(ox, oy, c, s, ax, ay, bx, by)
        else:
            x, y, r = cells.circles[~i]
            t = ray_to_circle(ox, oy, c, s, x, y, r)
        nearest = min(nearest, t)
    return nearest


@njit(cache=True, nogil=True)
def cast_ray(cells: Cells, ox: float, oy: float, c: float, s: float, limit: float) -> float:
    """Metres along the ray from (ox, oy) in direction (c, s) (a unit vector) to what stands still; inf past `limit`."""
    h, w = cells.skip.shape
    size = cells.size
    px, py = (ox - cells.x0) / size, (oy - cells.y0) / size
    inv_c = 1.0 / c if abs(c) > 1e-12 else 1e12
    inv_s = 1.0 / s if abs(s) > 1e-12 else 1e12
    t = 0.0  # in cells, as px and py
    if px < 0.0 or px > w or py < 0.0 or py > h:
        enter_x, leave_x = min(-px * inv_c, (w - px) * inv_c), max(-px * inv_c, (w - px) * inv_c)
        enter_y, leave_y = min(-py * inv_s, (h - py) * inv_s), max(-py * inv_s, (h - py) * inv_s)
        t = max(enter_x, enter_y, 0.0)
        if t >= min(leave_x, leave_y):
            return inf
    column = min(max(floor(px + t * c), 0), w - 1)
    row = min(max(floor(py + t * s), 0), h - 1)
    nearest = inf
    while True:
        skip = cells.skip[row, column]
        if skip == SOLID:
            return min(nearest, t * size)
        if skip == 0:
            nearest = min(nearest, _nearest_in(cells, row * w + column, ox, oy, c, s))
        around = max(skip - 1, 0)  # the block of cells column +- around, row +- around is free
        t_x = ((column + around + 1 if c > 0.0 else column - around) - px) * inv_c if abs(c) > 1e-12 else inf
        t_y = ((row + around + 1 if s > 0.0 else row - around) - py) * inv_s if abs(s) > 1e-12 else inf
        t = max(t, min(t_x, t_y))
        if nearest <= t * size:
            return nearest
        if t * size > limit:
            return inf
        if t_x < t_y:
            column += around + 1 if c > 0.0 else -around - 1
            row = min(max(floor(py + t * s), row - around), row + around)
        else:
            row += around + 1 if s > 0.0 else -around - 1
            column = min(max(floor(px + t * c), column - around), column + around)
        if column < 0 or column >= w or row < 0 or row >= h:
            return nearest
