# SPDX-License-Identifier: Apache-2.0
"""`zenav slam` over bags of a made-up drive, whose truth is known."""

import json
from math import cos, pi, sin

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shared.geometry import Pose2
from shared.types import NS_PER_S
from tests.unit.services.mapper.rooms import ROOM, cast
from tests.unit.zenav.convert.bags import BagOf
from zenav.__main__ import _status
from zenav.slam.slam_error import read_tum

FIRST = 1_700_000_000 * NS_PER_S
N, PERIOD, SWEEP = 40, 0.2, 0.1  # scans; s between them; s from the first beam to the last
STEP, TURN = 0.06, 0.1  # m and rad a period
ANGLES = np.radians(np.arange(-120, 120, 2.0))


def pose_at(seconds):
    """Of the base: on a circle, true."""
    k = seconds / PERIOD
    radius = STEP / TURN
    return Pose2(radius * sin(TURN * k), radius * (1 - cos(TURN * k)), TURN * k)


def bag_of_a_drive(kind, roll, yaw, odometry="topic"):
    """The laser sits 0.2 m ahead, rolled and turned; its beams are taken one after the other while the robot drives."""
    bag = BagOf(kind)
    mount = Rotation.from_euler("zx", (yaw, roll))
    bag.tf(FIRST, "base_link", "laser", (0.2, 0.05, 0.3), mount.as_quat(), static=True)
    rays = mount.apply(np.column_stack((np.cos(ANGLES), np.sin(ANGLES), np.zeros(len(ANGLES)))))
    for k in range(N):
        stamp, seconds = FIRST + round(k * PERIOD * NS_PER_S), k * PERIOD
        for share in (0.0, 0.5):
            late = pose_at(1.03 * (seconds + share * PERIOD))  # the wheels are 3 % too small
            at = stamp + round(share * PERIOD * NS_PER_S)
            if odometry == "topic":
                bag.odom(at, late.x, late.y, late.yaw)
            elif odometry == "tf":
                bag.tf(at, "odom", "base_link", (late.x, late.y, 0), (0, 0, sin(late.yaw / 2), cos(late.yaw / 2)))
        poses = [pose_at(seconds + SWEEP * i / (len(ANGLES) - 1)) for i in range(len(ANGLES))]
        lasers = [pose @ Pose2(0.2, 0.05, 0) for pose in poses]
        headings = np.array([pose.yaw for pose in poses]) + np.arctan2(rays[:, 1], rays[:, 0])
        ranges = cast(ROOM, np.array([(laser.x, laser.y) for laser in lasers]), headings)
        bag.scan(stamp, ranges, angles=(ANGLES[0], ANGLES[1] - ANGLES[0]), time_increment=SWEEP / (len(ANGLES) - 1))
    return bag


@pytest.mark.parametrize(
    ("kind", "roll", "yaw", "odometry"),
    [
        ("ros1", 0.0, 0.0, "topic"),
        ("mcap", pi, 0.0, "topic"),
        ("sqlite", pi, 2.5, "tf"),
        ("mcap-zstd", 0.0, -1.0, "none"),
        ("ros1", 0.0, pi, "topic"),
    ],
)
def test_the_way_comes_out_however_the_laser_is_mounted_and_the_odometry_told(
    kind, roll, yaw, odometry, tmp_path, capsys
):
    path = bag_of_a_drive(kind, roll, yaw, odometry).write(tmp_path / "bag")
    assert _status(["slam", str(path), "--out", str(tmp_path / "out")]) == 0
    out, err = capsys.readouterr()
    assert "40 of 40 scans" in out
    assert ("upside-down" in err, "scans alone" in err) == (roll == pi, odometry == "none")
    report = json.loads((tmp_path / "out" / "report.json").read_text())
    assert report["bad_messages"] == 0
    stamps, poses = read_tum(tmp_path / "out" / "trajectory.tum")
    seconds = stamps - FIRST * 1e-9
    assert seconds[-1] > (N - 1) * PERIOD - 1e-3
    started = seconds > 3 * PERIOD  # a robot that drives fast before its first scan has one crooked one in its map
    found, true = [Pose2(*row) for row in poses[started]], [pose_at(t) for t in seconds[started]]
    middle = len(found) // 2
    off = [(found[middle].inverse() @ a).distance(true[middle].inverse() @ b) for a, b in zip(found, true)]
    assert len(off) >= N - 4
    assert max(off) < 0.025
