# SPDX-License-Identifier: Apache-2.0
"""Pieces of real logs, short enough for every run of the tests; `zenav bench slam` takes them whole.

A whole one, laps and all, is mapped in tests/unit/zenav/convert/test_real_bags.py.
"""

import gzip
import os
from dataclasses import replace
from itertools import takewhile
from pathlib import Path

import numpy as np
import pytest

from zenav.slam.offline_slam import offline_slam
from zenav.slam.slam_error import pair_errors, pairs_of, read_tum

DATA = os.environ.get("ZENAV_DATA")  # noqa: TID251  # where the machine keeps its logs
LOGS = Path(str(DATA)) / "slam"

pytestmark = pytest.mark.skipif(DATA is None, reason="ZENAV_DATA is not set: the real logs are not on this machine")


def beginning(name, seconds, folder):
    """The first seconds of a log, as a log."""
    with gzip.open(LOGS / f"{name}.log.gz", "rt") as whole:
        lines = [line for line in whole if line.startswith(("ODOM ", "FLASER "))]
    first = stamp_of(lines[0])
    path = folder / f"{name}.log"
    path.write_text("".join(takewhile(lambda line: stamp_of(line) < first + seconds, lines)))
    return path


def stamp_of(line):
    return float(line.split()[-3])


def figures_inside(trajectory, name):
    """The figures of the relations that lie within a trajectory's time."""
    stamps, poses = read_tum(trajectory)
    pairs = pairs_of(LOGS / f"{name}.relations")["relations"]
    inside = (np.minimum(pairs.early, pairs.late) >= stamps[0]) & (np.maximum(pairs.early, pairs.late) <= stamps[-1])
    pairs = replace(
        pairs, early=pairs.early[inside], late=pairs.late[inside], early_from_late=pairs.early_from_late[inside]
    )
    return pair_errors(stamps, poses, pairs).figures()


@pytest.fixture(scope="module")
def mapped(tmp_path_factory):
    """A name's beginning of a log, its report, and the folder of its map; made once a name."""
    made = {}

    def of(name, seconds):
        if name not in made:
            folder = tmp_path_factory.mktemp(name)
            log = beginning(name, seconds, folder)
            made[name] = log, offline_slam(log, folder / "out"), folder / "out"
        return made[name]

    return of


@pytest.mark.parametrize(
    ("name", "seconds", "mean", "most"), [("intel", 150, 0.020, 0.087), ("fr079-raw", 100, 0.024, 0.135)]
)
def test_the_beginning_of_a_log_agrees_with_its_relations(name, seconds, mean, most, mapped):
    """Limits are a tenth over the worst mean and a fifth over the worst maximum of the log and of five variants of it.
    Their ranges differ within the log's rounding to 1 cm: 0.0176 to 0.0183 and 0.064 to 0.073 m on intel, 0.0217 to
    0.0219 and 0.110 to 0.114 m on fr079-raw.
    """
    _, report, folder = mapped(name, seconds)
    assert report["scans_placed"] == report["scans"] > 400
    assert report["states"].get("lost", 0) == 0
    figures = figures_inside(folder / "trajectory.tum", name)
    assert figures["n"] > 60
    assert figures["trans_mean_m"] < mean
    assert figures["trans_max_m"] < most


def test_the_same_log_gives_the_same_bytes_twice_also_where_loops_close(mapped, tmp_path):
    log, report, folder = mapped("fr079-raw", 100)
    assert report["loops"] > 0
    offline_slam(log, tmp_path)
    for name in ("trajectory.tum", "map.pgm", "map.yaml", "map.png"):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()
