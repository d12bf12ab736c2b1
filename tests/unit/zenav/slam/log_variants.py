# SPDX-License-Identifier: Apache-2.0
"""Copies of a log as worse robots would have written it. How much of a mapper's result on that log was luck?

    python -m tests.unit.zenav.slam.log_variants NAME.log.gz DIR noise,odometry 8
    zenav bench slam DIR

A reference NAME.relations or NAME.ref.tum beside the log is copied with each.

| kind | what changes |
| --- | --- |
| noise | 3 mm on each range: less than the steps of most lasers of these logs |
| coarse | 2 cm on each range |
| short | ranges over 6.5, 8 or 10 m see nothing, in turn |
| narrow | the outer beams see nothing; 60, 75 or 90 degrees remain of 180 |
| odometry | 5 % too long, 5 % too little turn, a drift of 0.02 rad per m, and noise as large as each |
| jumps | once in 40 m, odometry jumps by 0.8 m and about 0.2 rad |
| mount | the laser is 0.3 m ahead of, 0.3 m behind or 0.2 m beside the place that the log says, in turn |
| late | odometry has the pose of 0.3, 0.64 or 0.9 s before, in turn |
"""

import gzip
import shutil
import sys
from collections import deque
from collections.abc import Callable
from math import cos, hypot, pi, sin
from pathlib import Path

import numpy as np
from numpy.random import Generator

from shared.geometry import Pose2, interpolated
from zenav.slam.slam_error import SUFFIXES

MAX_RANGE_M = 30.0  # a larger range may be that of no return
NO_RETURN_M, NO_BEAM_M = 81.83, 0.0
LATE, LAGS_S = "late", (0.3, 0.64, 0.9)
MOUNT, LASERS = "mount", (Pose2(0.3, 0, 0), Pose2(-0.3, 0, 0), Pose2(0, 0.2, 0))  # of the pose that the log has
FIRST_RANGE = {"FLASER": 2, "ROBOTLASER1": 9}  # word of a line; the one before it is the number of ranges
TO_STAMP = {"ODOM": 6, "FLASER": 3, "ROBOTLASER1": 8}  # words from odometry's pose

Ranges = Callable[[list[float], int, Generator], list[float]]
Step = Callable[[Pose2, Generator], Pose2]


def with_noise(sigma: float) -> Ranges:
    """Noise of a standard deviation, m, on each range."""

    def change(ranges: list[float], _seed: int, rng: Generator) -> list[float]:
        return [max(0.0, r + rng.normal(0, sigma)) if r < MAX_RANGE_M else r for r in ranges]

    return change


def shortened(ranges: list[float], seed: int, _rng: Generator) -> list[float]:
    limit = (6.5, 8.0, 10.0)[seed % 3]
    return [r if r <= limit else NO_RETURN_M for r in ranges]


def narrowed(ranges: list[float], seed: int, _rng: Generator) -> list[float]:
    share, n = (60, 75, 90)[seed % 3] / 180, len(ranges)
    return [r if abs(k / (n - 1) - 0.5) <= share / 2 else NO_BEAM_M for k, r in enumerate(ranges)]


def drifting(step: Pose2, rng: Generator) -> Pose2:
    path = hypot(step.x, step.y)
    forward, turn, drift = 1.05 + rng.normal(0, 0.05), 0.95 + rng.normal(0, 0.05), 0.02 + rng.normal(0, 0.02)
    return Pose2(forward * step.x, forward * step.y, turn * step.yaw + drift * path)


def jumping(step: Pose2, rng: Generator) -> Pose2:
    if rng.random() >= hypot(step.x, step.y) / 40:
        return step
    heading = rng.uniform(-pi, pi)
    return step @ Pose2(0.8 * cos(heading), 0.8 * sin(heading), rng.normal(0, 0.2))


RANGES: dict[str, Ranges] = {
    "noise": with_noise(0.003), "coarse": with_noise(0.02), "short": shortened, "narrow": narrowed,
}  # fmt: skip
STEPS: dict[str, Step] = {"odometry": drifting, "jumps": jumping}


class Variant:
    """Changes the lines of a CARMEN log, in their order."""

    def __init__(self, kind: str, seed: int) -> None:
        self.kind, self.seed = kind, seed
        self.rng = np.random.default_rng(seed)
        self.measured: Pose2 | None = None  # of the last line
        self.changed = Pose2()
        self.recent: deque[tuple[float, Pose2]] = deque()  # s; poses by odometry, from that which a late one is at

    def line(self, line: str) -> str:
        """The next line."""
        words = line.split(" ")
        if self.kind in RANGES and words[0] in FIRST_RANGE:
            first = FIRST_RANGE[words[0]]
            end = first + int(words[first - 1])
            ranges = [float(word) for word in words[first:end]]
            changed = RANGES[self.kind](ranges, self.seed, self.rng)
            words[first:end] = [
                word if after == before else f"{after:.3f}"
                for word, before, after in zip(words[first:end], ranges, changed)
            ]
        if (self.kind in (LATE, MOUNT) or self.kind in STEPS) and words[0] in TO_STAMP:
            self._move(words)
        return " ".join(words)

    def _move(self, words: list[str]) -> None:
        """Changes odometry's pose of a line, and the laser's, which is at the same place in these logs."""
        at = self._pose_word(words)
        measured = Pose2(*(float(word) for word in words[at : at + 3]))
        if self.kind == LATE:
            self.changed = self._late(float(words[at + TO_STAMP[words[0]]]), measured)
        elif self.kind == MOUNT:
            self.changed = measured @ LASERS[(self.seed - 1) % len(LASERS)].inverse()
        elif self.measured is None:
            self.changed = measured
        else:
            self.changed = self.changed @ STEPS[self.kind](self.measured.inverse() @ measured, self.rng)
        self.measured = measured
        pose = [f"{value:.6f}" for value in (self.changed.x, self.changed.y, self.changed.yaw)]
        words[at : at + 3] = pose
        if words[0] != "ODOM":
            words[at - 3 : at] = pose

    def _late(self, stamp: float, measured: Pose2) -> Pose2:
        """Adds a pose. Returns that of some time before it, or the first one. stamp: s."""
        self.recent.append((stamp, measured))
        late = stamp - LAGS_S[(self.seed - 1) % len(LAGS_S)]
        while len(self.recent) > 1 and self.recent[1][0] <= late:
            self.recent.popleft()
        (before, a), (after, b) = self.recent[0], self.recent[min(1, len(self.recent) - 1)]
        return interpolated(a, b, (late - before) / (after - before)) if before < late < after else a

    @staticmethod
    def _pose_word(words: list[str]) -> int:
        """Index of the first word of odometry's pose."""
        if words[0] == "ODOM":
            return 1
        end = FIRST_RANGE[words[0]] + int(words[FIRST_RANGE[words[0]] - 1])
        n_remissions = 0 if words[0] == "FLASER" else 1 + int(words[end])
        return end + n_remissions + 3


def write_variants(log: Path, folder: Path, kind: str, n: int) -> None:
    """Writes copies 1 to n of a kind, each with its own seed, and the reference beside each."""
    name = log.name.removesuffix(".log.gz")
    folder.mkdir(parents=True, exist_ok=True)
    for seed in range(1, n + 1):
        variant, copy = Variant(kind, seed), f"{name}-{kind}-{seed}"
        with gzip.open(log, "rt") as lines, gzip.open(folder / f"{copy}.log.gz", "wt", compresslevel=1) as out:
            out.writelines(variant.line(line) for line in lines)
        for suffix in SUFFIXES:
            if (reference := log.parent / f"{name}{suffix}").exists():
                shutil.copy(reference, folder / f"{copy}{suffix}")


if __name__ == "__main__":
    for one in sys.argv[3].split(","):
        write_variants(Path(sys.argv[1]), Path(sys.argv[2]), one, int(sys.argv[4]))
