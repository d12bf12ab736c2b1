# SPDX-License-Identifier: Apache-2.0
"""A real robot's second lap, on the map of its first."""

import gzip
import os
from pathlib import Path

import numpy as np
import pytest

from shared.config import UserError
from tests.unit.zenav.logs import room_log
from zenav.maps.saved_map import read_saved_map
from zenav.slam.offline_slam import offline_slam

DATA = os.environ.get("ZENAV_DATA")  # noqa: TID251  # where the machine keeps its logs
MAX_MEDIAN_M, MAX_ERROR_M = 0.085, 0.32
"""An eighth over the worst of the log and of five variants, whose ranges differ within the log's rounding to 1 cm.
Medians are 0.066 to 0.076 m, maxima 0.274 to 0.288 m. The reference's own error, and its map's, are in these.
"""


def poses_of(folder):
    rows = np.loadtxt(folder / "trajectory.tum")
    return rows[:, 0], np.column_stack((rows[:, 1], rows[:, 2], 2 * np.arctan2(rows[:, 6], rows[:, 7])))


@pytest.fixture(scope="module")
def intel_in_two(tmp_path_factory):
    """The map of the first half of a real log, and what the robot drove then."""
    if DATA is None:
        pytest.skip("ZENAV_DATA is not set: the real logs are not on this machine")
    folder = tmp_path_factory.mktemp("intel")
    with gzip.open(Path(DATA) / "slam" / "intel-sparse.log.gz", "rt") as whole:
        lines = whole.read().splitlines()
    scans = [i for i, line in enumerate(lines) if line.startswith("FLASER")]
    (folder / "first.log").write_text("\n".join(lines[: scans[455]]) + "\n")
    (folder / "second.log").write_text("\n".join(lines[scans[455] : scans[605]]) + "\n")
    offline_slam(folder / "first.log", folder / "map")
    return folder


def off_the_reference(folder, name):
    """m from each scan's place to the reference's, the map laid onto that by its own drive."""
    rows = np.loadtxt(Path(str(DATA)) / "slam" / "intel-sparse.ref.tum")

    def pairs(of):
        stamps, poses = poses_of(folder / of)
        at = np.clip(np.searchsorted(rows[:, 0], stamps - 1e-3), 0, len(rows) - 1)
        same = np.abs(rows[at, 0] - stamps) < 2e-3
        return poses[same, :2], rows[at[same], 1:3]

    mine, theirs = pairs("map")
    u, _, v = np.linalg.svd((mine - mine.mean(axis=0)).T @ (theirs - theirs.mean(axis=0)))
    turn = u @ np.diag((1, np.linalg.det(u @ v))) @ v
    found, wanted = pairs(name)
    return np.hypot(*((found - mine.mean(axis=0)) @ turn + theirs.mean(axis=0) - wanted).T)


def test_the_next_lap_of_a_real_log_is_localised_on_the_map_of_the_first(intel_in_two):
    before = {path.name: path.read_bytes() for path in (intel_in_two / "map").iterdir()}
    report = offline_slam(
        intel_in_two / "second.log", intel_in_two / "there", mode="localise", saved_map=intel_in_two / "map"
    )
    assert report["log_lines"][0].startswith("found on the map")
    assert report["states"]["lost"] < 10  # scans until it is found: 5 in each variant
    assert not any(line.startswith("lost") for line in report["log_lines"])
    off = off_the_reference(intel_in_two, "there")
    assert np.median(off) < MAX_MEDIAN_M
    assert off.max() < MAX_ERROR_M
    assert {path.name: path.read_bytes() for path in (intel_in_two / "map").iterdir()} == before
    for name in ("map.pgm", "map.yaml", "graph.msgpack"):
        assert (intel_in_two / "there" / name).read_bytes() == before[name]


def test_a_real_map_goes_on_and_is_one_with_the_old_one(intel_in_two):
    report = offline_slam(
        intel_in_two / "second.log", intel_in_two / "both", mode="continue", saved_map=intel_in_two / "map"
    )
    assert report["loops"] > 30
    off = off_the_reference(intel_in_two, "both")
    assert np.median(off) < MAX_MEDIAN_M
    assert off.max() < MAX_ERROR_M
    old, new = read_saved_map(intel_in_two / "map"), read_saved_map(intel_in_two / "both")
    assert len(new.keyframes) > len(old.keyframes)
    assert np.abs(new.graph.poses[0] - old.graph.poses[0]).max() == 0, "it holds the map"


def test_a_robot_that_is_not_on_the_saved_map_is_an_error_and_no_place(intel_in_two, tmp_path):
    log = tmp_path / "room.log"
    log.write_text("\n".join(room_log(20)) + "\n")
    with pytest.raises(UserError, match="not found on the map") as error:
        offline_slam(log, tmp_path / "out", mode="localise", saved_map=intel_in_two / "map")
    assert error.value.hint
    assert not (tmp_path / "out" / "trajectory.tum").exists()
