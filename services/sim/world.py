# SPDX-License-Identifier: Apache-2.0
"""A world: static shapes, pedestrians, the robot's start and its goals. World frame, m."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import cached_property, partial
from math import ceil, pi

import numpy as np
import scipy

from services.sim.rays import Cells, extent, index_grid, index_shapes, shapes_by_cell
from shared.geometry import Pose2
from shared.polygon import contains
from shared.types import Bools, Float64s

Box = tuple[float, float, float, float]  # low x, low y, high x, high y

SHAPE_CELL = 0.1  # m: side of an index cell in worlds of shapes; short rays dominate, and walls are about as thick


@dataclass(frozen=True, slots=True)
class Raster:
    """Solid cells of a ROS map: (h, w) bool, row 0 at the lowest y; x0, y0 is the lower left corner, m."""

    solid: Bools
    x0: float
    y0: float
    resolution: float

    @property
    def bounds(self) -> Box:
        h, w = self.solid.shape
        return self.x0, self.y0, self.x0 + w * self.resolution, self.y0 + h * self.resolution

    def holds(self, points: Float64s) -> Bools:
        """Which points (n, 2) lie in solid cells: (n,) bool."""
        h, w = self.solid.shape
        place = np.floor((points - (self.x0, self.y0)) / self.resolution).astype(np.int64)
        inside = ((place >= 0) & (place < (w, h))).all(axis=1)
        out = np.zeros(len(points), bool)
        out[inside] = self.solid[place[inside, 1], place[inside, 0]]
        return out


@dataclass(frozen=True, slots=True)
class Pedestrian:
    """One person: closed route (k, 2) m, mean speed m/s, mean pause at each waypoint s, radius m."""

    route: Float64s
    speed: float
    pause: float
    radius: float


def _in_circle(x: float, y: float, r: float, points: Float64s) -> Bools:
    return np.asarray(np.hypot(points[:, 0] - x, points[:, 1] - y) <= r)


def _no_circles() -> Float64s:
    return np.zeros((0, 3))


@dataclass(frozen=True)
class World:
    """polygons: solid, each (k, 2).  circles: (m, 3) x, y, radius, solid.  bounds: low x, low y, high x, high y.

    cliffs: regions without floor, each (k, 2).
    """

    name: str
    bounds: Box
    start: Pose2
    polygons: tuple[Float64s, ...] = ()
    circles: Float64s = field(default_factory=_no_circles)
    raster: Raster | None = None
    people: tuple[Pedestrian, ...] = ()
    cliffs: tuple[Float64s, ...] = ()
    goals: dict[str, Pose2] = field(default_factory=dict)

    @cached_property
    def segments(self) -> Float64s:
        """(n, 4) x, y, x, y: the outlines of all polygons."""
        rows = [np.hstack((p, np.roll(p, -1, axis=0))) for p in self.polygons]
        return np.ascontiguousarray(np.concatenate(rows)) if rows else np.zeros((0, 4))

    @cached_property
    def cells(self) -> Cells:
        """The index for rays and contacts."""
        if self.raster is None:
            return index_shapes(self.segments, self.circles, SHAPE_CELL)
        r = self.raster
        low_x, low_y, high_x, high_y = extent(self.segments, self.circles)
        h, w = r.solid.shape
        before = max(0, ceil((r.x0 - low_x) / r.resolution)), max(0, ceil((r.y0 - low_y) / r.resolution))
        after = (
            max(0, ceil((high_x - r.x0) / r.resolution) - w + 1),
            max(0, ceil((high_y - r.y0) / r.resolution) - h + 1),
        )
        solid = np.pad(r.solid, ((before[1], after[1]), (before[0], after[0])))
        x0, y0 = r.x0 - before[0] * r.resolution, r.y0 - before[1] * r.resolution
        return index_grid(self.segments, self.circles, solid, x0, y0, r.resolution)

    def _solids(self) -> Iterator[tuple[Box, Callable[[Float64s], Bools]]]:
        """Everything solid: the box around it, and which points (n, 2) it holds."""
        for polygon in self.polygons:
            yield (*polygon.min(axis=0), *polygon.max(axis=0)), partial(contains, polygon)
        for x, y, r in self.circles:
            yield (x - r, y - r, x + r, y + r), partial(_in_circle, x, y, r)
        if self.raster is not None:
            yield self.raster.bounds, self.raster.holds

    def solid_at(self, points: Float64s) -> Bools:
        """Which points (n, 2) lie in something solid: (n,) bool."""
        hit = np.zeros(len(points), bool)
        for (low_x, low_y, high_x, high_y), holds in self._solids():
            near = ((points >= (low_x, low_y)) & (points <= (high_x, high_y))).all(axis=1)
            hit[near] |= holds(points[near])
        return hit

    def occupied(self, resolution: float) -> tuple[Bools, float, float]:
        """The true static world as a grid over `bounds`: (h, w) bool, row 0 at the lowest y, and its lower left corner.

        A cell is occupied where something solid, or its surface, reaches into it. Cells lie on whole multiples of
        `resolution`.
        """
        low_x, low_y, high_x, high_y = self.bounds
        column0, row0 = int(np.floor(low_x / resolution + 1e-6)), int(np.floor(low_y / resolution + 1e-6))
        w = int(np.ceil(high_x / resolution - 1e-6)) - column0
        h = int(np.ceil(high_y / resolution - 1e-6)) - row0
        x0, y0 = column0 * resolution, row0 * resolution
        first, _ = shapes_by_cell(self.segments, self.circles, x0, y0, resolution, h, w, -1e-6 * resolution)
        occupied = (np.diff(first) > 0).reshape(h, w)
        x, y = x0 + (np.arange(w) + 0.5) * resolution, y0 + (np.arange(h) + 0.5) * resolution
        for (left, low, right, high), holds in self._solids():
            columns = slice(int(np.searchsorted(x, left)), int(np.searchsorted(x, right)))
            rows = slice(int(np.searchsorted(y, low)), int(np.searchsorted(y, high)))
            block = np.stack(np.meshgrid(x[columns], y[rows]), axis=-1)
            occupied[rows, columns] |= holds(block.reshape(-1, 2)).reshape(block.shape[:2])
        return occupied, x0, y0

    def reachable(self, resolution: float, radius: float) -> tuple[Bools, float, float]:
        """The floor that a disc of `radius` m covers from the start: a grid as from `occupied`."""
        occupied, x0, y0 = self.occupied(resolution)
        centres = self.centres(resolution, radius)[0]
        if not centres.any():
            return centres, x0, y0
        return (scipy.ndimage.distance_transform_edt(~centres) * resolution <= radius) & ~occupied, x0, y0

    def centres(self, resolution: float, radius: float) -> tuple[Bools, float, float]:
        """Where the middle of a disc of `radius` m can get from the start: a grid as from `occupied`."""
        occupied, x0, y0 = self.occupied(resolution)
        walled = np.pad(occupied, 1, constant_values=True)
        room = scipy.ndimage.distance_transform_edt(~walled)[1:-1, 1:-1] * resolution
        islands, _ = scipy.ndimage.label(room > radius)
        row, column = int((self.start.y - y0) // resolution), int((self.start.x - x0) // resolution)
        h, w = occupied.shape
        if not (0 <= row < h and 0 <= column < w) or islands[row, column] == 0:
            return np.zeros_like(occupied), x0, y0
        return np.asarray(islands == islands[row, column]), x0, y0

    def outline(self) -> Float64s:
        """(n, 4) m: segments to draw: polygons, circles as 24-gons, the edges of solid cells."""
        turn = np.linspace(0, 2 * pi, 25)
        unit = np.column_stack((np.cos(turn), np.sin(turn)))
        rows = [self.segments]
        for x, y, r in self.circles:
            ring = (x, y) + r * unit
            rows.append(np.hstack((ring[:-1], ring[1:])))
        if self.raster is not None:
            rows.append(_edges(self.raster))
        return np.concatenate(rows)


def _edges(raster: Raster) -> Float64s:
    """(n, 4) m: the sides of cells that part solid from free."""
    solid, size = np.pad(raster.solid, 1), raster.resolution
    rows, columns = np.nonzero(solid[1:, 1:] != solid[:-1, 1:])
    flat = np.column_stack((columns, rows, columns + 1, rows)).astype(float)
    rows, columns = np.nonzero(solid[1:, 1:] != solid[1:, :-1])
    upright = np.column_stack((columns, rows, columns, rows + 1)).astype(float)
    corner = np.array([raster.x0, raster.y0, raster.x0, raster.y0])
    return np.asarray(np.concatenate((flat, upright)) * size + corner)
