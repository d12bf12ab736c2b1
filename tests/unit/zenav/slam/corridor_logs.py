# SPDX-License-Identifier: Apache-2.0
"""Logs of a made-up building of similar corridors, 1.75 km of driving, with the true trajectory beside each.

    python -m tests.unit.zenav.slam.corridor_logs DIR dark 5 6 7 8 9
    zenav bench slam DIR

Corridors of 2.4 m form a grid of 150 m by 84 m. They have a door about every 4 m, and few other marks. Odometry has an
error of about 1 %, and 2 % of turns. The laser has 181 beams over 180 degrees, and noise of 1 cm.

| kind | what is hard, beside that |
| --- | --- |
| plain | nothing |
| drift | odometry is 5 % too long, and turns by 0.012 rad more on each metre |
| slip | once in 400 scans, wheels slip for 1 to 3 s |
| sparse | a scan each 0.7 m |
| people | four of them accompany the robot |
| glass | most beams pass through three walls of ten |
| dark | the laser sees nothing for 12 s, five times |
"""

import gzip
import sys
from itertools import pairwise
from math import atan2, ceil, cos, hypot, pi, sin
from pathlib import Path

import numpy as np
from numba import njit
from numpy.random import Generator

from shared.geometry import wrapped
from shared.types import Bools, Float64s, Int64s
from tests.unit.services.mapper.rooms import box

KINDS = "plain", "drift", "slip", "sparse", "people", "glass", "dark"
HALF_WIDTH_M = 1.2
XS, YS = 30.0 * np.arange(6), 28.0 * np.arange(4)
CROSSINGS = (
    (0, 0), (5, 0), (5, 3), (0, 3), (0, 1), (4, 1), (4, 3), (2, 3), (2, 0), (0, 0), (0, 2), (5, 2), (5, 0), (1, 0),
    (1, 3), (3, 3), (3, 1), (5, 1), (5, 3), (0, 3), (0, 0),
)  # fmt: skip
ANGLES = np.radians(np.arange(181) - 90.0)
RANGE_MAX_M = {"slip": 30.0}  # by kind
ORDINARY_RANGE_MAX_M, NO_RETURN_M = 50.0, 81.83
PERIOD_S, START_S = 0.2, 100.0


def wall(rng: Generator, a: tuple[float, float], b: tuple[float, float], out: tuple[int, int]) -> list[list[float]]:
    """A wall from a to b with doors. `out` is the direction of the rooms behind it."""
    start, length = np.array(a, float), hypot(b[0] - a[0], b[1] - a[1])
    along, outward = (np.array(b, float) - start) / length, np.array(out, float)
    segments, end, door = [], 0.0, 2.0
    while door + 1.0 < length - 1.5:
        depth = outward * (4.0 if rng.random() < 0.12 else 0.15)  # an open room, or the recess of a closed door
        left, right = start + along * door, start + along * (door + 0.95)
        segments += [[*(start + along * end), *left], [*left, *(left + depth)], [*right, *(right + depth)]]
        segments += [[*(left + depth), *(right + depth)]]
        end, door = door + 0.95, door + 4.0 + rng.uniform(-0.5, 0.5)
    return [*segments, [*(start + along * end), *b]]


def building(rng: Generator) -> Float64s:
    """Wall segments (n, 4), m."""
    w, segments = HALF_WIDTH_M, list[list[float]]()

    def room_walls(x0: float, x1: float, y0: float, y1: float, inward: int) -> None:
        segments.extend(wall(rng, (x0, y0), (x1, y0), (0, inward)))
        segments.extend(wall(rng, (x0, y1), (x1, y1), (0, -inward)))
        segments.extend(wall(rng, (x0, y0), (x0, y1), (inward, 0)))
        segments.extend(wall(rng, (x1, y0), (x1, y1), (-inward, 0)))

    for x0, x1 in pairwise(XS.tolist()):
        for y0, y1 in pairwise(YS.tolist()):
            room_walls(x0 + w, x1 - w, y0 + w, y1 - w, 1)
    room_walls(XS[0] - w, XS[-1] + w, YS[0] - w, YS[-1] + w, -1)
    for _ in range(25):  # a bench, where it is not at a crossing
        is_along_x = rng.random() < 0.5
        across, along = (YS, XS) if is_along_x else (XS, YS)
        middle = rng.choice(across) + rng.choice([-1, 1]) * (w - 0.25)
        begin = rng.uniform(2, along[-1] - 2)
        if abs(along - begin).min() >= 2.5:
            end = begin + rng.uniform(0.5, 1.8)
            low, high = middle - 0.2, middle + 0.2
            segments.extend(
                list(one) for one in box(*((begin, low, end, high) if is_along_x else (low, begin, high, end)))
            )
    return np.array(segments)


def trajectory() -> Float64s:
    """True poses (n, 3), one each scan: straight on with a slight swing, and turns on the spot."""
    points = [(float(XS[i]), float(YS[j])) for i, j in CROSSINGS]
    poses, yaw = [], atan2(points[1][1] - points[0][1], points[1][0] - points[0][0])
    for (x0, y0), (x1, y1) in pairwise(points):
        heading = atan2(y1 - y0, x1 - x0)
        turn = wrapped(heading - yaw)
        n_turns = ceil(abs(turn) / 0.12)
        poses += [(x0, y0, yaw + turn * (k + 1) / n_turns) for k in range(n_turns)]
        yaw, length = heading, hypot(x1 - x0, y1 - y0)
        n = int(length / 0.14)
        for share in ((k + 1) / n for k in range(n)):
            swing = 0.15 * sin(share * length / 4) * sin(pi * share)
            swing_turn = 0.15 / 4 * cos(share * length / 4) * sin(pi * share)
            x, y = x0 + (x1 - x0) * share - sin(heading) * swing, y0 + (y1 - y0) * share + cos(heading) * swing
            poses.append((x, y, heading + swing_turn))
    return np.array(poses)


@njit(cache=True, nogil=True)
def cast(segments: Float64s, x: float, y: float, angles: Float64s) -> tuple[Float64s, Int64s, Float64s]:
    """Ranges (n,) m along angles (n,), rows of the segments that they hit, and sines of the angles of incidence."""
    n = len(angles)
    ranges, hit, incidence = np.full(n, np.inf), np.zeros(n, np.int64), np.zeros(n)
    for k in range(n):
        c, s = cos(angles[k]), sin(angles[k])
        for row in range(len(segments)):
            x0, y0 = segments[row, 0] - x, segments[row, 1] - y
            along_x, along_y = segments[row, 2] - segments[row, 0], segments[row, 3] - segments[row, 1]
            cross = c * along_y - s * along_x
            if abs(cross) < 1e-12:
                continue
            t, u = (x0 * along_y - y0 * along_x) / cross, (x0 * s - y0 * c) / cross
            if t > 0 and 0 <= u <= 1 and t < ranges[k]:
                ranges[k], hit[k], incidence[k] = t, row, abs(cross) / hypot(along_x, along_y)
    return ranges, hit, incidence


class Wheels:
    """Odometry with errors of its own."""

    def __init__(self, kind: str, rng: Generator) -> None:
        self.kind, self.rng = kind, rng
        self.scale, self.turn_scale = 1 + rng.normal(0, 0.01), 1 + rng.normal(0, 0.02)
        self.bias = rng.normal(0, 0.002)  # rad per m
        if kind == "drift":
            self.scale, self.turn_scale, self.bias = 1.05, 0.95, 0.012 * rng.choice([-1, 1])
        self.n_slipping, self.slip, self.slip_turn = 0, 0.0, 0.0
        self.x = self.y = self.yaw = 0.0

    def drive(self, before: Float64s, after: Float64s) -> None:
        """Adds the motion between two true poses."""
        rng, (x0, y0, yaw0), (x1, y1, yaw1) = self.rng, before.tolist(), after.tolist()
        c, s = cos(yaw0), sin(yaw0)
        dx, dy, turn = c * (x1 - x0) + s * (y1 - y0), -s * (x1 - x0) + c * (y1 - y0), wrapped(yaw1 - yaw0)
        path = hypot(dx, dy)
        if self.kind == "slip":
            if self.n_slipping == 0 and rng.random() < 1 / 400:
                self.n_slipping, self.slip = int(rng.integers(5, 15)), rng.uniform(-0.8, 0.8)
                self.slip_turn = rng.normal(0, 0.03)
            if self.n_slipping > 0:
                self.n_slipping, dx, turn = self.n_slipping - 1, dx * (1 + self.slip), turn + self.slip_turn
        dx *= self.scale * (1 + rng.normal(0, 0.03))
        noise = rng.normal(0, 0.002 * (path / 0.14) ** 0.5 + 0.02 * abs(turn))
        turn = turn * self.turn_scale + self.bias * path + noise
        c, s = cos(self.yaw), sin(self.yaw)
        self.x, self.y, self.yaw = self.x + c * dx - s * dy, self.y + s * dx + c * dy, self.yaw + turn


def seen(kind: str, seed: int, k: int, rng: Generator, ranges: Float64s, through: Bools) -> Float64s:
    """Ranges (181,) m of the k-th scan as the laser measures them.  through: (181,) whether a beam passes glass."""
    measured = ranges + rng.normal(0, 0.01, len(ranges))
    if kind == "glass":
        measured[through & (rng.random(len(ranges)) < 0.9)] = NO_RETURN_M
    for person in range(4 if kind == "people" else 0):
        phase = 0.026 * k * (1 + person) + person * 1.7 + seed
        ahead, aside = 1.5 + 3.0 * abs(sin(phase * 0.7)), sin(phase * 1.3 + person)
        distance = hypot(ahead, aside)
        hit = np.abs(ANGLES - atan2(aside, ahead)) < 0.25 / distance
        measured[hit] = np.minimum(measured[hit], distance + rng.normal(0, 0.03, int(hit.sum())))
    if kind == "dark" and k // 400 % 6 == 5 and k % 400 < 60:
        measured[:] = NO_RETURN_M
    measured[ranges > RANGE_MAX_M.get(kind, ORDINARY_RANGE_MAX_M)] = NO_RETURN_M
    return measured


def write_log(folder: Path, kind: str, seed: int, n_scans: int | None = None) -> Path:
    """Writes a log and its reference, and returns the log's path.  n_scans: only the first ones."""
    rng = np.random.default_rng(seed)
    segments = building(rng)
    is_glass = rng.random(len(segments)) < (0.3 if kind == "glass" else 0.0)
    poses, wheels = trajectory()[:n_scans], Wheels(kind, rng)
    folder.mkdir(parents=True, exist_ok=True)
    log = folder / f"corridors-{kind}-{seed}.log.gz"
    with gzip.open(log, "wt", compresslevel=1) as out, (folder / f"corridors-{kind}-{seed}.ref.tum").open("w") as truth:
        for k, pose in enumerate(poses):
            wheels.drive(poses[max(k - 1, 0)], pose)
            if kind == "sparse" and k % 5:
                continue
            x, y, yaw = pose.tolist()
            ranges, hit, incidence = cast(segments, x, y, yaw + ANGLES)
            measured = seen(kind, seed, k, rng, ranges, is_glass[hit] & (incidence < 0.95))
            stamp = f"{START_S + PERIOD_S * k:.3f}"
            odometry = f"{wheels.x:.4f} {wheels.y:.4f} {wheels.yaw:.5f}"
            words = " ".join(f"{r:.2f}" for r in measured)
            out.write(f"ODOM {odometry} 0 0 0 {stamp} sim {stamp}\n")
            out.write(f"FLASER {len(measured)} {words} {odometry} {odometry} {stamp} sim {stamp}\n")
            truth.write(f"{stamp} {x:.4f} {y:.4f} 0 0 0 {sin(yaw / 2):.6f} {cos(yaw / 2):.6f}\n")
    return log


if __name__ == "__main__":
    if len(sys.argv) < 4 or sys.argv[2] not in KINDS or not all(word.isdigit() for word in sys.argv[3:]):
        sys.exit(f"give a folder, one of the kinds {', '.join(KINDS)}, and seeds: DIR dark 5 6 7")
    for one in sys.argv[3:]:
        write_log(Path(sys.argv[1]), sys.argv[2], int(one))
