# SPDX-License-Identifier: Apache-2.0
"""Collision checks of the robot's true footprint, a simple polygon, with shapes, solid cells and people."""

from math import cos, floor, hypot, sin

import numpy as np
from numba import njit

from services.sim.rays import SOLID, Cells, segment_in_box
from shared.polygon_kernels import contains_point, distance_to_polygon, distance_to_segment
from shared.types import Float64s


def offset_polygon(corners: Float64s, margin: float) -> Float64s:
    """The polygon (k, 2), counter-clockwise, with every edge moved outwards by `margin` m; corners stay sharp."""
    edge = np.roll(corners, -1, axis=0) - corners
    edge /= np.hypot(edge[:, 0], edge[:, 1])[:, None]
    normal = np.column_stack((edge[:, 1], -edge[:, 0]))
    before = np.roll(normal, 1, axis=0)
    share = 1.0 + np.sum(before * normal, axis=1)
    return np.asarray(corners + margin * (before + normal) / share[:, None])


@njit(cache=True, nogil=True)
def transform_polygon(corners: Float64s, x: float, y: float, yaw: float) -> Float64s:
    """Corners (k, 2) in `base`, seen from the world."""
    c, s = cos(yaw), sin(yaw)
    out = np.empty_like(corners)
    for k in range(len(corners)):
        out[k, 0] = x + c * corners[k, 0] - s * corners[k, 1]
        out[k, 1] = y + s * corners[k, 0] + c * corners[k, 1]
    return out


@njit(cache=True, nogil=True)
def _crosses_segment(corners: Float64s, ax: float, ay: float, bx: float, by: float) -> bool:
    """Whether a segment touches the polygon's area."""
    if contains_point(corners, ax, ay):
        return True
    j = len(corners) - 1
    for i in range(len(corners)):
        px, py, qx, qy = corners[j, 0], corners[j, 1], corners[i, 0], corners[i, 1]
        a = (qx - px) * (ay - py) - (qy - py) * (ax - px)
        b = (qx - px) * (by - py) - (qy - py) * (bx - px)
        p = (bx - ax) * (py - ay) - (by - ay) * (px - ax)
        q = (bx - ax) * (qy - ay) - (by - ay) * (qx - ax)
        # by signs: a product of two tiny numbers is zero
        if (a <= 0.0 <= b or b <= 0.0 <= a) and (p <= 0.0 <= q or q <= 0.0 <= p) and (a != 0.0 or b != 0.0):
            return True
        j = i
    return False


@njit(cache=True, nogil=True)
def _crosses_box(corners: Float64s, left: float, low: float, right: float, high: float) -> bool:
    """Whether a box touches the polygon's area."""
    if contains_point(corners, left, low):
        return True
    j = len(corners) - 1
    for i in range(len(corners)):
        if segment_in_box(corners[j, 0], corners[j, 1], corners[i, 0], corners[i, 1], left, low, right, high):
            return True
        j = i
    return False


@njit(cache=True, nogil=True)
def touches_world(corners: Float64s, cells: Cells) -> bool:
    """Whether the polygon (k, 2), in the world, overlaps anything that stands still."""
    h, w = cells.skip.shape
    column0 = floor((corners[:, 0].min() - cells.x0) / cells.size)
    column1 = floor((corners[:, 0].max() - cells.x0) / cells.size)
    row0 = floor((corners[:, 1].min() - cells.y0) / cells.size)
    row1 = floor((corners[:, 1].max() - cells.y0) / cells.size)
    row, column = (row0 + row1) // 2, (column0 + column1) // 2
    if 0 <= row < h and 0 <= column < w:
        reach = max(row1 - row, row - row0, column1 - column, column - column0)
        if cells.skip[row, column] > reach:
            return False
    for row in range(max(row0, 0), min(row1, h - 1) + 1):
        for column in range(max(column0, 0), min(column1, w - 1) + 1):
            if cells.skip[row, column] > 0:
                continue
            if cells.skip[row, column] == SOLID:
                left, low = cells.x0 + column * cells.size, cells.y0 + row * cells.size
                if _crosses_box(corners, left, low, left + cells.size, low + cells.size):
                    return True
                continue
            for k in range(cells.first[row * w + column], cells.first[row * w + column + 1]):
                i = cells.items[k]
                if i >= 0:
                    ax, ay, bx, by = cells.segments[i]
                    if _crosses_segment(corners, ax, ay, bx, by):
                        return True
                else:
                    x, y, r = cells.circles[~i]
                    if distance_to_polygon(corners, x, y) <= r:
                        return True
    return False


@njit(cache=True, nogil=True)
def touches_people(corners: Float64s, people: Float64s) -> bool:
    """Whether the polygon overlaps one of the discs (p, 3) x, y, radius."""
    touches = False
    for i in range(len(people)):
        touches |= distance_to_polygon(corners, people[i, 0], people[i, 1]) <= people[i, 2]
    return touches


@njit(cache=True, nogil=True)
def disc_touches_world(x: float, y: float, r: float, cells: Cells) -> bool:
    """Whether a disc overlaps anything that stands still."""
    h, w = cells.skip.shape
    row0, row1 = floor((y - r - cells.y0) / cells.size), floor((y + r - cells.y0) / cells.size)
    column0, column1 = floor((x - r - cells.x0) / cells.size), floor((x + r - cells.x0) / cells.size)
    for row in range(max(row0, 0), min(row1, h - 1) + 1):
        for column in range(max(column0, 0), min(column1, w - 1) + 1):
            if cells.skip[row, column] == SOLID:
                left, low = cells.x0 + column * cells.size, cells.y0 + row * cells.size
                dx, dy = x - min(max(x, left), left + cells.size), y - min(max(y, low), low + cells.size)
                if dx * dx + dy * dy <= r * r:
                    return True
                continue
            for k in range(cells.first[row * w + column], cells.first[row * w + column + 1]):
                i = cells.items[k]
                if i >= 0:
                    ax, ay, bx, by = cells.segments[i]
                    if distance_to_segment(x, y, ax, ay, bx, by) <= r:
                        return True
                else:
                    if hypot(x - cells.circles[~i, 0], y - cells.circles[~i, 1]) <= r + cells.circles[~i, 2]:
                        return True
    return False
