# SPDX-License-Identifier: Apache-2.0
"""How far is it from anywhere in the window to the end of the plan's visible part, around what stands in between.

The plan says where to go, the costmap what it could not know. Distance to go is the least integral of slowness over all
ways: 1 on the plan, more beside it, near obstacles and in the unknown, much more where the robot does not fit.
So one field pulls along the plan where that is free, around a box that stands on it, and back to it from anywhere.
"""

from math import floor, hypot, inf, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from services.local_ctrl.footprint import sampled
from shared.config import Section
from shared.distance_field import distance_field_into

Bools = NDArray[np.bool_]
Float32s = NDArray[np.float32]
Float64s = NDArray[np.float64]

COARSE = 2  # cells of the costmap to one of the field, along each axis
SWEEPS = 24  # at most; four settle every cell whose best way turns through less than a full circle


class DistanceToGoConfig(Section):
    """What makes a way longer than it is."""

    beside_plan: float = Field(0.5, ge=0, le=10, description="1/m: slowness added a metre away from the plan")
    beside_plan_at_most: float = Field(0.5, ge=0, le=10, description="1: slowness added far from the plan")
    near_obstacles: float = Field(3.0, ge=0, le=100, description="1: slowness added where the robot just fits")
    clearance: float = Field(0.3, ge=0.01, le=3, description="m beyond the outline at which obstacles no longer count")
    unknown: float = Field(0.3, ge=0, le=100, description="1: slowness added where nobody has looked")
    no_room: float = Field(40.0, ge=1, le=1000, description="1: slowness added where the robot does not fit")


def distance_to_go(
    field: Float32s, unknown: Bools, resolution: float, path: Float64s, inscribed: float, config: DistanceToGoConfig
) -> Float32s:
    """field, unknown: (n, n), n even, m and bool, of the costmap.  path: (k, 2) m from the costmap's lower left centre.
    inscribed: m.

    Returns (n / 2, n / 2) float32 m; cell (0, 0) is centred between the costmap's first two cells of both axes.
    The eikonal equation by fast sweeping (Zhao 2005), started from the way along the plan, which bounds it from above.
    """
    out = np.empty((len(field) // COARSE, len(field) // COARSE), np.float32)
    settings = (
        config.beside_plan,
        config.beside_plan_at_most,
        config.near_obstacles,
        config.clearance,
        config.unknown,
        config.no_room,
    )
    _solve(field, unknown, resolution, path, inscribed, settings, out)
    return out


@njit(cache=True, nogil=True)
def _solve(
    field: Float32s,
    unknown: Bools,
    resolution: float,
    path: Float64s,
    inscribed: float,
    settings: tuple[float, float, float, float, float, float],
    out: Float32s,
) -> None:
    n = len(out)
    size = COARSE * resolution
    # the path in cells of the coarse field, whose first centre lies half a fine cell up and right
    cells = (path - 0.5 * (COARSE - 1) * resolution) / size
    on_path = np.zeros((n, n), np.bool_)
    for k in range(len(cells)):
        column, row = floor(cells[k, 0] + 0.5), floor(cells[k, 1] + 0.5)
        if 0 <= row < n and 0 <= column < n:
            on_path[row, column] = True
    slowness = np.empty((n, n), np.float32)
    distance_field_into(on_path, size, slowness)
    _slow_down(field, unknown, resolution, inscribed, settings, slowness)
    out.fill(np.inf)
    _start(cells, slowness, size, out)
    for sweep in range(SWEEPS):
        if _sweep(sweep % 4, slowness, size, out) < 0.01 and sweep >= 3:
            break


@njit(cache=True, nogil=True)
def _slow_down(
    field: Float32s,
    unknown: Bools,
    resolution: float,
    inscribed: float,
    settings: tuple[float, float, float, float, float, float],
    slowness: Float32s,
) -> None:
    """Turns distances from the plan, m, into slowness."""
    beside, beside_most, near, clearance, unknown_cost, no_room = settings
    n = len(slowness)
    for row in range(n):
        for column in range(n):
            least = min(
                min(field[2 * row, 2 * column], field[2 * row, 2 * column + 1]),
                min(field[2 * row + 1, 2 * column], field[2 * row + 1, 2 * column + 1]),
            )
            mean = 0.25 * (
                field[2 * row, 2 * column]
                + field[2 * row, 2 * column + 1]
                + field[2 * row + 1, 2 * column]
                + field[2 * row + 1, 2 * column + 1]
            )
            room = mean - inscribed
            slow = 1.0 + min(beside_most, beside * max(0.0, slowness[row, column] - resolution))
            if room <= 0.0:
                # deeper is slower, so that the way out of a tight place is the shortest one
                slow += no_room * (1.0 - 0.5 * least / inscribed)
            elif room < clearance:
                slow += near * (1.0 - room / clearance) ** 2
            if unknown[2 * row, 2 * column] and unknown[2 * row + 1, 2 * column + 1]:
                slow += unknown_cost
            slowness[row, column] = slow


@njit(cache=True, nogil=True)
def _start(cells: Float64s, slowness: Float32s, size: float, out: Float32s) -> None:
    """Exact distances about the path's end, and along the path the length of the way on it."""
    n = len(out)
    last = len(cells) - 1
    along = 0.0
    for k in range(last, -1, -1):
        x, y = cells[k]
        column, row = floor(x), floor(y)
        if not (0 <= row < n - 1 and 0 <= column < n - 1):
            continue
        if k == last:
            ring = 2
            for i in range(max(0, row - ring), min(n, row + ring + 2)):
                for j in range(max(0, column - ring), min(n, column + ring + 2)):
                    out[i, j] = hypot(j - x, i - y) * size * slowness[i, j]
            continue
        i, j = floor(y + 0.5), floor(x + 0.5)
        along += hypot(cells[k + 1, 0] - x, cells[k + 1, 1] - y) * size * slowness[i, j]
        out[i, j] = min(out[i, j], along + hypot(j - x, i - y) * size * slowness[i, j])


@njit(cache=True, nogil=True)
def _sweep(corner: int, slowness: Float32s, size: float, out: Float32s) -> float:
    """One Gauss-Seidel sweep away from one corner; returns the largest improvement, m."""
    n = len(out)
    most = 0.0
    for a in range(n):
        row = a if corner < 2 else n - 1 - a
        for b in range(n):
            column = b if corner == 0 or corner == 3 else n - 1 - b
            low = min(out[row - 1, column] if row > 0 else inf, out[row + 1, column] if row < n - 1 else inf)
            side = min(out[row, column - 1] if column > 0 else inf, out[row, column + 1] if column < n - 1 else inf)
            first, second = min(low, side), max(low, side)
            if first >= out[row, column]:
                continue
            step = slowness[row, column] * size
            value = first + step
            if second < value:
                value = 0.5 * (first + second + sqrt(2.0 * step * step - (first - second) ** 2))
            if value < out[row, column]:
                most = max(most, out[row, column] - value)
                out[row, column] = value
    return most


@njit(cache=True, nogil=True)
def to_go_at(to_go: Float32s, x: float, y: float, resolution: float) -> float:
    """The distance to go at (x, y), m from the costmap's lower left centre; m."""
    size = COARSE * resolution
    rim = 0.5 * (COARSE - 1) * resolution
    return sampled(to_go, (x - rim) / size, (y - rim) / size)


@njit(cache=True, nogil=True)
def carrot(to_go: Float32s, x: float, y: float, look: float, resolution: float) -> tuple[float, float]:
    """The point `look` m down the distance to go from (x, y); nearer where it ends."""
    half, step = 0.5 * COARSE * resolution, COARSE * resolution
    for _ in range(int(look / step) + 1):
        dx = to_go_at(to_go, x - half, y, resolution) - to_go_at(to_go, x + half, y, resolution)
        dy = to_go_at(to_go, x, y - half, resolution) - to_go_at(to_go, x, y + half, resolution)
        length = hypot(dx, dy)
        if length < 1e-6:
            break
        x, y = x + dx / length * step, y + dy / length * step
    return x, y


@njit(cache=True, nogil=True)
def way_closed(
    to_go: Float32s, field: Float32s, x: float, y: float, resolution: float, inscribed: float, look: float = 0.5
) -> bool:
    """Whether the best way from (x, y) soon leads through a place where the robot does not fit: within `look` m."""
    step = COARSE * resolution
    fits = False
    for _ in range(int(look / step) + 1):
        # a cell less than the outline: the field's coarse cells cut corners by so much
        room = sampled(field, x / resolution, y / resolution) - inscribed + resolution
        if room <= 0.0 and fits:
            return True
        fits = fits or room > 0.0
        x, y = carrot(to_go, x, y, 0.0, resolution)
    return False
