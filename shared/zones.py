# SPDX-License-Identifier: Apache-2.0
"""Zones on the map: as a person writes them, as cells, and which keep-out zones hold for a robot that stands in one."""

from itertools import combinations
from math import floor

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field, model_validator

from shared.config import Section
from shared.geometry import Pose2, inside
from shared.grid import OccupancyGrid
from shared.messages import MOST_CORNERS, Zone, ZoneKind, Zones

Bools = NDArray[np.bool_]
Int8s = NDArray[np.int8]
Float64s = NDArray[np.float64]
Corner = tuple[float, float]

OBSTACLE = np.int8(100)  # percent

LEAST_AREA = 1e-4
"""m^2: what is smaller is a line or a point, and nobody's intention."""


class ZoneConfig(Section):
    """A polygon on the map that the robot keeps out of, or drives slowly in where it has a speed or a percentage."""

    corners: tuple[Corner, ...] = Field(
        description="m, m: corners in `map`, in order, three at least; it closes by itself"
    )
    speed: float | None = Field(None, ge=0.01, le=20, description="m/s at most inside; none: see percent")
    percent: float | None = Field(
        None, ge=1, le=100, description="percent of the robot's top speed inside; neither: keep out"
    )

    @model_validator(mode="after")
    def _is_a_polygon(self) -> "ZoneConfig":
        if self.speed is not None and self.percent is not None:
            raise ValueError("give speed or percent, not both")
        if not 3 <= len(self.corners) <= MOST_CORNERS:
            raise ValueError(f"a zone has 3 to {MOST_CORNERS} corners, not {len(self.corners)}")
        corners = np.array(self.corners)
        if not np.abs(corners).max() <= 1e6:
            raise ValueError("a corner lies farther out than any map")
        x, y = corners.T
        if abs(0.5 * float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))) < LEAST_AREA or _crosses(corners):
            raise ValueError("the corners enclose no area, or its edges cross: give them in order around it")
        return self

    def zone(self, name: str) -> Zone:
        """The message that says it."""
        kind = ZoneKind.KEEP_OUT if self.speed is None and self.percent is None else ZoneKind.SLOW
        xs, ys = np.array(self.corners, float).T.copy()
        speed = 20.0 if self.speed is None else self.speed
        return Zone(0, name, kind, xs, ys, speed, 1.0 if self.percent is None else self.percent / 100)


class NamedZoneConfig(ZoneConfig):
    """The same with its name."""

    name: str = Field(min_length=1, max_length=64, description="of the zone, its own among all")


def _crosses(corners: Float64s) -> bool:
    """Whether two edges that do not share a corner meet."""
    n = len(corners)
    ends = [(corners[i], corners[(i + 1) % n]) for i in range(n)]
    return any(
        _side(a, b, c) * _side(a, b, d) < 0 and _side(c, d, a) * _side(c, d, b) < 0
        for (i, (a, b)), (j, (c, d)) in combinations(enumerate(ends), 2)
        if j - i > 1 and (i, j) != (0, n - 1)
    )


def _side(a: Float64s, b: Float64s, c: Float64s) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def polygon_of(zone: Zone) -> Float64s:
    """(n, 2) m in `map`."""
    return np.column_stack((zone.xs, zone.ys))


def holds(polygon: Float64s, x: float, y: float) -> bool:
    """Whether the point lies in the polygon (n, 2)."""
    return bool(inside(polygon, np.array([[x, y]], float))[0])


def keep_outs(zones: Zones) -> tuple[Float64s, ...]:
    """The polygons, (n, 2) m in `map`, of the keep-out zones."""
    return tuple(polygon_of(zone) for zone in zones.zones if zone.kind is ZoneKind.KEEP_OUT)


def forbidding(zones: tuple[Zone, ...], pose: Pose2) -> Zone | None:
    """The keep-out zone in which a pose lies, if any."""
    barred = (zone for zone in zones if zone.kind is ZoneKind.KEEP_OUT)
    return next((zone for zone in barred if holds(polygon_of(zone), pose.x, pose.y)), None)


class KeepOut:
    """Which keep-out zones hold for a robot: all but those that it stands in, so that it may drive out.

    It stands in one from when its middle is inside until its whole outline, `reach` m about it, is out again.
    """

    def __init__(self, reach: float) -> None:
        self._reach = reach
        self._entered: frozenset[int] = frozenset()
        self.polygons: tuple[Float64s, ...] = ()

    def take(self, zones: Zones) -> None:
        """Other zones hold from now on."""
        self.polygons, self._entered = keep_outs(zones), frozenset()

    def moved(self, pose: Pose2) -> bool:
        """The robot is at a pose in `map`; whether other zones hold now."""
        before = self._entered
        self._entered = frozenset(
            i
            for i, polygon in enumerate(self.polygons)
            if holds(polygon, pose.x, pose.y) or (i in before and distance_to(polygon, pose.x, pose.y) < self._reach)
        )
        return self._entered != before

    @property
    def holding(self) -> list[Float64s]:
        """The polygons that the robot may not enter."""
        return [polygon for i, polygon in enumerate(self.polygons) if i not in self._entered]

    @property
    def entered(self) -> list[Float64s]:
        """The polygons that it stands in and should leave."""
        return [self.polygons[i] for i in sorted(self._entered)]


def distance_to(polygon: Float64s, x: float, y: float) -> float:
    """m from a point to the nearest edge of a polygon (n, 2)."""
    edges, there = np.roll(polygon, -1, axis=0) - polygon, np.array((x, y)) - polygon
    along = np.clip((there * edges).sum(axis=1) / np.maximum((edges * edges).sum(axis=1), 1e-12), 0, 1)
    return float(np.hypot(*(there - along[:, None] * edges).T).min())


def marked(grid: OccupancyGrid, polygons: list[Float64s], pad: int = 0) -> Bools:
    """(h + 2 pad, w + 2 pad) bool: the cells of a grid, and of `pad` cells around it, that polygons touch."""
    h, w = grid.cells.shape
    cells = np.zeros((h + 2 * pad, w + 2 * pad), bool)
    for polygon in polygons:
        mark_cells(cells, grid.x0 - pad * grid.resolution, grid.y0 - pad * grid.resolution, grid.resolution, polygon)
    return cells


def laid(grid: OccupancyGrid, polygons: list[Float64s]) -> Int8s:
    """(h, w) int8: the grid's cells with an obstacle wherever a polygon touches one; they themselves without any."""
    return np.where(marked(grid, polygons), OBSTACLE, grid.cells) if polygons else grid.cells


@njit(cache=True, nogil=True)
def mark_cells(cells: Bools, x0: float, y0: float, resolution: float, polygon: Float64s) -> None:
    """Sets the cells (h, w) whose centre lies in a polygon (n, 2) m, or through which its outline goes.

    x0, y0: m, lower left corner of cell (0, 0). Cells beyond the edge are passed over.
    """
    h, w = cells.shape
    n = len(polygon)
    low, high = polygon[:, 1].min(), polygon[:, 1].max()
    crossings = np.empty(n)
    for row in range(max(0, floor((low - y0) / resolution)), min(h, floor((high - y0) / resolution) + 1)):
        y = y0 + (row + 0.5) * resolution
        found = 0
        for i in range(n):
            ax, ay = polygon[i, 0], polygon[i, 1]
            bx, by = polygon[(i + 1) % n, 0], polygon[(i + 1) % n, 1]
            if (ay > y) != (by > y):
                crossings[found] = ax + (y - ay) * (bx - ax) / (by - ay)
                found += 1
        crossings[:found].sort()
        for k in range(0, found - 1, 2):
            # floats, until they are known to be in the window: a corner may lie a million metres out
            first = max(0.0, np.ceil((crossings[k] - x0) / resolution - 0.5))
            last = min(w - 1.0, np.floor((crossings[k + 1] - x0) / resolution - 0.5))
            for column in range(int(min(first, float(w))), int(max(last, -1.0)) + 1):
                cells[row, column] = True
    corners = (polygon - np.array((x0, y0))) / resolution
    for i in range(n):
        _mark_line(cells, corners[i], corners[(i + 1) % n])


@njit(cache=True, nogil=True)
def _mark_line(cells: Bools, a: Float64s, b: Float64s) -> None:
    """Sets the cells near the line from a to b, (x, y) in cells: a thin zone must not fall between the centres."""
    h, w = cells.shape
    dx, dy = b[0] - a[0], b[1] - a[1]
    # the part of the line in the window (Liang & Barsky 1984)
    first, last = 0.0, 1.0
    for start, change, size in ((a[0], dx, float(w)), (a[1], dy, float(h))):
        if change == 0.0:
            if start < 0.0 or start >= size:
                return
            continue
        enters, leaves = -start / change, (size - start) / change
        first, last = max(first, min(enters, leaves)), min(last, max(enters, leaves))
    if last < first:
        return
    n = int(np.ceil(4.0 * (last - first) * max(abs(dx), abs(dy)))) + 1
    for k in range(n + 1):
        t = first + (last - first) * k / n
        row, column = floor(a[1] + t * dy), floor(a[0] + t * dx)
        if 0 <= row < h and 0 <= column < w:
            cells[row, column] = True
