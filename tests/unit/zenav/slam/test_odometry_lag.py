# SPDX-License-Identifier: Apache-2.0
"""The lag of odometry is found by the scans, and a log is corrected where its whole drive shows a large one."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.geometry import Pose2, interpolated
from tests.unit.services.mapper.rooms import RING, cast
from tests.unit.zenav.logs import ring_log, ring_poses
from zenav.convert.carmen import read_carmen
from zenav.convert.records import DriveLog, LoggedPose, LoggedScan
from zenav.slam.odometry_lag import clear_lag, odometry_lag, without_lag
from zenav.slam.offline_slam import offline_slam
from zenav.slam.scan_turns import scan_turns

POSES = ring_poses()


def heading(t):
    return 1.3 * np.sin(0.7 * t) + 0.6 * np.sin(1.9 * t + 1.0) + 0.1 * t


def tables(lag, rate=20.0, noise=0.0, scans=5.0):
    """Odometry that gives at t + lag the pose of t, and the true poses of the scans."""
    t = np.arange(0, 60, 1 / rate)
    at = np.arange(0.03, 60, 1 / scans)
    rng = np.random.default_rng(1)
    return (
        np.column_stack((t, heading(t - lag) + noise * rng.normal(size=len(t)).cumsum())),
        np.column_stack((at, heading(at) + 0.002 * rng.normal(size=len(at)))),
    )


@given(lag=st.floats(-0.8, 0.8))
def test_a_lag_is_found_whichever_way(lag):
    assert odometry_lag(*tables(lag)) == pytest.approx(lag, abs=0.02)


def test_odometry_that_turns_too_far_and_drifts_hides_nothing():
    odometry, placed = tables(0.3, noise=0.002)
    odometry[:, 1] *= 1.1
    assert odometry_lag(odometry, placed) == pytest.approx(0.3, abs=0.03)


def test_headings_may_wrap():
    odometry, placed = tables(0.2)
    odometry[:, 1], placed[:, 1] = ((table[:, 1] + 2.5 + np.pi) % (2 * np.pi) - np.pi for table in (odometry, placed))
    assert odometry_lag(odometry, placed) == pytest.approx(0.2, abs=0.02)


def test_without_turns_or_scans_nothing_is_told():
    odometry, placed = tables(0.2)
    still = placed * (1, 0)
    assert odometry_lag(odometry * (1, 0), still) is None
    assert odometry_lag(odometry, placed[:5]) is None
    assert odometry_lag(np.zeros((0, 2)), placed) is None


def test_a_lag_beyond_what_is_looked_for_is_not_told_wrongly():
    found = odometry_lag(*tables(1.5))
    assert found is None or abs(found) > 0.8


def ring_drive(tmp_path, late) -> DriveLog:
    path = tmp_path / "ring.log"
    path.write_text("\n".join(ring_log(POSES, late)) + "\n")
    return read_carmen(path)


@pytest.mark.parametrize("late", [-4, -2, 1.5, 3, 4])
def test_a_large_lag_is_found_by_the_scans_and_the_corrected_log_has_the_odometry_of_each_scan(late, tmp_path):
    log = ring_drive(tmp_path, [late] * len(POSES))
    lag = clear_lag(log)
    assert lag == pytest.approx(0.2 * late, abs=0.05)
    corrected = without_lag(log, lag)
    assert clear_lag(corrected) == 0.0
    scans = [record for record in corrected.records if isinstance(record, LoggedScan)]
    middle = slice(10, len(POSES) - 10)
    for (a, b), (p, q) in zip(pairwise(scans[middle]), pairwise(POSES[middle]), strict=True):
        off = (p.inverse() @ q).inverse() @ (a.odom_from_base.inverse() @ b.odom_from_base)
        assert abs(off.x) < 0.06
        assert abs(off.yaw) < 0.04
    stamps = [record.stamp for record in corrected.records]
    assert stamps == sorted(stamps)


@pytest.mark.parametrize(
    "late",
    [[0] * len(POSES), [1] * len(POSES), [3 if k < len(POSES) / 2 else -3 for k in range(len(POSES))]],
    ids=["none", "small", "not the same everywhere"],
)
def test_a_lag_that_is_small_or_not_clear_is_left_to_the_mapper(late, tmp_path):
    assert clear_lag(ring_drive(tmp_path, late)) == 0.0


def test_a_drive_with_few_turns_shows_no_lag(tmp_path):
    log = ring_drive(tmp_path, [3] * len(POSES))
    assert clear_lag(DriveLog(log.records[:150])) == 0.0
    assert clear_lag(DriveLog(log.records[:1])) == 0.0


def test_a_map_is_not_torn_by_odometry_that_is_late(tmp_path):
    """The fault: each turn on the spot went on as long as odometry showed it, and the map turned with it."""
    ring_drive(tmp_path, [3] * len(POSES))
    report = offline_slam(tmp_path / "ring.log", tmp_path / "out")
    assert report["odometry_lag_corrected_s"] == pytest.approx(0.6, abs=0.05)
    assert report["odometry_lag_s"] == pytest.approx(0.6, abs=0.08)
    rows = np.loadtxt(tmp_path / "out" / "trajectory.tum")
    at = [int(np.argmin(np.abs(rows[:, 0] - 100 - 0.2 * k))) for k in range(len(POSES))]
    assert np.abs(rows[at, 0] - 100 - 0.2 * np.arange(len(POSES))).max() < 1e-3
    found = [Pose2(x, y, 2 * np.arctan2(z, w)) for x, y, z, w in rows[at][:, [1, 2, 6, 7]]]
    off = [(POSES[0].inverse() @ p).distance(found[0].inverse() @ f) for p, f in zip(POSES, found)]
    assert max(off) < 0.1


def test_a_sweep_that_takes_time_adds_no_lag():
    """The beams of a sweep are taken one after the other, while the robot turns; the log dates the first one.

    Odometry is 0.4 s late.
    """
    angles, records = np.radians(np.arange(-120, 120)), list[LoggedPose | LoggedScan]()
    for k, (pose, following) in enumerate(pairwise(POSES)):
        shares = np.linspace(0, 1, len(angles))
        places = [interpolated(pose, following, share) for share in shares]
        origins, yaws = np.array([(p.x, p.y) for p in places]), np.array([p.yaw for p in places])
        ranges = cast(RING, origins, yaws + angles).astype(np.float32)
        at = POSES[0].inverse() @ POSES[max(k - 2, 0)]
        records.append(LoggedScan(k * 200_000_000, at, at, angles[0], np.radians(1), 30.0, ranges, scan_time=0.2))
    assert clear_lag(DriveLog(records)) == pytest.approx(0.4, abs=0.05)


def test_scans_that_see_nothing_turn_nowhere():
    ranges = np.full(180, np.nan, np.float32)
    scans = [LoggedScan(k, Pose2(), Pose2(), -1.5, 0.02, 30.0, ranges) for k in range(3)]
    assert scan_turns(scans).tolist() == [0.0, 0.0, 0.0]
