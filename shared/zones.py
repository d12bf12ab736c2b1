# SPDX-License-Identifier: Apache-2.0
"""Zones on the map: their settings, their cells, and the active keep-out zones of a robot that stands in one."""

from itertools import combinations
from math import floor

import numpy as np
from numba import njit
from pydantic import Field, model_validator

from shared.config import Section
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import MAX_CORNERS, Zone, ZoneKind, Zones
from shared.polygon import contains, distances_to_outline, signed_area
from shared.types import Bools, Float64s, Int8s

Corner = tuple[float, float]

OBSTACLE = np.int8(100)  # percent

MIN_ZONE_AREA_M2 = 1e-4
"""m^2: a smaller zone is a line or a point."""


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
        if not 3 <= len(self.corners) <= MAX_CORNERS:
            raise ValueError(f"a zone has 3 to {MAX_CORNERS} corners, not {len(self.corners)}")
        corners = np.array(self.corners)
        if not np.abs(corners).max() <= 1e6:
            raise ValueError("a corner lies farther out than any map")
        if abs(signed_area(corners)) < MIN_ZONE_AREA_M2 or _crosses(corners):
            raise ValueError("the corners enclose no area, or its edges cross: give them in order around it")
        return self

    def zone(self, name: str) -> Zone:
        """The zone as a message."""
        kind = ZoneKind.KEEP_OUT if self.speed is None and self.percent is None else ZoneKind.SLOW
        xs, ys = np.array(self.corners, float).T.copy()
        speed = 20.0 if self.speed is None else self.speed
        return Zone(
            stamp=0,
            name=name,
            kind=kind,
            xs=xs,
            ys=ys,
            speed=speed,
            share=1.0 if self.percent is None else self.percent / 100,
        )


class NamedZoneConfig(ZoneConfig):
    """A zone with its name."""

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
    """Corners (n, 2) of a zone, m in `map`."""
    return np.column_stack((zone.xs, zone.ys))


def position(pose: Pose2) -> Float64s:
    """(1, 2) m: the point at which a pose lies."""
    return np.array([[pose.x, pose.y]], float)


def keep_outs(zones: Zones) -> tuple[Float64s, ...]:
    """The polygons, (n, 2) m in `map`, of the keep-out zones."""
    return tuple(polygon_of(zone) for zone in zones.zones if zone.kind is ZoneKind.KEEP_OUT)


def forbidding(zones: tuple[Zone, ...], poses: tuple[Pose2, ...]) -> list[Zone | None]:
    """The first keep-out zone in which each pose lies, if any. Each zone is tested once: a route may be long."""
    points = np.array([(pose.x, pose.y) for pose in poses], float).reshape(-1, 2)
    found: list[Zone | None] = [None] * len(poses)
    for zone in zones:
        if zone.kind is ZoneKind.KEEP_OUT:
            for i in np.flatnonzero(contains(polygon_of(zone), points)).tolist():
                found[i] = found[i] or zone
    return found


class KeepOut:
    """The active keep-out zones of a robot: all except those that it stands in, so that it may drive out.

    It stands in a zone from when its centre is inside until its whole outline (radius `reach`, m) is outside again.
    """

    def __init__(self, reach: float) -> None:
        self._reach = reach
        self._entered: frozenset[int] = frozenset()
        self.polygons: tuple[Float64s, ...] = ()

    def take(self, zones: Zones) -> None:
        """Replaces the zones."""
        self.take_polygons(keep_outs(zones))

    def take_polygons(self, polygons: tuple[Float64s, ...]) -> None:
        """Replaces the zones by these, (n, 2) m in `map`. One that was there before and is left stays open."""
        left, self.polygons = self.entered, polygons
        self._entered = frozenset(i for i, p in enumerate(polygons) if any(np.array_equal(p, zone) for zone in left))

    def moved(self, pose: Pose2) -> bool:
        """Updates the zones for the robot's pose in `map`. Returns whether the active ones changed."""
        before, at = self._entered, position(pose)
        self._entered = frozenset(
            i
            for i, polygon in enumerate(self.polygons)
            if contains(polygon, at)[0] or (i in before and distances_to_outline(polygon, at)[0] < self._reach)
        )
        return self._entered != before

    @property
    def holding(self) -> list[Float64s]:
        """The polygons, (n, 2) m in `map`, that the robot may not enter."""
        return [polygon for i, polygon in enumerate(self.polygons) if i not in self._entered]

    @property
    def entered(self) -> list[Float64s]:
        """The polygons, (n, 2) m in `map`, that the robot stands in and should leave."""
        return [self.polygons[i] for i in sorted(self._entered)]


def marked(grid: OccupancyGrid, polygons: list[Float64s], pad: int = 0) -> Bools:
    """(h + 2 pad, w + 2 pad) bool: cells that polygons touch, of a grid and `pad` cells around it."""
    h, w = grid.cells.shape
    cells = np.zeros((h + 2 * pad, w + 2 * pad), bool)
    for polygon in polygons:
        mark_cells(cells, grid.x0 - pad * grid.resolution, grid.y0 - pad * grid.resolution, grid.resolution, polygon)
    return cells


def laid(grid: OccupancyGrid, polygons: list[Float64s]) -> Int8s:
    """(h, w) int8: the grid's cells, with an obstacle in every cell that a polygon touches."""
    return np.where(marked(grid, polygons), OBSTACLE, grid.cells) if polygons else grid.cells


@njit(cache=True, nogil=True)
def mark_cells(cells: Bools, x0: float, y0: float, resolution: float, polygon: Float64s) -> None:
    """Sets the cells (h, w) whose centre lies in a polygon (n, 2) m, or through which its outline goes.

    x0, y0: m, lower left corner of cell (0, 0). resolution: m a cell. Cells beyond the edge are passed over.
    """
    h, w = cells.shape
    n = len(polygon)
    low, high = polygon[:, 1].min(), polygon[:, 1].max()
    crossings = np.empty(n)
    for row in range(max(0, floor((low - y0) / resolution)), min(h, floor((high - y0) / resolution) + 1)):
        y = y0 + (row + 0.5) * resolution
        n_crossings = 0
        for i in range(n):
            ax, ay = polygon[i, 0], polygon[i, 1]
            bx, by = polygon[(i + 1) % n, 0], polygon[(i + 1) % n, 1]
            if (ay > y) != (by > y):
                crossings[n_crossings] = ax + (y - ay) * (bx - ax) / (by - ay)
                n_crossings += 1
        crossings[:n_crossings].sort()
        for k in range(0, n_crossings - 1, 2):
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
