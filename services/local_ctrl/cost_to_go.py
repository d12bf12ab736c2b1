# SPDX-License-Identifier: Apache-2.0
"""Cost to go: cost from each cell of the window to the end of the visible plan, around obstacles.

The cost is the integral of slowness along the cheapest path: 1 on the plan, more beside it, near obstacles and in
unknown space. One field so leads along a free plan, around an obstacle on it, and back to it. Where no path exists, it
leads to the point at which the plan is blocked.
"""

from math import floor, hypot, inf, sqrt
from typing import ClassVar, NamedTuple

import numpy as np
from numba import njit
from pydantic import Field

from services.local_ctrl.footprint import bilinear
from shared.config import Section
from shared.distance_field import distance_field_into
from shared.types import Bools, Float32s, Float64s

COARSE_CELLS = 2  # cells of the costmap along a side of one of the field
END_MARGIN_POINTS = 3  # points of the path between the robot and the blocked point
MAX_SWEEPS = 24  # four settle each cell with a best path that turns through less than a full circle


class CostToGoConfig(Section):
    """Slowness of cells."""

    RENAMED: ClassVar[dict[str, str]] = {"beside_plan_at_most": "max_beside_plan"}

    beside_plan: float = Field(0.5, ge=0, le=10, description="1/m: slowness added per metre of distance to the plan")
    max_beside_plan: float = Field(0.5, ge=0, le=10, description="1: maximum of that addition")
    near_obstacles: float = Field(3.0, ge=0, le=100, description="1: slowness added where the robot just fits")
    clearance: float = Field(0.3, ge=0.01, le=3, description="m beyond the outline at which obstacles add nothing")
    unknown: float = Field(0.3, ge=0, le=100, description="1: slowness added in unknown space")
    no_room: float = Field(40.0, ge=1, le=1000, description="1: slowness added where the robot does not fit")


class CostToGo(NamedTuple):
    """Field (n / 2, n / 2) float32 m; cell (0, 0) is centred between the costmap's first two cells of both axes."""

    field: Float32s
    i_end: int  # of the path's point that it leads to
    closed: bool  # no path leads to the plan's last point: i_end is the point before the obstacle


def cost_to_go(
    field: Float32s,
    unknown: Bools,
    resolution: float,
    path: Float64s,
    robot: tuple[float, float],
    inscribed: float,
    config: CostToGoConfig,
) -> CostToGo:
    """The cost to go in a window: fast sweeping of the eikonal equation (Zhao 2005), started on the plan.

    `field`, `unknown`: (n, n), n even, m and bool, of the costmap. `path`: (k, 2) m. `robot`: m. Both are relative to
    the costmap's lower left centre. `inscribed`: m, radius. `resolution`: m a cell of the costmap.
    """
    to_go = np.empty((len(field) // COARSE_CELLS, len(field) // COARSE_CELLS), np.float32)
    settings = (
        config.beside_plan,
        config.max_beside_plan,
        config.near_obstacles,
        config.clearance,
        config.unknown,
        config.no_room,
    )
    i_end, closed = _fill_cost_to_go(field, unknown, resolution, path, robot, inscribed, settings, to_go)
    return CostToGo(to_go, i_end, closed)


@njit(cache=True, nogil=True)
def _fill_cost_to_go(
    field: Float32s,
    unknown: Bools,
    resolution: float,
    path: Float64s,
    robot: tuple[float, float],
    inscribed: float,
    settings: tuple[float, float, float, float, float, float],
    to_go: Float32s,
) -> tuple[int, bool]:
    n = len(to_go)
    size = COARSE_CELLS * resolution
    # positions in cells of the coarse field: its first centre lies half a fine cell up and right
    cells = (path - 0.5 * (COARSE_CELLS - 1) * resolution) / size
    column = int(min(max((robot[0] - 0.5 * (COARSE_CELLS - 1) * resolution) / size + 0.5, 0.0), n - 1.0))
    row = int(min(max((robot[1] - 0.5 * (COARSE_CELLS - 1) * resolution) / size + 0.5, 0.0), n - 1.0))
    on_path = np.zeros((n, n), np.bool_)
    for k in range(len(cells)):
        i, j = floor(cells[k, 1] + 0.5), floor(cells[k, 0] + 0.5)
        if 0 <= i < n and 0 <= j < n:
            on_path[i, j] = True
    slowness = np.empty((n, n), np.float32)
    distance_field_into(on_path, size, slowness)
    fits = np.empty((n, n), np.bool_)
    # the robot's own clearance always fits, so that it can leave a narrow place
    here = bilinear(field, robot[0] / resolution, robot[1] / resolution)
    _fill_slowness(field, unknown, resolution, inscribed, min(inscribed, here - size), settings, slowness, fits)
    i_end, closed = len(cells) - 1, False
    for _ in range(2):
        to_go.fill(np.inf)
        _initialize(cells[: i_end + 1], slowness, fits, size, to_go)
        _sweep_until_settled(slowness, fits, size, to_go)
        if to_go[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].min() < inf:
            break
        i_end, closed = max(0, _n_fitting(cells, fits) - 1 - END_MARGIN_POINTS), True
    np.logical_not(np.isfinite(to_go), fits)
    _sweep_until_settled(slowness, fits, size, to_go)
    return i_end, closed


@njit(cache=True, nogil=True)
def _n_fitting(cells: Float64s, fits: Bools) -> int:
    """Number of points of the path before the first one where the robot does not fit."""
    n = len(fits)
    for k in range(len(cells)):
        i, j = floor(cells[k, 1] + 0.5), floor(cells[k, 0] + 0.5)
        if not (0 <= i < n and 0 <= j < n and fits[i, j]):
            return k
    return len(cells)


@njit(cache=True, nogil=True)
def _fill_slowness(
    field: Float32s,
    unknown: Bools,
    resolution: float,
    inscribed: float,
    needed: float,
    settings: tuple[float, float, float, float, float, float],
    slowness: Float32s,
    fits: Bools,
) -> None:
    """Replaces distances from the plan, m, by slowness. fits: where the next obstacle is over `needed` m away."""
    beside, beside_most, near, clearance, unknown_cost, no_room = settings
    n = len(slowness)
    for row in range(n):
        for column in range(n):
            i, j = COARSE_CELLS * row, COARSE_CELLS * column
            away = 0.25 * (field[i, j] + field[i, j + 1] + field[i + 1, j] + field[i + 1, j + 1])
            room = away - inscribed
            slow = 1.0 + min(beside_most, beside * max(0.0, slowness[row, column] - resolution))
            if room <= 0.0:
                slow += no_room
            elif room < clearance:
                slow += near * (1.0 - room / clearance) ** 2
            if unknown[i, j] and unknown[i + 1, j + 1]:
                slow += unknown_cost
            slowness[row, column] = slow
            fits[row, column] = away > needed


@njit(cache=True, nogil=True)
def _initialize(cells: Float64s, slowness: Float32s, fits: Bools, size: float, to_go: Float32s) -> None:
    """Exact costs around the path's end, and along the path its length until it is blocked."""
    n = len(to_go)
    last = len(cells) - 1
    along = 0.0
    for k in range(last, -1, -1):
        x, y = cells[k]
        column, row = floor(x), floor(y)
        if not (0 <= row < n - 1 and 0 <= column < n - 1):
            continue
        if k == last:
            for i in range(max(0, row - 2), min(n, row + 4)):
                for j in range(max(0, column - 2), min(n, column + 4)):
                    to_go[i, j] = hypot(j - x, i - y) * size * slowness[i, j] if fits[i, j] else inf
            continue
        i, j = floor(y + 0.5), floor(x + 0.5)
        if not fits[i, j]:
            break
        along += hypot(cells[k + 1, 0] - x, cells[k + 1, 1] - y) * size * slowness[i, j]
        to_go[i, j] = min(to_go[i, j], along + hypot(j - x, i - y) * size * slowness[i, j])


@njit(cache=True, nogil=True)
def _sweep_until_settled(slowness: Float32s, wanted: Bools, size: float, to_go: Float32s) -> None:
    for sweep in range(MAX_SWEEPS):
        if _sweep(sweep % 4, slowness, wanted, size, to_go) < 0.01 and sweep >= 3:
            break


@njit(cache=True, nogil=True)
def _sweep(corner: int, slowness: Float32s, wanted: Bools, size: float, to_go: Float32s) -> float:
    """One Gauss-Seidel sweep away from one corner over the wanted cells; returns the largest improvement, m."""
    n = len(to_go)
    max_change = 0.0
    for a in range(n):
        row = a if corner < 2 else n - 1 - a
        for b in range(n):
            column = b if corner == 0 or corner == 3 else n - 1 - b
            if not wanted[row, column]:
                continue
            low = min(to_go[row - 1, column] if row > 0 else inf, to_go[row + 1, column] if row < n - 1 else inf)
            side = min(to_go[row, column - 1] if column > 0 else inf, to_go[row, column + 1] if column < n - 1 else inf)
            first, second = min(low, side), max(low, side)
            if first >= to_go[row, column]:
                continue
            step = slowness[row, column] * size
            value = first + step
            if second < value:
                value = 0.5 * (first + second + sqrt(2.0 * step * step - (first - second) ** 2))
            if value < to_go[row, column]:
                max_change = max(max_change, to_go[row, column] - value)
                to_go[row, column] = value
    return max_change


@njit(cache=True, nogil=True, inline="always")
def to_go_at(to_go: Float32s, x: float, y: float, resolution: float) -> float:
    """The cost to go, m, at (x, y), m from the costmap's lower left centre.

    to_go: (n / 2, n / 2) float32 m, see `CostToGo`. resolution: m a cell of the costmap.
    """
    size = COARSE_CELLS * resolution
    rim = 0.5 * (COARSE_CELLS - 1) * resolution
    return bilinear(to_go, (x - rim) / size, (y - rim) / size)


@njit(cache=True, nogil=True)
def carrot(to_go: Float32s, x: float, y: float, look: float, resolution: float) -> tuple[float, float]:
    """The point (x, y) `look` m down the gradient of the cost to go from (x, y); nearer at its minimum.

    Points are m from the costmap's lower left centre. to_go, resolution: as for `to_go_at`.
    """
    half, step = 0.5 * COARSE_CELLS * resolution, COARSE_CELLS * resolution
    for _ in range(int(look / step) + 1):
        dx = to_go_at(to_go, x - half, y, resolution) - to_go_at(to_go, x + half, y, resolution)
        dy = to_go_at(to_go, x, y - half, resolution) - to_go_at(to_go, x, y + half, resolution)
        length = hypot(dx, dy)
        if length < 1e-6:
            break
        x, y = x + dx / length * step, y + dy / length * step
    return x, y
