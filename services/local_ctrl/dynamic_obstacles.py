# SPDX-License-Identifier: Apache-2.0
"""Tracking and prediction of dynamic obstacles: small objects that moved into space which was seen free.

Only cells that beams passed a moment ago count. An object that comes into view from behind another one, or is seen
from another side, is static. Each obstacle is a disc with constant turn rate and velocity (CTRV: Schubert et al.
2008); its turn rate decays. Objects that touch in the scan are separated at the notch between them.
"""

from collections import deque
from dataclasses import dataclass, field
from math import cos, hypot, inf, sin, sqrt
from typing import ClassVar

import numpy as np
from numba import njit
from pydantic import Field

from services.local_ctrl.rollout import DT
from shared.config import Section
from shared.lasers import SCAN_TOPICS
from shared.types import NS_PER_S, Float64s, Int64s

MAX_GAP_M = 0.25  # between the ends of neighbouring beams on one object
MIN_NOTCH_M = 0.045  # depth of a notch that separates two objects, below the outline NOTCH_SIDE_M to both sides
NOTCH_SIDE_M = 0.25  # m along the outline
MIN_BEAMS = 4  # on an object
FREE_MEMORY_S = 2.5  # time since its place was seen free
MIN_SHARE_IN_FREE = 0.4  # of its beams that end in such places
SHARE_GAIN = 0.3  # of the newest share in their mean
RIM_CELLS = 2  # to each side that must have been free too: cells at an object's rim may be both
MAX_ASSOCIATION_M = 0.4  # between a prediction and a detection
FIT_SPANS_S = 0.5, 0.3, 0.15  # of its track that give its velocity: the first one that fits an arc
MIN_SPAN_S = 0.15  # of a track
MAX_ARC_ERROR_M = 0.03  # root mean square distance of a track to its arc
MIN_POINTS_FOR_VELOCITY, MIN_POINTS_FOR_TURN_RATE = 3, 5  # from which a velocity is estimated, and a turn rate
MIN_TRAVEL_M = 0.08  # of a dynamic obstacle
MAX_CIRCLE_ERROR_M = 0.04  # root mean square distance of a disc's echoes to its rim
MAX_SPEED = 3.0  # m/s; faster ones are wrong associations
TURN_RATE_SIGMA = 0.5  # rad/s, prior standard deviation of turn rates
MAX_TURN_RATE = 1.5  # rad/s; faster turns do not last
MIN_POSITION_SIGMA_M = 0.01  # errors of neighbouring scans are correlated
HIDDEN_RADIUS_RATIO = 0.7  # visible half width over the radius, under which the object is partly hidden
MERGED_RADIUS_RATIO = 1.25  # visible half width over the radius, beyond which it is seen with another object
RADIUS_DECAY = 0.995  # of the radius per scan that shows too little to fit a circle
TURN_DECAY_S = 1.5  # time constant of a turn rate
X, Y, RADIUS, SHARE_IN_FREE, IS_ROUND = range(5)  # columns of `_segments`
Segment = tuple[float, float, float, float, float]  # a row


class DynamicObstaclesConfig(Section):
    """Dynamic obstacles."""

    RENAMED: ClassVar[dict[str, str]] = {"follow": "enabled", "least_speed": "min_speed", "largest": "max_size"}

    enabled: bool = Field(
        False, description="avoid the predicted places of dynamic obstacles, not only their present ones"
    )
    min_speed: float = Field(0.2, ge=0.05, le=5, description="m/s; slower objects count as static")
    max_size: float = Field(1.6, ge=0.1, le=5, description="m across; larger objects count as static")
    memory: float = Field(0.8, ge=0, le=5, description="s that an obstacle out of sight is predicted")


@dataclass(slots=True)
class DynamicObstacle:
    """One tracked object.

    `seen`: its places (ns, x m, y m). `radius`: m. Velocity (m/s) and turn rate (rad/s) are those of the last place,
    where they are known.
    """

    seen: deque[tuple[int, float, float]] = field(default_factory=lambda: deque(maxlen=64))
    radius: float = 0.0
    vx: float = 0.0
    vy: float = 0.0
    turn_rate: float = 0.0
    share_in_free: float = 1.0  # mean share of its beams that end where it was free
    moves: bool = False
    is_round: bool = False  # it was seen as a disc

    def at(self, now: int) -> tuple[float, float, float, float]:
        """x, y m and vx, vy m/s on its arc at `now`, ns."""
        stamp, x, y = self.seen[-1]
        elapsed = (now - stamp) / NS_PER_S
        half = 0.5 * self.turn_rate * elapsed
        vx, vy = rotated(self.vx, self.vy, half)
        return x + vx * elapsed, y + vy * elapsed, *rotated(vx, vy, half)

    def contains(self, segment: Segment) -> bool:
        """Whether a segment lies within the disc where it was last seen: another object before it splits its echoes."""
        _, x, y = self.seen[-1]
        return hypot(segment[X] - x, segment[Y] - y) < self.radius

    def is_hidden(self, segment: Segment) -> bool:
        """Whether a segment shows too little of the obstacle, or another object with it. Then the prediction
        continues.
        """
        less = not segment[IS_ROUND] and segment[RADIUS] < HIDDEN_RADIUS_RATIO * self.radius
        return self.moves and (less or (self.is_round and segment[RADIUS] > MERGED_RADIUS_RATIO * self.radius))

    def centre(self, segment: Segment, eye: tuple[float, float]) -> tuple[float, float]:
        """x, y m of its centre for a segment seen from `eye`: of a half hidden disc not the segment's."""
        x, y, radius, _, is_round = segment
        hidden = sqrt(max(self.radius**2 - radius**2, 0.0)) if not is_round else 0.0
        away = max(hypot(x - eye[0], y - eye[1]), 1e-6)
        return x + hidden * (x - eye[0]) / away, y + hidden * (y - eye[1]) / away

    def update(self, stamp: int, segment: Segment, eye: tuple[float, float], min_speed: float) -> None:
        """Takes the segment that shows it at `stamp` (ns), seen from `eye` (m): track, radius, velocity and class.

        min_speed: m/s, below which it counts as static.
        """
        _, _, radius, share, is_round = segment
        self.seen.append((stamp, *self.centre(segment, eye)))
        self.share_in_free += SHARE_GAIN * (share - self.share_in_free)
        self.is_round |= is_round > 0.0
        self.radius = max(radius, (0.9 if is_round else RADIUS_DECAY) * self.radius)
        while self.seen[0][0] < stamp - FIT_SPANS_S[0] * NS_PER_S:
            self.seen.popleft()
        t, xs, ys = np.array([((s - stamp) / NS_PER_S, a, b) for s, a, b in self.seen]).T
        if t[-1] - t[0] < MIN_SPAN_S:
            return
        for span in FIT_SPANS_S:
            lately = t >= -span - 0.001
            if lately.sum() < MIN_POINTS_FOR_VELOCITY:
                break
            self.vx, self.vy, self.turn_rate, off = _fitted_arc(t[lately], xs[lately], ys[lately])
            if off < MAX_ARC_ERROR_M:
                break
        speed = hypot(self.vx, self.vy)
        share_in_free = self.share_in_free >= MIN_SHARE_IN_FREE and hypot(xs[-1] - xs[0], ys[-1] - ys[0]) > MIN_TRAVEL_M
        # a moving obstacle stays one in a shadow, where no beam showed free space before
        self.moves = (share_in_free or self.moves) and min_speed < speed < MAX_SPEED


class DynamicObstacles:
    """Tracks all obstacles from scan to scan, in `odom`."""

    def __init__(self, config: DynamicObstaclesConfig) -> None:
        self.config = config
        self.all: list[DynamicObstacle] = []

    def clear(self) -> None:
        """Drops all tracks: odometry restarted."""
        self.all = []

    def add_scan(
        self,
        ends: Float64s,
        eye: tuple[float, float],
        stamp: int,
        free_at: Int64s,
        window: tuple[float, float, float],
    ) -> None:
        """Takes the ends of a scan's beams (n, 2), m in `odom`, counter-clockwise about `eye`, m; NaN without an echo.

        `stamp`: ns. `free_at`: (n, n) ns when each cell was last seen free before. `window`: x, y m of the centre of
        cell (0, 0), and m a cell.
        """
        if not self.config.enabled:
            return
        segments = _segments(ends, free_at, stamp - int(FREE_MEMORY_S * NS_PER_S), window, self.config.max_size / 2)
        predictions = [obstacle.at(stamp) for obstacle in self.all]
        taken: set[int] = set()
        for row in segments:
            segment: Segment = tuple(row.tolist())
            away = [inf] * len(predictions)
            for i, (obstacle, (x, y, _, _)) in enumerate(zip(self.all, predictions)):
                if i not in taken:
                    a, b = obstacle.centre(segment, eye)
                    away[i] = hypot(x - a, y - b)
            nearest = int(np.argmin(away)) if away else -1
            if nearest >= 0 and away[nearest] < MAX_ASSOCIATION_M:
                taken.add(nearest)
                if not self.all[nearest].is_hidden(segment):
                    self.all[nearest].update(stamp, segment, eye, self.config.min_speed)
            elif segment[SHARE_IN_FREE] >= MIN_SHARE_IN_FREE and not any(self.all[i].contains(segment) for i in taken):
                new = DynamicObstacle()
                new.update(stamp, segment, eye, self.config.min_speed)
                self.all.append(new)
        oldest = stamp - int(self.config.memory * NS_PER_S)
        self.all = [
            obstacle
            for obstacle in self.all
            if obstacle.seen[-1][0] >= (oldest if obstacle.moves else stamp - NS_PER_S // 5)
        ]

    def discs(self, now: int) -> Float64s:
        """(k, 6) x, y m in `odom`, vx, vy m/s, radius m, turn rate rad/s of the moving obstacles at `now`, ns."""
        rows = [(*obstacle.at(now), obstacle.radius, obstacle.turn_rate) for obstacle in self.all if obstacle.moves]
        return np.array(rows, float).reshape(-1, 6)


class TrackersByLaser:
    """One tracker for each laser, by the key of its topic: the scan of another laser does not show its objects.

    An object that two lasers see is two discs.
    """

    def __init__(self, config: DynamicObstaclesConfig) -> None:
        self.by_key = {topic.key: DynamicObstacles(config) for topic in SCAN_TOPICS}

    def configure(self, config: DynamicObstaclesConfig) -> None:
        """Takes settings. Tracks end where they disable tracking."""
        for tracker in self.by_key.values():
            tracker.config = config
        if not config.enabled:
            self.clear()

    def clear(self) -> None:
        """Drops all tracks."""
        for tracker in self.by_key.values():
            tracker.clear()

    def clear_square(self, x: float, y: float, side: float, outside: bool) -> None:
        """Clears the obstacles in a square about (x, y), m in `odom`, or all others. side: m."""
        for tracker in self.by_key.values():
            places = [obstacle.seen[-1][1:] for obstacle in tracker.all]
            inside = [max(abs(place[0] - x), abs(place[1] - y)) <= side / 2 for place in places]
            tracker.all = [obstacle for obstacle, is_inside in zip(tracker.all, inside) if is_inside == outside]

    def discs(self, now: int) -> Float64s:
        """(k, 6): the moving obstacles of all lasers at `now`, ns, as DynamicObstacles.discs."""
        return np.concatenate([tracker.discs(now) for tracker in self.by_key.values()])


def predicted_discs(discs: Float64s, steps: int) -> Float64s:
    """(steps, k, 3) x, y m, radius m of obstacles (k, 6), see DynamicObstacles.discs, after 1, 2, ... steps of DT.

    Each moves on an arc; its turn rate decays with TURN_DECAY_S, as it is known less well later.
    """
    after = DT * np.arange(1, steps + 1)[:, None]
    turned = discs[:, 5] * TURN_DECAY_S * (1.0 - np.exp(-(after - 0.5 * DT) / TURN_DECAY_S))
    heading = np.arctan2(discs[:, 3], discs[:, 2]) + turned
    speed = np.hypot(discs[:, 2], discs[:, 3])
    discs_at = np.empty((steps, len(discs), 3))
    discs_at[:, :, 0] = discs[:, 0] + np.cumsum(DT * speed * np.cos(heading), axis=0)
    discs_at[:, :, 1] = discs[:, 1] + np.cumsum(DT * speed * np.sin(heading), axis=0)
    discs_at[:, :, 2] = discs[:, 4]
    return discs_at


def rotated(x: float, y: float, angle: float) -> tuple[float, float]:
    """The vector (x, y) turned by an angle, rad."""
    c, s = cos(angle), sin(angle)
    return c * x - s * y, s * x + c * y


def _fitted_arc(t: Float64s, xs: Float64s, ys: Float64s) -> tuple[float, float, float, float]:
    """The arc of constant turn rate through places (xs, ys) m at times t (n,) s, by least squares.

    Returns the velocity (m/s) at the last time, the turn rate (rad/s) and the root mean square distance (m). The turn
    rate is the likeliest with the prior `TURN_RATE_SIGMA`, from the parabola over the straight line.
    """
    t, xs, ys = t - t.mean(), xs - xs.mean(), ys - ys.mean()
    squares = float(t @ t)
    vx, vy = float(t @ xs) / squares, float(t @ ys) / squares  # at the middle of that time
    xs, ys = xs - t * vx, ys - t * vy
    bow = t * t - (t * t).mean()
    bow -= t * float(t @ bow) / squares
    bowed = float(bow @ bow)
    if len(t) < MIN_POINTS_FOR_TURN_RATE or bowed < 1e-12:
        return vx, vy, 0.0, 0.0
    ax, ay = 2.0 * float(bow @ xs) / bowed, 2.0 * float(bow @ ys) / bowed
    off = float(((xs - 0.5 * ax * bow) ** 2 + (ys - 0.5 * ay * bow) ** 2).sum()) / (len(t) - 3)
    square = max(vx * vx + vy * vy, 1e-6)
    variance = 4.0 * max(off, MIN_POSITION_SIGMA_M**2) / bowed / square
    turn_rate = (vx * ay - vy * ax) / square * TURN_RATE_SIGMA**2 / (TURN_RATE_SIGMA**2 + variance)
    turn_rate = min(max(turn_rate, -MAX_TURN_RATE), MAX_TURN_RATE)
    off = float(((xs + 0.5 * turn_rate * vy * bow) ** 2 + (ys - 0.5 * turn_rate * vx * bow) ** 2).mean())
    return *rotated(vx, vy, float(t[-1]) * turn_rate), turn_rate, sqrt(off)


@njit(cache=True, nogil=True)
def _segments(
    ends: Float64s, free_at: Int64s, since: int, window: tuple[float, float, float], largest: float
) -> Float64s:
    """(k, 5) x, y, radius m, share of beams that end where it was free, 1 where a circle fits; at most `largest` m
    radius.
    """
    points = ends[~np.isnan(ends[:, 0])]
    n = len(points)
    depths = _notch_depths(points)
    out = np.empty((n, 5))
    n_out, begin = 0, 0
    for i in range(1, n + 1):
        notch = depths[i - 1] > MIN_NOTCH_M and depths[i - 1] >= max(depths[max(i - 2, 0)], depths[min(i, n - 1)])
        if i < n and _are_connected(points, i - 1, i) and not notch:
            continue
        if i - begin >= MIN_BEAMS:
            out[n_out] = _fitted_disc(points[begin:i], free_at, since, window)
            n_out += out[n_out, RADIUS] <= largest
        begin = i
    return out[:n_out]


@njit(cache=True, nogil=True)
def _notch_depths(points: Float64s) -> Float64s:
    """(n,) m that an outline (n, 2), counter-clockwise about the sensor, lies behind its neighbourhood.

    The mean of three neighbouring points reduces noise. -1 where the neighbourhood is too short.
    """
    n = len(points)
    depths = np.full(n, -1.0)
    smooth = np.empty_like(points)
    for i in range(n):
        low, high = max(i - 1, 0), min(i + 1, n - 1)
        if hypot(points[high, 0] - points[low, 0], points[high, 1] - points[low, 1]) > MAX_GAP_M:
            low = high = i
        for axis in range(2):
            smooth[i, axis] = points[low : high + 1, axis].mean()
    for i in range(n):
        before, after = i, i
        while before > 0 and _are_connected(points, before - 1, before) and not _is_far_along(smooth, before, i):
            before -= 1
        while after < n - 1 and _are_connected(points, after, after + 1) and not _is_far_along(smooth, after, i):
            after += 1
        dx, dy = smooth[after, 0] - smooth[before, 0], smooth[after, 1] - smooth[before, 1]
        if _is_far_along(smooth, before, i) and _is_far_along(smooth, after, i):
            across = dy * (smooth[i, 0] - smooth[before, 0]) - dx * (smooth[i, 1] - smooth[before, 1])
            depths[i] = across / max(hypot(dx, dy), 1e-6)
    return depths


@njit(cache=True, nogil=True)
def _are_connected(points: Float64s, i: int, j: int) -> bool:
    return hypot(points[i, 0] - points[j, 0], points[i, 1] - points[j, 1]) <= MAX_GAP_M


@njit(cache=True, nogil=True)
def _is_far_along(points: Float64s, i: int, j: int) -> bool:
    return hypot(points[i, 0] - points[j, 0], points[i, 1] - points[j, 1]) >= NOTCH_SIDE_M


@njit(cache=True, nogil=True)
def _fitted_disc(
    ends: Float64s, free_at: Int64s, since: int, window: tuple[float, float, float]
) -> tuple[float, float, float, float, float]:
    """The disc with a rim on the ends, else the one over their span: a row of `_segments`."""
    count, share_in_free = len(ends), 0
    mx, my = ends[:, 0].mean(), ends[:, 1].mean()
    first, last = ends[0], ends[-1]
    x, y = 0.5 * (first[0] + last[0]), 0.5 * (first[1] + last[1])
    radius = 0.0
    # a circle by least squares in its algebraic form (Kasa 1976)
    suu, svv, suv, suz, svz, sz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(count):
        share_in_free += _was_free(ends[i, 0], ends[i, 1], free_at, since, window)
        u, v = ends[i, 0] - mx, ends[i, 1] - my
        z = u * u + v * v
        suu, svv, suv, suz, svz, sz = suu + u * u, svv + v * v, suv + u * v, suz + u * z, svz + v * z, sz + z
        radius = max(radius, hypot(ends[i, 0] - x, ends[i, 1] - y))
    determinant = suu * svv - suv * suv
    if count >= 2 * MIN_BEAMS and determinant > 1e-9:
        a, b = (suz * svv - svz * suv) / (2 * determinant), (svz * suu - suz * suv) / (2 * determinant)
        fitted = sqrt(a * a + b * b + sz / count)
        off = 0.0
        for i in range(count):
            off += (hypot(ends[i, 0] - mx - a, ends[i, 1] - my - b) - fitted) ** 2
        if sqrt(off / count) < MAX_CIRCLE_ERROR_M and fitted < 2.0 * radius:
            return mx + a, my + b, fitted, share_in_free / count, 1.0
    return x, y, radius, share_in_free / count, 0.0


@njit(cache=True, nogil=True)
def _was_free(x: float, y: float, free_at: Int64s, since: int, window: tuple[float, float, float]) -> bool:
    """Whether the cell at (x, y) and its neighbours were seen free since then."""
    n = len(free_at)
    column, row = int(np.floor((x - window[0]) / window[2] + 0.5)), int(np.floor((y - window[1]) / window[2] + 0.5))
    if not (RIM_CELLS <= row < n - RIM_CELLS and RIM_CELLS <= column < n - RIM_CELLS):
        return False
    for i in range(row - RIM_CELLS, row + RIM_CELLS + 1):
        for j in range(column - RIM_CELLS, column + RIM_CELLS + 1):
            if free_at[i, j] <= max(since, 0):
                return False
    return True
