# SPDX-License-Identifier: Apache-2.0
from math import pi

import numpy as np
import pytest

from services.guard.laser_visibility import LaserVisibility, VisibilityConfig
from shared.config import load_robot
from shared.geometry import Pose2, arc
from shared.messages import LaserScan, Odometry
from shared.odometry_buffer import OdometryBuffer

ROBOT = load_robot("x80sv").robot
LASER = ROBOT.laser
MS = 1_000_000
N = LASER.n_beams
BEARINGS = (LASER.mount.yaw + LASER.angle_min + LASER.angle_increment * np.arange(N) + pi) % (2 * pi) - pi
OPEN_AIR = VisibilityConfig(min_share=0.0, min_ahead=0.0)


class VisibilityWatch:
    """A view that is given ten scans a second; nan: beams without a return."""

    def __init__(self, config=None, range_max=LASER.range_max):
        self.laser = LASER.model_copy(update={"range_max": range_max})
        self.view = LaserVisibility(config or VisibilityConfig(), ROBOT, self.laser)
        self.track = OdometryBuffer(ROBOT.drive)
        self.now, self.odom_from_base = 1000 * MS, Pose2()

    def scans(self, n, ranges, v=0.0, w=0.0):
        for _ in range(n):
            self.now += 100 * MS
            self.odom_from_base = self.odom_from_base @ arc(0.1 * v, 0.1 * w)
            self.track.add(Odometry(self.now, self.odom_from_base, v, w, np.zeros(9)))
            seen = ranges() if callable(ranges) else ranges
            fields = LASER.angle_min, LASER.angle_increment, 0.0, LASER.range_min, self.laser.range_max
            self.view.add_scan(LaserScan(self.now, *fields, np.asarray(seen, np.float32)), self.track, self.now)
        return self

    def blind(self, v=0.5, w=0.0):
        return self.view.is_blind(v, w, self.now)

    def hall(self, x_wall=4.0, radius=5.0):
        """A round hall about the origin, a wall across it ahead."""
        laser = self.odom_from_base @ self.view.base_from_laser
        angles = BEARINGS + self.odom_from_base.yaw
        along = laser.x * np.cos(angles) + laser.y * np.sin(angles)
        ranges = np.sqrt(along**2 + radius**2 - laser.x**2 - laser.y**2) - along
        with np.errstate(divide="ignore"):
            wall = (x_wall - laser.x) / np.cos(angles)
        return np.where(wall > 0, np.minimum(ranges, wall), ranges)


def sector(ranges, middle, half, value=np.nan):
    """The ranges with another value within `half` rad of a direction in `base`."""
    off = np.abs((BEARINGS - middle + pi) % (2 * pi) - pi)
    return np.where(off <= half, value, ranges)


def disc(distance, bearing, radius):
    """What is seen of a disc alone, its middle in a direction in `base`, m from the laser."""
    off = (BEARINGS - bearing + pi) % (2 * pi) - pi
    across = distance * np.sin(off)
    with np.errstate(invalid="ignore"):
        near = distance * np.cos(off) - np.sqrt(radius**2 - across**2)
    return np.where((np.abs(across) < radius) & (np.abs(off) < pi / 2), near, np.nan)


@pytest.mark.parametrize("value", [np.nan, np.inf, 0.0, 30.0, 0.06])
@pytest.mark.parametrize("config", [VisibilityConfig(), OPEN_AIR], ids=["default", "open air"])
def test_a_scan_without_returns_is_blind_after_three_tenths_of_a_second_also_where_open_air_is_configured(
    value, config
):
    watch = VisibilityWatch(config)
    watch.scans(10, watch.hall)
    assert not watch.blind()
    watch.scans(3, np.full(N, value))
    assert not watch.blind()
    watch.scans(1, np.full(N, value))
    assert all(watch.blind(v, w) for v, w in ((0.5, 0.0), (-0.2, 0.0), (0.0, 1.0)))
    assert "0 of 450 beams return" in watch.view.detail or value == 0.06
    watch.scans(1, watch.hall)
    assert not watch.blind()
    assert not len(watch.view.points(watch.odom_from_base))


def test_plus_infinity_is_a_view_where_the_laser_means_it_so():
    watch = VisibilityWatch(VisibilityConfig(inf_is_free=True))
    watch.scans(10, watch.hall)
    assert not watch.scans(10, np.full(N, np.inf)).blind()
    assert not watch.view.is_empty(0.0, watch.now)
    assert watch.scans(10, np.full(N, np.nan)).blind()


@pytest.mark.parametrize("half", [pi / 6, pi / 4])
def test_a_sector_that_goes_dark_blinds_motion_into_it_alone_until_it_is_back(half):
    watch = VisibilityWatch()
    watch.scans(10, watch.hall)
    watch.scans(5, lambda: sector(watch.hall(), 0.0, half))
    assert watch.blind()
    assert watch.blind(0.3, 0.2)
    assert not watch.blind(-0.3, 0.0)
    watch.scans(2, watch.hall)
    assert not watch.blind()


@pytest.mark.parametrize(
    ("range_max", "distance"), [(12.0, 10.0), (12.0, 11.0), (12.0, 11.5), (30.0, 20.0), (30.0, 28.0)]
)
def test_a_sector_goes_dark_also_where_its_walls_are_far(range_max, distance):
    """Near the end of the range, and where a laser sees far."""
    watch = VisibilityWatch(range_max=range_max)
    watch.scans(10, lambda: watch.hall(distance, distance + 0.2))
    assert not watch.blind()
    for _ in range(4):
        watch.scans(5, lambda: sector(watch.hall(distance, distance + 0.2), 0.0, pi / 6), v=0.1)
        assert watch.blind()
        assert not watch.blind(-0.3, 0.0)
    watch.scans(2, lambda: watch.hall(distance, distance + 0.2), v=0.1)
    assert not watch.blind()


@pytest.mark.parametrize("speed", [-0.3, -1.0])
@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_walls_that_leave_the_range_as_the_robot_drives_leave_no_dark_sector(speed, noise):
    """Ahead a wall, all around the hall; with 3 m of both beyond the range at the end."""
    watch, rng = VisibilityWatch(OPEN_AIR), np.random.default_rng(0)

    def seen():
        ranges = watch.hall(10.5, 11.0) + rng.normal(0, noise, N)
        return np.where(ranges < LASER.range_max, ranges, np.nan)

    while watch.odom_from_base.x > -4.5:
        watch.scans(1, seen, v=speed)
        assert not watch.view.is_dark


def test_a_far_wall_that_returns_now_and_then_is_no_dark_sector():
    """Each scan loses a third of the far returns, once in a while four fifths of them."""
    watch, rng = VisibilityWatch(OPEN_AIR), np.random.default_rng(0)
    for k in range(200):
        lost = rng.random(N) < (0.8 if k % 7 == 0 else 0.33)
        watch.scans(1, lambda lost=lost: np.where(lost, np.nan, watch.hall(11.0, 11.5)), w=0.2)
        assert not watch.view.is_dark


def test_what_stood_in_the_dark_stays_where_it_was_while_the_robot_drives_on():
    watch = VisibilityWatch()
    watch.scans(10, watch.hall)
    watch.scans(30, lambda: sector(watch.hall(), 0.0, pi / 6), v=0.3)
    points = watch.view.points(watch.odom_from_base)
    ahead = points[np.abs(points[:, 1]) < 0.5]
    assert len(ahead) > 5
    assert ahead[:, 0] == pytest.approx(4.0 - watch.odom_from_base.x, abs=0.01)


def test_one_bad_scan_among_good_ones_blinds_nothing():
    watch = VisibilityWatch()
    for _ in range(10):
        watch.scans(2, watch.hall)
        watch.scans(1, np.full(N, np.nan))
        assert not watch.blind()


def test_most_beams_lost_is_blind_and_every_second_one_is_not():
    rng = np.random.default_rng(0)
    watch = VisibilityWatch()
    watch.scans(10, watch.hall)
    assert not watch.scans(10, lambda: np.where(np.arange(N) % 2, np.nan, watch.hall())).blind()
    assert watch.scans(5, lambda: np.where(rng.random(N) < 0.9, np.nan, watch.hall())).blind()


def test_in_open_air_a_thing_left_behind_or_turned_away_from_is_no_dark_sector():
    """Nothing stands there but a post, which the robot passes while it turns."""
    watch = VisibilityWatch(OPEN_AIR)

    def post():
        at = (watch.odom_from_base @ watch.view.base_from_laser).inverse() @ np.array([[1.2, 0.6]])
        distance = float(np.hypot(*at[0]))
        bearing = np.arctan2(at[0, 1], at[0, 0]) + LASER.mount.yaw
        return disc(distance, bearing, 0.3)

    for _ in range(60):
        watch.scans(1, post, v=0.5, w=0.3)
        assert not watch.blind()
        assert not watch.view.is_dark


@pytest.mark.parametrize("speed", [0.5, 1.5])
def test_a_person_who_walks_by_in_open_air_leaves_no_dark_sector(speed):
    watch, y = VisibilityWatch(OPEN_AIR), -4.0
    while y < 4.0:
        y += 0.1 * speed
        distance, bearing = np.hypot(1.0, y), np.arctan2(y, 1.0)
        watch.scans(1, disc(distance, bearing, 0.25))
        assert not watch.blind()


def test_nothing_ahead_from_the_start_is_empty_and_no_dark_sector():
    watch = VisibilityWatch()
    watch.scans(10, lambda: sector(watch.hall(), 0.0, pi / 6))
    assert watch.view.is_empty(0.0, watch.now)
    assert not watch.view.is_empty(pi, watch.now)
    assert not watch.blind()
    assert not VisibilityWatch(OPEN_AIR).scans(10, sector(np.full(N, 3.0), 0.0, pi / 6)).view.is_empty(0.0, watch.now)
