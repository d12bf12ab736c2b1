# SPDX-License-Identifier: Apache-2.0
"""A displacement that the scans contradict is found, and one that odometry alone contradicts is not."""

from math import cos, isnan, pi, sin

import numpy as np
import pytest

from shared.geometry import Pose2
from tests.unit.zenav.slam.reference_fit import ScanPairs, displacements, moved_ahead, pair_fits, stretches, turning
from zenav.convert.records import LoggedScan
from zenav.slam.slam_error import PosePairs

WALLS = 6.0, 2.5  # m from the middle of a room, in x and y
AHEAD = Pose2(0.22, 0, 0)  # base_from_laser
N = 8


def scan(k: int, odom_from_base: Pose2) -> LoggedScan:
    """A scan of a robot that has driven half a metre k times, along x."""
    laser = Pose2(-2 + 0.5 * k, 0.3, 0) @ AHEAD
    ranges = []
    for angle in np.linspace(-pi / 2, pi / 2, 181):
        dx, dy = max(abs(cos(angle)), 1e-9), max(abs(sin(angle)), 1e-9)
        ranges.append(min((WALLS[0] - laser.x) / dx, (WALLS[1] - np.sign(sin(angle)) * laser.y) / dy))
    odom_from_laser = odom_from_base @ AHEAD
    return LoggedScan(
        round(k * 1e9), odom_from_base, odom_from_laser, -pi / 2, pi / 180, 50.0, np.array(ranges, np.float32)
    )


def turned_scan(k: int) -> LoggedScan:
    """A scan of a robot that turns on the spot, by 0.3 rad each second."""
    base = Pose2(-0.5, 0.3, 0.3 * k)
    laser = base @ AHEAD
    ranges = []
    for angle in laser.yaw + np.linspace(-pi / 2, pi / 2, 181):
        to_walls = [
            (np.copysign(wall, direction) - at) / direction
            for wall, at, direction in zip(WALLS, (laser.x, laser.y), (cos(angle), sin(angle)))
            if abs(direction) > 1e-9
        ]
        ranges.append(min(to_walls))
    return LoggedScan(round(k * 1e9), base, laser, -pi / 2, pi / 180, 50.0, np.array(ranges, np.float32))


def fits(reference: Pose2, odometry: Pose2):
    """Of pairs two scans apart. reference, odometry: the motion between two scans."""
    pose, scans = Pose2(), []
    for k in range(N):
        scans.append(scan(k, pose))
        pose = pose @ odometry
    early, motion = np.arange(N - 2.0), reference @ reference
    rows = np.tile((motion.x, motion.y, motion.yaw), (N - 2, 1))
    return pair_fits(scans, PosePairs(early, early + 2, rows))


TRUE, ASIDE = Pose2(0.5, 0, 0), Pose2(0.45, 0.2, 0.05)


@pytest.mark.parametrize(
    ("reference", "odometry", "is_wrong", "is_copy"),
    [(ASIDE, TRUE, True, False), (TRUE, ASIDE, False, False), (TRUE, TRUE, False, True)],
)
def test_a_reference_is_wrong_where_the_scans_fit_by_odometry_alone(reference, odometry, is_wrong, is_copy):
    found = fits(reference, odometry)
    assert len(found) == N - 2
    assert {fit.is_wrong for fit in found} == {is_wrong}
    assert {fit.is_copy for fit in found} == {is_copy}


@pytest.mark.parametrize("point", [0.0, -0.2, 0.1])
def test_pairs_that_turn_show_which_point_a_reference_displaces(point):
    """point: m ahead of the robot's own."""
    scans = [turned_scan(k) for k in range(7)]
    poses = np.array([(p.x, p.y, p.yaw) for p in (scan.odom_from_base @ Pose2(point, 0, 0) for scan in scans)])
    early = np.arange(4.0)
    pairs = PosePairs(early, early + 3, displacements(np.arange(7.0), poses, PosePairs(early, early + 3, poses[:4])))
    assert len(turning(pairs).early) == 4
    assert ScanPairs(scans, pairs).laser_ahead(pairs.early_from_late) == pytest.approx(AHEAD.x - point, abs=0.021)


def test_scans_fit_best_by_the_motion_that_they_were_made_in():
    scans = [turned_scan(k) for k in range(7)]
    early, turn = np.arange(4.0), np.tile((0.0, 0.0, 0.9), (4, 1))
    scan_pairs = ScanPairs(scans, PosePairs(early, early + 3, turn))
    fit = scan_pairs.mean_fit(turn, AHEAD)
    assert all(fit > scan_pairs.mean_fit(turn + off, AHEAD) for off in ((0.1, 0, 0), (0, 0.1, 0), (0, 0, 0.05)))


def test_a_robot_that_drives_straight_shows_no_such_point():
    pairs = PosePairs(np.zeros(2), np.ones(2), np.array([(0.5, 0, 0.2), (0, 0, pi)]))
    assert len(turning(pairs).early) == 0
    assert isnan(ScanPairs([turned_scan(0)], turning(pairs)).laser_ahead(np.empty((0, 3))))


def test_wrong_pairs_that_follow_each_other_are_one_stretch():
    wrong = fits(ASIDE, TRUE)
    assert stretches(wrong) == [wrong]
    assert stretches([]) == []


def test_a_point_ahead_of_the_robot_moves_on_a_circle_where_it_turns():
    poses = np.array([(1.0, 2.0, 0.0), (1.0, 2.0, pi / 2), (1.0, 2.0, pi)])
    assert moved_ahead(poses, 0.5) == pytest.approx(np.array([(1.5, 2, 0), (1, 2.5, pi / 2), (0.5, 2, pi)]))
