# SPDX-License-Identifier: Apache-2.0
"""Collision test of the footprint: circles over a distance field, and the polygon where the circles may touch.

Circles that cover the outline: Ziegler and Stiller, "Fast collision checking for intelligent vehicle motion planning",
IEEE IV 2010. The cover of any polygon by tiles, and the test of the polygon after it, are our own.
"""

from math import ceil, hypot, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from shared.config import Robot
from shared.polygon import contains, signed_distances
from shared.polygon_kernels import distance_to_polygon
from shared.types import Bools, Float32s, Float64s

Circle = tuple[float, float, float]  # x, y, radius m


class Footprint(NamedTuple):
    """The outline in `base`. circles: (k, 3) x, y, radius m, cover the polygon; the first is about the origin."""

    corners: Float64s  # (n, 2) m, counter-clockwise
    circles: Float64s
    inscribed: float  # m, radius about the origin
    circumscribed: float  # m
    padding: float  # m around the polygon that count as part of the robot


def footprint_of(robot: Robot, padding: float, overreach: float = 0.04) -> Footprint:
    """The robot's outline, with circles that cover it and reach beyond its bounding box by at most `overreach` m.

    padding: m around the polygon that count as part of the robot.

    A nearly round outline gets one circle. Otherwise each touched tile of the bounding box gets one. Tiles inside the
    inscribed circle, or inside the circle of another tile, get none.
    """
    corners = robot.corners
    inscribed, circumscribed = robot.inscribed_radius, robot.circumscribed_radius
    circles = [(0.0, 0.0, circumscribed)]
    if circumscribed - inscribed > overreach:
        circles = _merged_circles(corners, inscribed, _tile_circles(corners, overreach))
    return Footprint(corners, np.array(circles, float), inscribed, circumscribed, padding)


def _tile_circles(corners: Float64s, overreach: float) -> list[Circle]:
    low, high = corners.min(axis=0), corners.max(axis=0)
    # the circle around a square of side a reaches a (sqrt 2 - 1) / 2 beyond it; around other tiles it reaches further
    side = 2 * overreach / (sqrt(2) - 1)
    while True:
        nx, ny = (max(1, ceil(float(extent) / side)) for extent in high - low)
        width, height = (high - low) / (nx, ny)
        if hypot(width, height) - min(width, height) <= 2 * overreach:
            break
        side *= 0.9
    fine = np.stack(np.meshgrid((np.arange(9) - 4) / 8, (np.arange(9) - 4) / 8), axis=-1).reshape(-1, 2)
    edges = np.concatenate([a + np.linspace(0, 1, 200)[:, None] * (b - a) for a, b in _sides(corners)])
    found = []
    for i in range(nx):
        for j in range(ny):
            centre = low + (np.array((i, j)) + 0.5) * (width, height)
            touched = contains(corners, centre + fine * (width, height)).any()
            crossed = (np.abs(edges - centre) <= np.array((width, height)) / 2 + 1e-9).all(axis=1).any()
            if touched or crossed:
                found.append((float(centre[0]), float(centre[1]), hypot(width, height) / 2))
    return found


def _merged_circles(corners: Float64s, inscribed: float, tiles: list[Circle]) -> list[Circle]:
    """Fewer circles with the same cover, the one about the origin first: large ones inside, the tiles' at the rim."""
    large, rim = [(0.0, 0.0, inscribed)], []
    depths = np.maximum(-signed_distances(corners, np.array([(x, y) for x, y, _ in tiles])), 0.0).tolist()
    for depth, (x, y, radius) in sorted(zip(depths, tiles, strict=True), reverse=True):
        if any(hypot(x - a, y - b) + radius <= covered for a, b, covered in large):
            continue
        if depth > radius:
            large.append((x, y, depth))
        else:
            rim.append((x, y, radius))
    return large + rim


def _sides(corners: Float64s) -> list[tuple[Float64s, Float64s]]:
    return list(zip(corners, np.roll(corners, -1, axis=0), strict=True))


@njit(cache=True, nogil=True, inline="always")
def bilinear(field: Float32s, x: float, y: float) -> float:
    """The field at (x, y) in cells from the centre of its lower left one, bilinear; beyond its rim, the value at the
    rim.
    """
    h, w = field.shape
    x, y = min(max(x, 0.0), w - 1.001), min(max(y, 0.0), h - 1.001)
    column, row = int(x), int(y)
    u, t = x - column, y - row
    low = field[row, column] * (1.0 - u) + field[row, column + 1] * u
    high = field[row + 1, column] * (1.0 - u) + field[row + 1, column + 1] * u
    value: float = low * (1.0 - t) + high * t
    return value


@njit(cache=True, nogil=True, inline="always")
def clearance(field: Float32s, resolution: float, x: float, y: float, c: float, s: float, shape: Footprint) -> float:
    """Lower bound of the distance (m) from the footprint to the nearest occupied cell's centre; negative at an
    overlap.

    field: (h, w) float32 m to the nearest occupied cell. resolution: m a cell. x, y: m from the centre of its lower
    left cell. c, s: cosine and sine of the heading.

    Interpolation overstates a distance by up to resolution^2 / (8 radius) at a circle's rim, which is subtracted.
    """
    return circles_clearance(field, resolution, x, y, c, s, shape.circles, shape.circumscribed)


@njit(cache=True, nogil=True, inline="always")
def circles_clearance(
    field: Float32s,
    resolution: float,
    x: float,
    y: float,
    c: float,
    s: float,
    circles: Float64s,
    circumscribed: float,
) -> float:
    """`clearance` for loops: a footprint's arrays, taken out of it once, cost no reference count in each call."""
    scale = 1.0 / resolution
    centre = bilinear(field, x * scale, y * scale)
    if centre > circumscribed + SHAPE_DISTANCE_M or len(circles) == 1:
        least = centre - circumscribed - _interpolation_error(resolution, circumscribed)
    else:
        least = centre - circles[0, 2] - _interpolation_error(resolution, circles[0, 2])
        for i in range(1, len(circles)):
            a, b, radius = circles[i, 0], circles[i, 1], circles[i, 2]
            away = bilinear(field, (x + c * a - s * b) * scale, (y + s * a + c * b) * scale)
            least = min(least, away - radius - _interpolation_error(resolution, radius))
    return least


@njit(cache=True, nogil=True, inline="always")
def _interpolation_error(resolution: float, radius: float) -> float:
    return resolution * resolution / (8.0 * max(radius - resolution, 0.25 * resolution))


@njit(cache=True, nogil=True)
def touches(occupied: Bools, resolution: float, x: float, y: float, c: float, s: float, shape: Footprint) -> bool:
    """Whether an occupied cell's centre lies in the padded polygon at (x, y), m from the lower left cell's centre.

    occupied: (h, w) bool. resolution: m a cell. c, s: cosine and sine of the heading.
    """
    h, w = occupied.shape
    reach = shape.circumscribed + shape.padding
    first_row, last_row = max(0, ceil((y - reach) / resolution)), min(h - 1, int((y + reach) / resolution))
    first_column, last_column = max(0, ceil((x - reach) / resolution)), min(w - 1, int((x + reach) / resolution))
    for row in range(first_row, last_row + 1):
        for column in range(first_column, last_column + 1):
            if occupied[row, column]:
                dx, dy = column * resolution - x, row * resolution - y
                if distance_to_polygon(shape.corners, c * dx + s * dy, c * dy - s * dx) <= shape.padding:
                    return True
    return False


@njit(cache=True, nogil=True)
def collides(
    field: Float32s, occupied: Bools, resolution: float, x: float, y: float, c: float, s: float, shape: Footprint
) -> bool:
    """Whether the padded footprint holds an occupied cell's centre. The polygon is tested where circles may touch.

    occupied: (h, w) bool. The other arguments are those of `clearance`.
    """
    if clearance(field, resolution, x, y, c, s, shape) > shape.padding:
        return False
    return touches(occupied, resolution, x, y, c, s, shape)


SHAPE_DISTANCE_M = 0.5  # beyond the circumscribed circle, from which the outline's shape does not matter
