# SPDX-License-Identifier: Apache-2.0
"""A log of corridors is the same each time, its ranges are those of its walls, and each kind is hard as it says."""

import gzip

import numpy as np
import pytest

from tests.unit.services.mapper import rooms
from tests.unit.zenav.slam.corridor_logs import ANGLES, KINDS, building, cast, trajectory, write_log

N_SCANS = 300


@pytest.fixture(scope="module")
def logs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("corridors")
    return {kind: write_log(folder, kind, 3, 2061 if kind in ("dark", "slip") else N_SCANS) for kind in KINDS}


def rows_of(log):
    """Ranges (n, 181) m and odometry (n, 3) of each scan."""
    lines = [line.split() for line in gzip.decompress(log.read_bytes()).decode().splitlines() if line[0] == "F"]
    return np.array([line[2:183] for line in lines], float), np.array([line[183:186] for line in lines], float)


def test_ranges_are_those_of_the_nearest_walls():
    segments = building(np.random.default_rng(3))
    for x, y, yaw in trajectory()[::500].tolist():
        expected = rooms.cast(segments, np.tile((x, y), (len(ANGLES), 1)), yaw + ANGLES)
        np.testing.assert_allclose(cast(segments, x, y, yaw + ANGLES)[0], expected, rtol=1e-9)


def test_a_log_is_the_same_each_time_and_has_a_true_pose_for_each_scan(logs, tmp_path):
    again = write_log(tmp_path, "plain", 3, N_SCANS)
    assert gzip.decompress(again.read_bytes()) == gzip.decompress(logs["plain"].read_bytes())
    truth = np.loadtxt(tmp_path / "corridors-plain-3.ref.tum")
    np.testing.assert_allclose(truth[:, 1:3], trajectory()[:N_SCANS, :2], atol=1e-4)


def test_each_kind_is_hard_as_it_says(logs):
    ranges, odometry = rows_of(logs["plain"])
    true = trajectory()
    driven = np.hypot(*np.diff(true[:N_SCANS, :2], axis=0).T).sum()
    assert np.hypot(*np.diff(odometry[:, :2], axis=0).T).sum() == pytest.approx(driven, rel=0.04)
    assert np.hypot(*np.diff(rows_of(logs["drift"])[1][:, :2], axis=0).T).sum() > 1.04 * driven
    is_turn = np.hypot(*np.diff(true[:2061, :2], axis=0).T) < 0.1
    slipping = np.hypot(*np.diff(rows_of(logs["slip"])[1][:, :2], axis=0).T)[~is_turn]
    assert 0 < (abs(slipping - 0.14) > 0.05).sum() < 300
    assert len(rows_of(logs["sparse"])[0]) == N_SCANS // 5
    assert (rows_of(logs["people"])[0] < ranges - 0.2).any(axis=1).mean() > 0.9
    assert (rows_of(logs["glass"])[0] > 80).mean() > (ranges > 80).mean() + 0.05
    dark = (rows_of(logs["dark"])[0] > 80).all(axis=1)
    assert np.flatnonzero(dark).tolist() == list(range(2000, 2060))
