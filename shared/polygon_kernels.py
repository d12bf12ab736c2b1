# SPDX-License-Identifier: Apache-2.0
"""shared/polygon.py for one point, as numba kernels for compiled loops. Both give the same bits.

The sources are those of that file.
"""

from math import hypot, inf

from numba import njit

from shared.types import Float64s


@njit(cache=True, nogil=True)
def contains_point(polygon: Float64s, x: float, y: float) -> bool:
    """Whether the point (x, y), m, lies in the polygon (k, 2) m, by the even-odd rule."""
    odd = False
    n = len(polygon)
    for i in range(n):
        x0, y0 = polygon[i, 0], polygon[i, 1]
        x1, y1 = polygon[(i + 1) % n, 0], polygon[(i + 1) % n, 1]
        if (y0 > y) != (y1 > y) and x < x0 + (y - y0) * (x1 - x0) / (y1 - y0):
            odd = not odd
    return odd


@njit(cache=True, nogil=True)
def offset_from_segment(x: float, y: float, x0: float, y0: float, x1: float, y1: float) -> tuple[float, float]:
    """Vector, m, from the nearest point of the segment (x0, y0) to (x1, y1) to the point (x, y)."""
    ex, ey, px, py = x1 - x0, y1 - y0, x - x0, y - y0
    square = ex * ex + ey * ey
    along = min(max((px * ex + py * ey) / square, 0.0), 1.0) if square > 0.0 else 0.0
    return px - along * ex, py - along * ey


@njit(cache=True, nogil=True)
def distance_to_segment(x: float, y: float, x0: float, y0: float, x1: float, y1: float) -> float:
    """m from the point (x, y) to the segment (x0, y0) to (x1, y1)."""
    dx, dy = offset_from_segment(x, y, x0, y0, x1, y1)
    return hypot(dx, dy)


@njit(cache=True, nogil=True)
def distance_to_polygon(polygon: Float64s, x: float, y: float) -> float:
    """m from the point (x, y) to the polygon (k, 2) m; 0 inside."""
    if contains_point(polygon, x, y):
        return 0.0
    nearest_x, nearest_y, min_squared = inf, inf, inf
    n = len(polygon)
    for i in range(n):
        j = (i + 1) % n
        dx, dy = offset_from_segment(x, y, polygon[i, 0], polygon[i, 1], polygon[j, 0], polygon[j, 1])
        if dx * dx + dy * dy < min_squared:
            min_squared, nearest_x, nearest_y = dx * dx + dy * dy, dx, dy
    return hypot(nearest_x, nearest_y)
