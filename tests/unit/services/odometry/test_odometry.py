# SPDX-License-Identifier: Apache-2.0
import csv
import gzip
import os
from math import hypot, pi, radians
from pathlib import Path

import numpy as np
import pytest

from services.base_driver.config import BaseDriverConfig
from services.base_driver.service import BaseDriverService
from services.odometry.dead_reckoning import DeadReckoningConfig
from services.odometry.service import OdometryService
from shared import topics
from shared.config import load_robot
from shared.geometry import Pose2, wrapped
from shared.messages import BoardReport, WheelState
from zenav.bench.odometry import MAX_DISTANCE, MAX_TURN

ROBOT = load_robot("x80sv").robot
MS = 1_000_000
DATA = os.environ.get("ZENAV_DATA")  # noqa: TID251  # tests may read the environment
needs_data = pytest.mark.skipif(DATA is None, reason="ZENAV_DATA is not set")


def service(**settings):
    return OdometryService(DeadReckoningConfig(**settings), ROBOT)


def wheels(ms, left, right, epoch=1, left_speed=0.0, right_speed=0.0):
    return WheelState(ms * MS, epoch, left, right, left_speed, right_speed)


def fed(odometry, *states):
    out = [publication.message for state in states for publication in odometry.wheels(state)]
    return out[-1] if out else None


def same(pose, x, y, yaw):
    assert (pose.x, pose.y, pose.yaw) == pytest.approx((x, y, yaw), abs=1e-9)


def test_it_begins_at_the_origin_wherever_the_wheels_are():
    first = fed(service(), wheels(0, 100.0, -3.0))
    same(first.odom_from_base, 0, 0, 0)
    assert not first.covariance.any()


def test_straight_on():
    moved = fed(service(), wheels(0, 5.0, 7.0), wheels(20, 7.0, 9.0))
    same(moved.odom_from_base, 2 * 0.085, 0, 0)
    assert moved.stamp == 20 * MS


def test_unequal_wheels_roll_as_far_as_their_radii_say():
    drive = ROBOT.drive.model_copy(update={"wheel_radius_ratio": 1.05})
    odometry = OdometryService(DeadReckoningConfig(), ROBOT.model_copy(update={"drive": drive}))
    straight = (1 / drive.left_radius, 1 / drive.right_radius)  # rad for a metre on each rim
    moved = fed(odometry, wheels(0, 0.0, 0.0), wheels(1000, *straight, 1, *straight))
    same(moved.odom_from_base, 1.0, 0.0, 0.0)
    assert (moved.v, moved.w) == pytest.approx((1.0, 0.0), abs=1e-12)


def test_the_twist_is_the_wheels_speeds():
    moved = fed(service(), wheels(0, 0.0, 0.0, left_speed=2.0, right_speed=4.0))
    assert (moved.v, moved.w) == pytest.approx((0.085 * 3, 0.085 * 2 / 0.283))


def test_a_long_gap_is_one_arc():
    quarter = pi / 2 * 0.283 / 0.085  # the right wheel alone turns the robot by 90 degrees about the left one
    moved = fed(service(), wheels(0, 0.0, 0.0), wheels(30_000, 0.0, quarter))
    same(moved.odom_from_base, 0.283 / 2, 0.283 / 2, pi / 2)


def test_old_and_repeated_wheel_states_are_ignored():
    odometry = service()
    fed(odometry, wheels(0, 0.0, 0.0), wheels(20, 1.0, 1.0))
    assert fed(odometry, wheels(20, 3.0, 3.0), wheels(10, 5.0, 5.0)) is None
    same(fed(odometry, wheels(40, 2.0, 2.0)).odom_from_base, 2 * 0.085, 0, 0)


def test_a_restarted_driver_continues_the_pose():
    odometry = service()
    before = fed(odometry, wheels(0, 0.0, 0.0), wheels(20, 50.0, 51.0))
    after = fed(odometry, wheels(10, 0.3, 0.2, epoch=2))
    assert after.odom_from_base == before.odom_from_base
    np.testing.assert_array_equal(after.covariance, before.covariance)
    moved = fed(odometry, wheels(30, 1.3, 1.2, epoch=2))
    assert moved.odom_from_base.distance(before.odom_from_base) == pytest.approx(0.085)


def test_late_words_of_a_replaced_driver_are_ignored():
    odometry = service()
    odometry.now = 5_000 * MS
    fed(odometry, wheels(20, 1.0, 1.0, epoch=1), wheels(40, 0.0, 0.0, epoch=2))
    assert fed(odometry, wheels(60, 9.0, 9.0, epoch=1)) is None


def test_after_the_clock_was_set_back_a_driver_s_smaller_epoch_counts():
    odometry = service()
    odometry.now = 5_000 * MS
    fed(odometry, wheels(5_000, 1.0, 1.0, epoch=4_900 * MS))
    odometry.now = 10 * MS
    assert fed(odometry, wheels(10, 0.0, 0.0, epoch=5 * MS)) is not None


@pytest.mark.parametrize(("ahead_ms", "ignored"), [(0, True), (100, True), (101, False)])
def test_an_epoch_ahead_of_the_clock_is_no_reason_to_ignore_a_smaller_one(ahead_ms, ignored):
    odometry = service()
    odometry.now = 1_000 * MS
    fed(odometry, wheels(900, 1.0, 1.0, epoch=(1_000 + ahead_ms) * MS))
    assert (fed(odometry, wheels(910, 9.0, 9.0, epoch=500)) is None) is ignored


@pytest.mark.parametrize(("roll", "taken"), [(99.9, True), (100.1, False), (-99.9, True), (-100.1, False)])
def test_a_hundred_metres_at_once_is_no_motion(roll, taken):
    odometry = service()
    fed(odometry, wheels(0, 0.0, 0.0))
    *_, publication = odometry.wheels(wheels(20, roll / 0.085, roll / 0.085))
    assert (publication.message.odom_from_base.x != 0) is taken


def test_covariance_stays_within_the_message_s_bounds_for_ever():
    odometry = service(wheel_variance=1.0)
    odometry.covariance = np.diag([9.9e10, 9.9e10, 9.9e10])
    for k in range(60):
        out = fed(odometry, wheels(20 * k, 900.0 * k, 900.0 * k))
    assert out.covariance.max() < 1e12
    assert out.odom_from_base.x > 1000


def test_a_jump_of_the_wheels_is_no_motion():
    odometry = service()
    fed(odometry, wheels(0, 0.0, 0.0))
    log, publication = odometry.wheels(wheels(20, 9e5, 0.0))
    assert log.level == "WARNING"
    same(publication.message.odom_from_base, 0, 0, 0)
    same(fed(odometry, wheels(40, 9e5 + 1, 1.0)).odom_from_base, 0.085, 0, 0)


def test_the_integration_is_chosen_by_the_configuration():
    roll = wheels(0, 0.0, 0.0), wheels(20, 0.0, 2.0)
    exact, document = (fed(service(integration=name), *roll).odom_from_base for name in ("exact", "document"))
    assert exact.y > 0
    assert document.y == 0
    assert document.yaw == pytest.approx(np.arctan2(0.17, 0.283))


def rows(name):
    with gzip.open(Path(DATA) / "x80sv" / f"{name}.csv.gz", "rt") as file:
        return [[float(value) for value in row] for row in list(csv.reader(file))[1:]]


def compared(poses):
    """Largest distance (m) and turn (rad) from the recorded odometry, whose row 0 has no wheel row."""
    recorded = [Pose2(*row[2:5]) for row in rows("odom")]
    n = min(len(recorded) - 1, len(poses))
    assert n > 2600
    ours = [recorded[1] @ pose for pose in poses]
    gaps = [(hypot(a.x - b.x, a.y - b.y), abs(wrapped(a.yaw - b.yaw))) for a, b in zip(recorded[1:], ours)]
    return max(gap for gap, _ in gaps), max(turn for _, turn in gaps)


def unwrapped(angles):
    """Encoder angles that wrap at 32768 counts, made continuous."""
    wrap = 32768 * 2 * pi / 756
    steps = np.diff(angles)
    return np.concatenate([[angles[0]], angles[0] + np.cumsum(steps - wrap * np.round(steps / wrap))])


@needs_data
def test_the_real_robot_s_wheels_give_its_recorded_odometry():
    recorded = np.array(rows("wheel_positions"))
    left, right = -unwrapped(recorded[:, 1]), unwrapped(recorded[:, 2])
    odometry = service(integration="document")
    states = [WheelState(round(t * 1e9), 1, a, b, 0.0, 0.0) for t, a, b in zip(recorded[:, 0], left, right)]
    poses = [publication.message.odom_from_base for state in states for publication in odometry.wheels(state)]
    assert recorded[-1, 0] > 273
    far, turned = compared(poses)
    assert far < MAX_DISTANCE
    assert turned < radians(MAX_TURN)


@needs_data
def test_the_real_robot_s_encoders_give_its_recorded_odometry_through_the_base_driver():
    """Counts that wrap at 32768, as the board sends them, through base_driver and odometry."""
    driver = BaseDriverService(BaseDriverConfig(), ROBOT)
    odometry = service(integration="document")
    poses, wraps, before = [], 0, None
    for t, left, right in rows("wheel_positions"):
        driver.now = odometry.now = round(t * 1e9)
        counts = round(left * 756 / (2 * pi)) % 32768, round(right * 756 / (2 * pi)) % 32768
        wraps += before is not None and any(abs(a - b) > 16384 for a, b in zip(counts, before))
        before = counts
        nothing = np.empty(0, np.float32)
        report = BoardReport(driver.now, *counts, 0.0, 0.0, nothing, nothing, 7.2, np.zeros(2, np.float32))
        for publication in driver.board(report):
            if publication.topic is topics.WHEELS:
                poses += [out.message.odom_from_base for out in odometry.wheels(publication.message)]
    assert wraps >= 1
    assert driver.encoders.n_jumps == 0
    far, turned = compared(poses)
    assert far < MAX_DISTANCE
    assert turned < radians(MAX_TURN)
