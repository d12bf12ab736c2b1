# SPDX-License-Identifier: Apache-2.0
"""A displacement that the scans contradict is found, and one that odometry alone contradicts is not."""

from math import cos, pi, sin

import numpy as np
import pytest

from shared.geometry import Pose2
from tests.unit.zenav.slam.reference_fit import mean_errors, pair_fits, stretches
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


def test_wrong_pairs_that_follow_each_other_are_one_stretch():
    wrong = fits(ASIDE, TRUE)
    assert stretches(wrong) == [wrong]
    assert stretches([]) == []


def test_short_pairs_and_others_have_their_own_mean_error(tmp_path):
    """The trajectory is a centimetre too long each second."""
    path = tmp_path / "trajectory.tum"
    path.write_text("".join(f"{k} {0.51 * k} 0 0 0 0 0 1\n" for k in range(60)))
    early, late = np.array([0.0, 10.0, 0.0]), np.array([2.0, 14.0, 50.0])
    rows = np.column_stack((0.5 * (late - early), np.zeros(3), np.zeros(3)))
    assert mean_errors(PosePairs(early, late, rows), path) == pytest.approx((0.03, 0.5))
