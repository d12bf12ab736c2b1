# SPDX-License-Identifier: Apache-2.0
"""What moves around the robot, and where it will be: small things that came into space that was seen free, followed.

Only what stands where a moment ago beams went through counts: what merely comes into sight behind something else, or is
seen from another side, does not move. Each is a disc with a constant velocity (Nair et al. 2022 call for no more).
"""

from collections import deque
from dataclasses import dataclass, field
from math import hypot, inf, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray
from pydantic import Field

from shared.config import Section

Int64s = NDArray[np.int64]
Float64s = NDArray[np.float64]

S = 1_000_000_000  # ns
BREAK = 0.25  # m between the ends of neighbouring beams that part two things
LEAST_BEAMS = 4  # that a thing is seen by
LATELY = 1.5  # s within which its place was seen free
CAME = 0.5  # share of its beams that end in such places
EASED = 0.3  # of the newest share in the mean of them
RIM_CELLS = 2  # to each side that must have been free too: at a thing's rim cells may be both
GATE = 0.4  # m off where it was expected that a thing may be found
SPAN = 0.5  # s of its way that tell its velocity
LEAST_SPAN = 0.15  # s that it must have been followed for
LEAST_WAY = 0.12  # m that it must have come
ROUND = 0.04  # m, root mean square, that a disc's echoes may lie off its rim
MOST_SPEED = 3.0  # m/s: what seems faster is a wrong pairing
X, Y, RADIUS, SHARE = range(4)  # columns of `_things`


class MoversConfig(Section):
    """What moves."""

    follow: bool = Field(False, description="keep off where things that move will be, not only off where they are")
    least_speed: float = Field(0.4, ge=0.05, le=5, description="m/s; what is slower is taken as standing")
    largest: float = Field(1.3, ge=0.1, le=5, description="m across; what is larger is taken as standing")
    memory: float = Field(0.8, ge=0, le=5, description="s that it is expected to go on while it is out of sight")


@dataclass(slots=True)
class Mover:
    """One thing: where it was seen lately (ns, x m, y m), its radius m, its velocity m/s where that is known."""

    seen: deque[tuple[int, float, float]] = field(default_factory=lambda: deque(maxlen=64))
    radius: float = 0.0
    vx: float = 0.0
    vy: float = 0.0
    came: float = 1.0  # mean share of its beams that end where it was free
    moves: bool = False

    def at(self, now: int) -> tuple[float, float]:
        stamp, x, y = self.seen[-1]
        elapsed = (now - stamp) / S
        return x + self.vx * elapsed, y + self.vy * elapsed

    def take(self, stamp: int, x: float, y: float, radius: float, share: float, least_speed: float) -> None:
        """It was seen there; share: of its beams that end where it was free."""
        self.seen.append((stamp, x, y))
        self.came += EASED * (share - self.came)
        self.radius = max(radius, 0.9 * self.radius)
        while self.seen[0][0] < stamp - SPAN * S:
            self.seen.popleft()
        t, xs, ys = np.array([((s - stamp) / S, a, b) for s, a, b in self.seen]).T
        if t[-1] - t[0] < LEAST_SPAN:
            return
        t = t - t.mean()
        self.vx, self.vy = float(t @ xs / (t @ t)), float(t @ ys / (t @ t))
        speed = hypot(self.vx, self.vy)
        came = self.came >= CAME and hypot(xs[-1] - xs[0], ys[-1] - ys[0]) > LEAST_WAY
        self.moves = came and least_speed < speed < MOST_SPEED


class Movers:
    """Follows them from scan to scan, in `odom`."""

    def __init__(self, config: MoversConfig) -> None:
        self.config = config
        self.all: list[Mover] = []

    def forget(self) -> None:
        """Odometry began anew."""
        self.all = []

    def see(self, ends: Float64s, stamp: int, free_at: Int64s, window: tuple[float, float, float]) -> None:
        """A scan's ends (n, 2) m in `odom`, NaN without one; free_at: when each cell was last seen free before it.

        window: x, y m of the middle of cell (0, 0), m a cell.
        """
        if not self.config.follow:
            return
        things = _things(ends, free_at, stamp - int(LATELY * S), window, self.config.largest / 2)
        expected = [mover.at(stamp) for mover in self.all]
        taken: set[int] = set()
        for x, y, radius, share in things.tolist():
            away = [inf if i in taken else hypot(x - a, y - b) for i, (a, b) in enumerate(expected)]
            nearest = int(np.argmin(away)) if away else -1
            if nearest >= 0 and away[nearest] < GATE:
                taken.add(nearest)
                self.all[nearest].take(stamp, x, y, radius, share, self.config.least_speed)
            elif share >= CAME:
                new = Mover()
                new.take(stamp, x, y, radius, share, self.config.least_speed)
                self.all.append(new)
        oldest = stamp - int(self.config.memory * S)
        self.all = [mover for mover in self.all if mover.seen[-1][0] >= (oldest if mover.moves else stamp - S // 5)]

    def discs(self, now: int) -> Float64s:
        """(k, 5) x, y m in `odom`, vx, vy m/s, radius m: all that move, as they are at `now`, ns."""
        rows = [(*mover.at(now), mover.vx, mover.vy, mover.radius) for mover in self.all if mover.moves]
        return np.array(rows, float).reshape(-1, 5)


@njit(cache=True, nogil=True)
def _things(
    ends: Float64s, free_at: Int64s, since: int, window: tuple[float, float, float], largest: float
) -> Float64s:
    """(k, 4) x, y, radius m and the share of beams that end where it was free: things of at most `largest` m radius."""
    out = np.empty((len(ends), 4))
    n_out, begin, n = 0, -1, len(ends)
    last = -1
    for i in range(n + 1):
        parts = i == n
        if i < n:
            if np.isnan(ends[i, 0]):
                continue
            parts = last >= 0 and hypot(ends[i, 0] - ends[last, 0], ends[i, 1] - ends[last, 1]) > BREAK
        if begin >= 0 and parts:
            x, y, radius, share, count = _thing(ends[begin : last + 1], free_at, since, window)
            if count >= LEAST_BEAMS and radius <= largest:
                out[n_out, X], out[n_out, Y], out[n_out, RADIUS], out[n_out, SHARE] = x, y, radius, share
                n_out += 1
            begin = -1
        if i < n:
            if begin < 0:
                begin = i
            last = i
    return out[:n_out]


@njit(cache=True, nogil=True)
def _thing(
    ends: Float64s, free_at: Int64s, since: int, window: tuple[float, float, float]
) -> tuple[float, float, float, float, int]:
    """The disc whose rim the ends lie on, else the one over their span; the share that came; how many there are."""
    count, came = 0, 0
    mx, my = 0.0, 0.0
    for i in range(len(ends)):
        if not np.isnan(ends[i, 0]):
            mx, my, count = mx + ends[i, 0], my + ends[i, 1], count + 1
            came += _was_free(ends[i, 0], ends[i, 1], free_at, since, window)
    mx, my = mx / count, my / count
    first, last = ends[0], ends[-1]
    x, y = 0.5 * (first[0] + last[0]), 0.5 * (first[1] + last[1])
    radius = 0.0
    # a circle by least squares in its algebraic form (Kasa 1976)
    suu, svv, suv, suz, svz, sz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(len(ends)):
        if not np.isnan(ends[i, 0]):
            u, v = ends[i, 0] - mx, ends[i, 1] - my
            z = u * u + v * v
            suu, svv, suv, suz, svz, sz = suu + u * u, svv + v * v, suv + u * v, suz + u * z, svz + v * z, sz + z
            radius = max(radius, hypot(ends[i, 0] - x, ends[i, 1] - y))
    determinant = suu * svv - suv * suv
    if count >= 2 * LEAST_BEAMS and determinant > 1e-9:
        a, b = (suz * svv - svz * suv) / (2 * determinant), (svz * suu - suz * suv) / (2 * determinant)
        fitted = sqrt(a * a + b * b + sz / count)
        off = 0.0
        for i in range(len(ends)):
            if not np.isnan(ends[i, 0]):
                off += (hypot(ends[i, 0] - mx - a, ends[i, 1] - my - b) - fitted) ** 2
        if sqrt(off / count) < ROUND and fitted < 2.0 * radius:
            return mx + a, my + b, fitted, came / count, count
    return x, y, radius, came / count, count


@njit(cache=True, nogil=True)
def _was_free(x: float, y: float, free_at: Int64s, since: int, window: tuple[float, float, float]) -> bool:
    """Whether the cell there and all around it were seen free since then."""
    n = len(free_at)
    column, row = int(np.floor((x - window[0]) / window[2] + 0.5)), int(np.floor((y - window[1]) / window[2] + 0.5))
    if not (RIM_CELLS <= row < n - RIM_CELLS and RIM_CELLS <= column < n - RIM_CELLS):
        return False
    for i in range(row - RIM_CELLS, row + RIM_CELLS + 1):
        for j in range(column - RIM_CELLS, column + RIM_CELLS + 1):
            if free_at[i, j] <= max(since, 0):
                return False
    return True
