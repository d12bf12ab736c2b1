# SPDX-License-Identifier: Apache-2.0
"""The rolling local costmap in `odom`: obstacles marked and cleared by scan and range sensors, with the static map
below.

The layers are those of Nav2's costmap: obstacle layer, range sensor layer, static layer. Unlike there, a cell counts
evidence, and forgets an obstacle out of sight after a time.
"""

from math import ceil, cos, floor, hypot, inf, pi, sin
from typing import Any, ClassVar

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from services.local_ctrl.dynamic_obstacles import DynamicObstaclesConfig, TrackersByLaser
from services.local_ctrl.footprint import Footprint
from shared import topics
from shared.config import Mount, Section
from shared.distance_field import distance_field_into
from shared.geometry import Pose2
from shared.grid import FREE_UP_TO, OCCUPIED_FROM, OccupancyGrid
from shared.messages import LaserScan, RangeReadings
from shared.polygon_kernels import contains_point
from shared.types import Bools, Float32s, Float64s, Int8s, Int64s

HIT_EVIDENCE, PASS_EVIDENCE, NO_ECHO_EVIDENCE = 4, 2, 1
"""Evidence of an obstacle: a hit sets the first. A beam beyond, and one without echo, subtract the others a scan."""
MAX_DISTANCE_M = 20.0  # of the distance field: keeps it finite


class CostmapConfig(Section):
    """The rolling local costmap."""

    RENAMED: ClassVar[dict[str, str]] = {"movers": "dynamic_obstacles"}

    resolution: float = Field(0.05, ge=0.02, le=0.2, description="m a cell")
    memory: float = Field(10.0, ge=0.2, le=120, description="s that an obstacle out of sight is remembered")
    echo_memory: float = Field(2.0, ge=0.2, le=60, description="s that an echo of ultrasonic or infrared is remembered")
    no_echo_clears: float = Field(3.0, ge=0, le=50, description="m of a laser beam without echo that count as free")
    scan: bool = Field(True, description="mark and clear by the laser scan")
    ultrasonic: bool = Field(
        True, description="mark echoes of ultrasonic sensors without a laser obstacle, such as glass"
    )
    infrared: bool = Field(True, description="mark echoes of infrared sensors without a laser obstacle")
    dynamic_obstacles: DynamicObstaclesConfig = DynamicObstaclesConfig()
    static_map: bool = Field(True, description="use obstacles of the map where the laser has no recent view")


class LocalCostmap:
    """(n, n) cells; `x0`, `y0` m in `odom` are the centre of the lower left one. Times are ns, 0 is never."""

    def __init__(self, config: CostmapConfig, reach: float, latency: float = 0.0) -> None:
        """reach: m around the robot that the window must hold. latency: s from now until a command acts."""
        self.config, self.latency = config, int(latency * 1e9)
        self.resolution = config.resolution
        n = 2 * ceil(reach / config.resolution)
        self.row, self.column = 0, 0  # of the lower left cell, counted from odom's origin
        self.evidence: Int8s = np.zeros((n, n), np.int8)
        self.hit_at: Int64s = np.zeros((n, n), np.int64)
        self.free_at: Int64s = np.zeros((n, n), np.int64)
        self.echo_at: Int64s = np.zeros((n, n), np.int64)
        self.static: Int8s = np.full((n, n), -1, np.int8)
        self.occupied: Bools = np.zeros((n, n), bool)
        self.unknown: Bools = np.ones((n, n), bool)
        self.forbidden_cells: Bools | None = None  # (n, n) by keep-out zones
        self.field: Float32s = np.full((n, n), MAX_DISTANCE_M, np.float32)
        self.dynamic_obstacles = TrackersByLaser(config.dynamic_obstacles)
        self.moving_discs: Float64s = self.dynamic_obstacles.discs(0)  # (k, 6) in `odom`, when a command acts

    def configure(self, config: CostmapConfig) -> None:
        """Takes settings, but for the size of the window and its cells. Content stays until it is too old."""
        self.config = config
        self.dynamic_obstacles.configure(config.dynamic_obstacles)

    @property
    def x0(self) -> float:
        """m in `odom`, centre of the lower left cell."""
        return (self.column + 0.5) * self.resolution

    @property
    def y0(self) -> float:
        """m in `odom`, centre of the lower left cell."""
        return (self.row + 0.5) * self.resolution

    def recentre(self, x: float, y: float) -> None:
        """Moves the window so that (x, y) m in `odom` lies at its centre. Cells that leave it are lost."""
        n = len(self.evidence)
        row, column = floor(y / self.resolution) - n // 2, floor(x / self.resolution) - n // 2
        up, right = row - self.row, column - self.column
        if up == 0 and right == 0:
            return
        self.row, self.column = row, column
        up, right = max(-n, min(n, up)), max(-n, min(n, right))
        self.evidence = _shifted_cells(self.evidence, up, right, 0)
        self.hit_at = _shifted_cells(self.hit_at, up, right, 0)
        self.free_at = _shifted_cells(self.free_at, up, right, 0)
        self.echo_at = _shifted_cells(self.echo_at, up, right, 0)
        self.static = _shifted_cells(self.static, up, right, -1)
        self.occupied = _shifted_cells(self.occupied, up, right, False)

    def clear(self) -> None:
        """Clears everything that scans and range sensors marked."""
        for layer in (self.evidence, self.hit_at, self.free_at, self.echo_at):
            layer.fill(0)
        self.dynamic_obstacles.clear()

    def add_scan(self, scan: LaserScan, odom_from_base: Float64s, mount: Mount, key: str = topics.SCAN.key) -> None:
        """Marks the ends of beams and clears the cells before them.

        odom_from_base: (n, 3) float64 x, y, yaw at each beam.  mount: of the laser.  key: of its topic.
        """
        if self.config.scan:
            touched = np.zeros(self.evidence.shape, np.int8)
            ends = np.full((len(scan.ranges), 2), np.nan)
            window = self.x0, self.y0, self.resolution
            _trace(
                touched,
                window,
                odom_from_base,
                (mount.x, mount.y, mount.yaw + scan.angle_min, scan.angle_increment),
                np.array(scan.ranges, np.float32),  # the message's may be read-only: another type to the kernel
                (scan.range_min, scan.range_max, self.config.no_echo_clears),
                ends,
            )
            outline = ends if scan.angle_increment > 0 else np.ascontiguousarray(ends[::-1])  # counter-clockwise
            eye = float(odom_from_base[-1, 0]), float(odom_from_base[-1, 1])
            self.dynamic_obstacles.by_key[key].add_scan(outline, eye, scan.stamp, self.free_at, window)
            _update_evidence(touched, scan.stamp, self.evidence, self.hit_at, self.free_at)
            _clear_discs(self.evidence, self.dynamic_obstacles.discs(scan.stamp), window)  # controllers predict them

    def add_ranges(self, readings: RangeReadings, odom_from_base: Pose2, wanted: Bools, limits: Float64s) -> None:
        """Marks the arc of each echo unless a known obstacle explains it, and clears the cone before it.

        odom_from_base: at the readings' stamp. wanted: (n,) bool, the sensors in use. limits: (n, 2) m, their least and
        largest range.
        """
        _mark_echoes(
            self.echo_at,
            self.occupied,
            (self.x0, self.y0, self.resolution),
            (odom_from_base.x, odom_from_base.y, odom_from_base.yaw),
            np.column_stack((readings.x, readings.y, readings.yaw, readings.field_of_view, readings.ranges)).astype(
                float
            ),
            wanted,
            limits,
            readings.stamp,
        )

    def set_static_map(self, grid: OccupancyGrid, odom_from_map: Pose2) -> None:
        """Projects the map into the window; an empty grid clears it. odom_from_map: present pose of `map` in `odom`."""
        self.static.fill(-1)
        if self.config.static_map and not grid.empty:
            _project_map(
                self.static,
                (self.x0, self.y0, self.resolution),
                grid.cells,
                (grid.x0, grid.y0, grid.resolution),
                (odom_from_map.x, odom_from_map.y, odom_from_map.yaw),
            )

    def refresh(self, now: int, here: Pose2, footprint: Footprint) -> None:
        """Updates `occupied`, `unknown`, the distance field and the discs. The robot's outline at `here`, in `odom`,
        is free.
        """
        _update_occupancy(
            (now - int(self.config.memory * 1e9), now - int(self.config.echo_memory * 1e9)),
            self.evidence,
            self.hit_at,
            self.free_at,
            self.echo_at,
            self.static,
            self.occupied,
            self.unknown,
        )
        if self.forbidden_cells is not None:
            self.occupied |= self.forbidden_cells
        pose = (here.x - self.x0, here.y - self.y0, cos(here.yaw), sin(here.yaw))
        _clear_footprint(self.evidence, self.echo_at, self.occupied, self.resolution, pose, footprint)
        distance_field_into(self.occupied, self.resolution, self.field)
        np.minimum(self.field, np.float32(MAX_DISTANCE_M), out=self.field)
        self.moving_discs = self.dynamic_obstacles.discs(now + self.latency)


@njit(cache=True, nogil=True)
def _shifted_cells(cells: NDArray[Any], up: int, right: int, empty: int) -> NDArray[Any]:
    out = np.full_like(cells, empty)
    n = len(cells)
    low, high = max(0, -right), min(n, n - right)
    for row in range(max(0, -up), min(n, n - up)):
        out[row, low:high] = cells[row + up, low + right : high + right]
    return out


@njit(cache=True, nogil=True)
def _trace(
    touched: Int8s,
    window: tuple[float, float, float],
    odom_from_base: Float64s,
    beams: tuple[float, float, float, float],
    ranges: Float32s,
    limits: tuple[float, float, float],
    ends: Float64s,
) -> None:
    """Sets each cell to the strongest of HIT_EVIDENCE, PASS_EVIDENCE, NO_ECHO_EVIDENCE, 0 (Amanatides and Woo 1987).

    ends: (n, 2) m in `odom`, the echoes within the window.
    """
    x0, y0, resolution = window
    mount_x, mount_y, first, increment = beams
    range_min, range_max, no_echo_clears = limits
    n = len(touched)
    for i in range(len(ranges)):
        x, y, yaw = odom_from_base[i]
        c, s = cos(yaw), sin(yaw)
        x, y = x + c * mount_x - s * mount_y, y + s * mount_x + c * mount_y
        direction = yaw + first + i * increment
        dx, dy = cos(direction), sin(direction)
        hit = range_min <= ranges[i] <= range_max
        if hit:
            # the last cell before the hit stays: at a grazing angle it may hold the same wall
            length, mark = ranges[i] - resolution, np.int8(PASS_EVIDENCE)
        elif np.isnan(ranges[i]) or ranges[i] > range_max:
            length, mark = min(range_max, no_echo_clears), np.int8(NO_ECHO_EVIDENCE)
        else:
            continue
        column, row = floor((x - x0) / resolution + 0.5), floor((y - y0) / resolution + 0.5)
        right, up = 1 if dx > 0 else -1, 1 if dy > 0 else -1
        step_x = resolution / abs(dx) if dx != 0.0 else inf
        step_y = resolution / abs(dy) if dy != 0.0 else inf
        next_x = (x0 + (column + 0.5 * right) * resolution - x) / dx if dx != 0.0 else inf
        next_y = (y0 + (row + 0.5 * up) * resolution - y) / dy if dy != 0.0 else inf
        at = 0.0
        while at < length and 0 <= row < n and 0 <= column < n:
            touched[row, column] = max(touched[row, column], mark)
            if next_x < next_y:
                at, next_x, column = next_x, next_x + step_x, column + right
            else:
                at, next_y, row = next_y, next_y + step_y, row + up
        if hit:
            column = floor((x + ranges[i] * dx - x0) / resolution + 0.5)
            row = floor((y + ranges[i] * dy - y0) / resolution + 0.5)
            if 0 <= row < n and 0 <= column < n:
                touched[row, column] = HIT_EVIDENCE
                ends[i, 0], ends[i, 1] = x + ranges[i] * dx, y + ranges[i] * dy


@njit(cache=True, nogil=True)
def _clear_discs(evidence: Int8s, discs: Float64s, window: tuple[float, float, float]) -> None:
    n = len(evidence)
    for k in range(len(discs)):
        x, y, reach = discs[k, 0] - window[0], discs[k, 1] - window[1], discs[k, 4] + DISC_MARGIN_M
        for row in range(max(0, ceil((y - reach) / window[2])), min(n, int((y + reach) / window[2]) + 1)):
            for column in range(max(0, ceil((x - reach) / window[2])), min(n, int((x + reach) / window[2]) + 1)):
                if hypot(column * window[2] - x, row * window[2] - y) <= reach:
                    evidence[row, column] = 0


DISC_MARGIN_M = 0.1  # around a dynamic obstacle that is cleared with it


@njit(cache=True, nogil=True)
def _update_evidence(touched: Int8s, stamp: int, evidence: Int8s, hit_at: Int64s, free_at: Int64s) -> None:
    n = len(touched)
    for row in range(n):
        for column in range(n):
            mark = touched[row, column]
            if mark == HIT_EVIDENCE:
                evidence[row, column], hit_at[row, column] = HIT_EVIDENCE, stamp
            elif mark != 0:
                evidence[row, column] = max(0, evidence[row, column] - mark)
                if mark == PASS_EVIDENCE:
                    free_at[row, column] = stamp


@njit(cache=True, nogil=True)
def _mark_echoes(
    echo_at: Int64s,
    occupied: Bools,
    window: tuple[float, float, float],
    odom_from_base: tuple[float, float, float],
    sensors: Float64s,
    wanted: Bools,
    limits: Float64s,
    stamp: int,
) -> None:
    x0, y0, resolution = window
    c, s = cos(odom_from_base[2]), sin(odom_from_base[2])
    n = len(echo_at)
    for i in range(len(sensors)):
        if not wanted[i]:
            continue
        x = odom_from_base[0] + c * sensors[i, 0] - s * sensors[i, 1]
        y = odom_from_base[1] + s * sensors[i, 0] + c * sensors[i, 1]
        axis, half, measured = odom_from_base[2] + sensors[i, 2], 0.5 * sensors[i, 3], sensors[i, 4]
        if measured < limits[i, 0]:
            continue
        echo = measured <= limits[i, 1]  # NaN is none: then the cone is clear to its end
        reach = measured if echo else limits[i, 1]
        first_row, last_row = int((y - y0 - reach) / resolution) - 2, int((y - y0 + reach) / resolution) + 3
        first_column, last_column = int((x - x0 - reach) / resolution) - 2, int((x - x0 + reach) / resolution) + 3
        first_row, last_row = max(0, first_row), min(n, last_row)
        first_column, last_column = max(0, first_column), min(n, last_column)
        explained = False
        for marking in (False, True):
            if marking and (explained or not echo):
                break
            for row in range(first_row, last_row):
                for column in range(first_column, last_column):
                    dx, dy = x0 + column * resolution - x, y0 + row * resolution - y
                    away = hypot(dx, dy)
                    if away > reach + ECHO_MATCH_M or away < 1e-6:
                        continue
                    off = abs((np.arctan2(dy, dx) - axis + pi) % (2.0 * pi) - pi)
                    # a cell belongs to the cone where its square does
                    if off > half + 0.5 * resolution / away:
                        continue
                    if marking:
                        if abs(away - measured) <= 0.5 * resolution:
                            echo_at[row, column] = stamp
                    elif away < reach - resolution and (echo or away > limits[i, 0] + NEAR_MARGIN_M):
                        echo_at[row, column] = 0
                    elif echo and occupied[row, column] and echo_at[row, column] == 0:
                        explained = explained or abs(away - measured) <= ECHO_MATCH_M


ECHO_MATCH_M = 0.15  # from an echo within which a laser obstacle explains it
NEAR_MARGIN_M = 0.08  # beyond a sensor's least range, within which no echo does not show that an obstacle has gone


@njit(cache=True, nogil=True)
def _project_map(
    static: Int8s,
    window: tuple[float, float, float],
    cells: Int8s,
    grid: tuple[float, float, float],
    odom_from_map: tuple[float, float, float],
) -> None:
    """Copies each map cell near the window into the window's cell at its centre, so that no thin wall is lost."""
    x0, y0, resolution = window
    n = len(static)
    h, w = cells.shape
    c, s = cos(odom_from_map[2]), sin(odom_from_map[2])
    middle_x, middle_y = x0 + 0.5 * n * resolution - odom_from_map[0], y0 + 0.5 * n * resolution - odom_from_map[1]
    centre_column = (c * middle_x + s * middle_y - grid[0]) / grid[2]
    centre_row = (c * middle_y - s * middle_x - grid[1]) / grid[2]
    reach = 0.75 * n * resolution / grid[2] + 2.0  # half a diagonal
    for row in range(int(max(0.0, centre_row - reach)), int(min(float(h), centre_row + reach))):
        for column in range(int(max(0.0, centre_column - reach)), int(min(float(w), centre_column + reach))):
            cell = cells[row, column]
            if cell < 0 or FREE_UP_TO < cell < OCCUPIED_FROM:
                continue
            x, y = grid[0] + (column + 0.5) * grid[2], grid[1] + (row + 0.5) * grid[2]
            i = floor((odom_from_map[1] + s * x + c * y - y0) / resolution + 0.5)
            j = floor((odom_from_map[0] + c * x - s * y - x0) / resolution + 0.5)
            if 0 <= i < n and 0 <= j < n:
                static[i, j] = max(static[i, j], np.int8(1 if cell >= OCCUPIED_FROM else 0))


@njit(cache=True, nogil=True)
def _update_occupancy(
    oldest: tuple[int, int],
    evidence: Int8s,
    hit_at: Int64s,
    free_at: Int64s,
    echo_at: Int64s,
    static: Int8s,
    occupied: Bools,
    unknown: Bools,
) -> None:
    n = len(evidence)
    for row in range(n):
        for column in range(n):
            seen_free = free_at[row, column] > max(0, oldest[0])
            hit = evidence[row, column] > 0 and hit_at[row, column] > oldest[0]
            echo = echo_at[row, column] > max(0, oldest[1])
            wall = static[row, column] == 1 and not seen_free
            occupied[row, column] = hit or echo or wall
            unknown[row, column] = static[row, column] < 0 and not seen_free and not hit


@njit(cache=True, nogil=True)
def _clear_footprint(
    evidence: Int8s,
    echo_at: Int64s,
    occupied: Bools,
    resolution: float,
    pose: tuple[float, float, float, float],
    footprint: Footprint,
) -> None:
    x, y, c, s = pose
    n = len(evidence)
    reach = footprint.circumscribed
    for row in range(max(0, int((y - reach) / resolution)), min(n, int((y + reach) / resolution) + 2)):
        for column in range(max(0, int((x - reach) / resolution)), min(n, int((x + reach) / resolution) + 2)):
            dx, dy = column * resolution - x, row * resolution - y
            if occupied[row, column] and contains_point(footprint.corners, c * dx + s * dy, c * dy - s * dx):
                evidence[row, column], echo_at[row, column], occupied[row, column] = 0, 0, False
