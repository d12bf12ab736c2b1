# SPDX-License-Identifier: Apache-2.0
"""Copies of a log with a little noise on its ranges. How much of a mapper's result on that log was luck?

    python -m tests.unit.zenav.slam.noisy_logs NAME.log.gz DIR 8
    zenav bench slam DIR

A reference NAME.relations or NAME.ref.tum beside the log is copied with each.
"""

import gzip
import shutil
import sys
from pathlib import Path

import numpy as np

from zenav.slam.slam_error import SUFFIXES

SIGMA_M = 0.003  # less than the steps of most lasers of these logs
MAX_RANGE_M = 30.0  # a larger range may be that of no return
FIRST_RANGE = {"FLASER": 2, "ROBOTLASER1": 9}  # word of a line; the one before it is the number of ranges


def noisy_line(line: str, rng: np.random.Generator) -> str:
    """A line of a CARMEN log, with noise on the ranges of a scan."""
    words = line.split(" ")
    first = FIRST_RANGE.get(words[0])
    if first is None:
        return line
    for k in range(first, first + int(words[first - 1])):
        metres = float(words[k])
        if metres < MAX_RANGE_M:
            words[k] = f"{max(0.0, metres + rng.normal(0, SIGMA_M)):.3f}"
    return " ".join(words)


def write_noisy_logs(log: Path, folder: Path, n: int) -> None:
    """Writes copies 1 to n, each with its own noise, and the reference beside each."""
    name = log.name.removesuffix(".log.gz")
    folder.mkdir(parents=True, exist_ok=True)
    for seed in range(1, n + 1):
        rng = np.random.default_rng(seed)
        with gzip.open(log, "rt") as lines, gzip.open(folder / f"{name}-{seed}.log.gz", "wt", compresslevel=1) as out:
            out.writelines(noisy_line(line, rng) for line in lines)
        for suffix in SUFFIXES:
            if (reference := log.parent / f"{name}{suffix}").exists():
                shutil.copy(reference, folder / f"{name}-{seed}{suffix}")


if __name__ == "__main__":
    write_noisy_logs(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))
