# SPDX-License-Identifier: Apache-2.0
"""What scans say about a believed place on a saved map."""

import numpy as np
import pytest

from services.mapper.grid.occupancy import Occupancy, OccupancyConfig
from services.mapper.localization.kidnap_detection import KidnapConfig, KidnapDetector
from shared.geometry import Pose2

CONFIG = KidnapConfig()
ANGLES = np.linspace(-np.pi, np.pi, 180, endpoint=False) + 0.003  # none along a wall
NOTICED = 30  # scans, 3 s


def sweep(width, height, pose, rng):
    """Origins and ends (180, 2) in `base`, in a room of width x height m about the origin, with 1 cm of noise."""
    c, s = np.cos(ANGLES + pose.yaw), np.sin(ANGLES + pose.yaw)
    to_x, to_y = (np.sign(c) * width / 2 - pose.x) / c, (np.sign(s) * height / 2 - pose.y) / s
    ranges = np.minimum(to_x, to_y) + rng.normal(0, 0.01, len(ANGLES))
    ends = ranges[:, None] * np.column_stack((np.cos(ANGLES), np.sin(ANGLES)))
    return np.zeros_like(ends), ends


@pytest.fixture(scope="module")
def hall():
    """The map of an 8 x 5 m hall."""
    grid, rng = Occupancy(OccupancyConfig(), 1), np.random.default_rng(0)
    for x in np.linspace(-3, 3, 20):
        pose = Pose2(float(x), 0.3, 0.1 * float(x))
        origins, ends = sweep(8, 5, pose, rng)
        grid.insert_scan(pose @ origins, pose @ ends, np.full_like(ends, np.nan))
    return grid


def weighed(hall, believed, width, height, true, n, detector=None, rng=None):
    """After how many of n scans it was called lost; None: after none."""
    detector, rng = detector or KidnapDetector(CONFIG), rng or np.random.default_rng(1)
    for i in range(n):
        origins, ends = sweep(width, height, true, rng)
        if detector.is_kidnapped(hall, believed @ origins, believed @ ends):
            return i + 1
    return None


def test_at_the_right_place_it_is_never_lost(hall):
    for pose in (Pose2(0, 0, 0), Pose2(2.5, -1.5, 2.0), Pose2(-3, 1, -1)):
        assert weighed(hall, pose, 8, 5, pose, 200) is None
        near = pose @ Pose2(0.03, -0.03, 0.01)
        assert weighed(hall, near, 8, 5, pose, 200) is None


def test_in_another_room_it_is_lost_within_three_seconds(hall):
    for width, height in ((3, 3), (20, 2), (11, 9)):
        n = weighed(hall, Pose2(1, 0, 0), width, height, Pose2(0.4, 0.2, 0.7), 100)
        assert n is not None
        assert 2 < n <= NOTICED


def test_one_scan_that_is_wholly_wrong_is_not_enough(hall):
    detector, rng = KidnapDetector(CONFIG), np.random.default_rng(2)
    for _ in range(10):
        assert weighed(hall, Pose2(), 3, 3, Pose2(), 1, detector, rng) is None
        assert weighed(hall, Pose2(), 8, 5, Pose2(), 15, detector, rng) is None


def test_scans_into_the_unknown_or_of_a_few_beams_say_nothing(hall):
    outside = Pose2(500.0, 500.0, 0.0)
    assert weighed(hall, outside, 3, 3, Pose2(), 100) is None
    detector = KidnapDetector(CONFIG)
    origins, ends = sweep(3, 3, Pose2(), np.random.default_rng(3))
    ends[10:] = np.nan
    assert not any(detector.is_kidnapped(hall, origins, ends) for _ in range(100))


def test_a_crowd_around_the_robot_does_not_make_it_lost(hall):
    detector, rng, pose = KidnapDetector(CONFIG), np.random.default_rng(4), Pose2(0.5, 0.2, 0.3)
    for _ in range(200):
        origins, ends = sweep(8, 5, pose, rng)
        crowd = np.flatnonzero((np.sin(4 * ANGLES) > 0.5) & (np.hypot(*ends.T) > 1.5))  # a third of all beams
        ends[crowd] *= (1.0 / np.hypot(*ends[crowd].T))[:, None]
        assert not detector.is_kidnapped(hall, pose @ origins, pose @ ends)
    assert len(crowd) > 50


def test_found_again_it_starts_from_the_start(hall):
    detector = KidnapDetector(CONFIG)
    assert weighed(hall, Pose2(), 3, 3, Pose2(), 100, detector) is not None
    detector.reset()
    assert weighed(hall, Pose2(), 8, 5, Pose2(), 100, detector) is None
