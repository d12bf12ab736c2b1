# SPDX-License-Identifier: Apache-2.0
"""Simple polygons and arrays of points: point in polygon, distance to the outline.

A polygon is (k, 2) float64, m, its corners in order; it closes by itself. Points are (n, 2) float64, m, in its frame.
Compiled loops test single points with shared/polygon_kernels.py, by the same arithmetic. This module does without
numba, because every process reads a footprint and only some run kernels.

The even-odd test is W. R. Franklin's PNPOLY, the nearest point of an edge that of Ericson, "Real-Time Collision
Detection", 2005, section 5.1.2.
"""

import numpy as np

from shared.types import Bools, Float64s, Int64s


def signed_area(polygon: Float64s) -> float:
    """m^2: the enclosed area, positive when the corners run counter-clockwise (shoelace formula)."""
    x, y = polygon.T
    return 0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def contains(polygon: Float64s, points: Float64s) -> Bools:
    """(n,) bool: which points lie in the polygon, by the even-odd rule. On the outline either answer may come."""
    x, y = points[:, 0][:, None], points[:, 1][:, None]
    x0, y0 = polygon[:, 0], polygon[:, 1]
    x1, y1 = np.roll(x0, -1), np.roll(y0, -1)
    crosses = (y0 > y) != (y1 > y)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # of edges that do not cross
        left_of = x < x0 + (y - y0) * (x1 - x0) / (y1 - y0)
    return np.asarray((crosses & left_of).sum(axis=1) % 2 == 1)


def offsets_from_outline(polygon: Float64s, points: Float64s) -> tuple[Float64s, Int64s]:
    """Vectors (n, 2), m, from the nearest point of the outline to each point, and the index (n,) of its edge.

    Edge i begins at corner i. Of equally near edges the first counts.
    """
    edges = np.roll(polygon, -1, axis=0) - polygon
    away = points[:, None, :] - polygon
    squares = (edges * edges).sum(axis=1)
    with np.errstate(over="ignore"):  # of an edge that is hardly longer than 0
        along = np.clip((away * edges).sum(axis=2) / np.where(squares > 0.0, squares, 1.0), 0.0, 1.0)
    away = away - along[:, :, None] * edges
    nearest = (away * away).sum(axis=2).argmin(axis=1)
    return away[np.arange(len(points)), nearest], nearest


def distances_to_outline(polygon: Float64s, points: Float64s) -> Float64s:
    """(n,) m from each point, inside or outside, to the nearest edge."""
    offsets, _ = offsets_from_outline(polygon, points)
    return np.hypot(offsets[:, 0], offsets[:, 1])


def signed_distances(polygon: Float64s, points: Float64s) -> Float64s:
    """(n,) m from each point to the nearest edge, negative inside."""
    return np.where(contains(polygon, points), -1.0, 1.0) * distances_to_outline(polygon, points)
