# SPDX-License-Identifier: Apache-2.0
"""Bags of real robots, good, poor and broken: what must come out of each stands in bags/README.md of $ZENAV_DATA."""

import os
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.ndimage import distance_transform_edt

from shared.config import UserError
from shared.geometry import wrapped
from shared.ros_map import read_ros_map
from zenav.convert.carmen import read_carmen
from zenav.convert.content import Choice
from zenav.convert.export import convert
from zenav.convert.records import DriveLog, LoggedScan
from zenav.convert.source import read_log
from zenav.slam import offline_slam as slam_module
from zenav.slam.offline_slam import offline_slam
from zenav.slam.slam_error import read_tum, slam_errors

DATA = os.environ.get("ZENAV_DATA")  # noqa: TID251  # where the machine keeps its logs
BAGS, LOGS = Path(str(DATA)) / "bags", Path(str(DATA)) / "slam"

pytestmark = pytest.mark.skipif(
    not BAGS.is_dir(), reason="ZENAV_DATA has no bags: the real ones are not on this machine"
)


def scans_of(log, most=None):
    return [record for record in log.records if isinstance(record, LoggedScan)][:most]


@pytest.mark.parametrize(
    ("bag", "log", "n"),
    [
        ("fr079_part.bag", "fr079-raw", 1500),
        ("intel_sparse_mcap", "intel-sparse", 910),
        ("belgioioso_sqlite", "belgioioso", 395),
    ],
)
def test_a_bag_holds_the_scans_of_the_carmen_log_that_it_was_made_from(bag, log, n):
    mine, theirs = scans_of(read_log(BAGS / bag, Choice())), scans_of(read_carmen(LOGS / f"{log}.log.gz"), n)
    assert len(mine) == len(theirs) == n
    for a, b in zip(mine, theirs):
        assert abs(a.stamp - b.stamp) <= 1000
        for mine_from, theirs_from in ((a.odom_from_base, b.odom_from_base), (a.odom_from_laser, b.odom_from_laser)):
            assert mine_from.distance(theirs_from) < 1e-5
            assert abs(wrapped(mine_from.yaw - theirs_from.yaw)) < 1e-5
        kept = ~np.isnan(a.ranges)
        assert_allclose(a.ranges[kept], b.ranges[kept])
        assert (b.ranges[~kept] > 79).all()  # the SICK's way to say that nothing came back
        assert (a.angle_min, a.angle_increment) == pytest.approx((b.angle_min, b.angle_increment), abs=1e-7)


def test_the_map_of_a_ros1_bag_is_that_of_the_carmen_log_of_the_same_scans(tmp_path, monkeypatch):
    """The first 500 scans, for time."""
    logs = {"bag": read_log(BAGS / "fr079_part.bag", Choice()), "carmen": read_carmen(LOGS / "fr079-raw.log.gz")}
    for name, log in logs.items():
        cut = DriveLog(list(scans_of(log, 500)))
        monkeypatch.setattr(slam_module, "read_log", lambda path, choice, cut=cut: cut)
        offline_slam(Path(name), tmp_path / name)
    (_, mine), (_, theirs) = (read_tum(tmp_path / name / "trajectory.tum") for name in logs)
    assert np.hypot(*(mine - theirs)[:, :2].T).mean() < 0.01
    (cells, *place), (others, *elsewhere) = (read_ros_map(tmp_path / name / "map.yaml") for name in logs)
    assert place == elsewhere
    for walls, of_the_other in ((cells == 100, others == 100), (others == 100, cells == 100)):
        away = distance_transform_edt(~of_the_other)
        assert (away[walls] < 1.5).mean() > 0.95  # cells


def test_a_ros2_bag_is_mapped_as_well_as_its_carmen_log(tmp_path):
    report = offline_slam(BAGS / "belgioioso_sqlite", tmp_path)
    assert report["loops"] > 0
    assert report["scans_placed"] == report["scans"]
    assert report["notes"] == []
    figures = slam_errors(tmp_path / "trajectory.tum", LOGS / "belgioioso.ref.tum")
    assert figures["loops"]["trans_mean_m"] < 0.05
    assert figures["neighbours"]["trans_mean_m"] < 0.05


def test_scans_alone_give_a_map_of_the_turtlebots_world(tmp_path):
    report = offline_slam(BAGS / "turtlebot3_scan2.bag", tmp_path)
    assert report["scans_placed"] == report["scans"] == 538
    assert any("scans alone" in note for note in report["notes"])
    assert report["quality"]["mean"] > 0.9
    cells, resolution, *_ = read_ros_map(tmp_path / "map.yaml")
    rows, columns = np.nonzero(cells >= 0)
    size = np.array([np.ptp(rows) + 1, np.ptp(columns) + 1]) * resolution
    assert_allclose(sorted(size), (5.1, 5.5), atol=0.3)  # the hexagon of turtlebot3_world


def test_of_a_bag_whose_index_does_not_read_the_sound_messages_are_mapped(tmp_path):
    report = offline_slam(BAGS / "laser_demo.bag", tmp_path)
    assert report["scans_placed"] == report["scans"] == 360
    assert any("360 messages; 4430 bytes in 2 places are no records" in note for note in report["notes"])


def test_a_bag_without_scans_gives_trajectories_and_says_why_it_gives_no_map(tmp_path):
    bag = BAGS / "nav2_turtlebot.mcap"
    with pytest.raises(UserError, match="no LaserScan in it") as error:
        offline_slam(bag, tmp_path / "map")
    assert "/amcl_pose" in error.value.hint
    for trajectory, n in (("pose", 135), ("odom", 2639)):
        convert(bag, tmp_path / f"{trajectory}.tum", "", Choice(), trajectory, False)
        stamps, _ = read_tum(tmp_path / f"{trajectory}.tum")
        assert len(stamps) == n
        assert 900 < stamps[0] < 1000  # the simulator's clock, which the headers contain
