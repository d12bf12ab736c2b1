# SPDX-License-Identifier: Apache-2.0
"""A mapper with lasers of half a circle ahead and back: what the second one adds, and what its faults do not harm."""

from dataclasses import replace
from math import hypot, pi

import numpy as np
import pytest

from services.mapper.config import MapperConfig
from services.mapper.service import MapperService
from shared.config import Laser, Mount
from shared.geometry import Pose2, arc
from shared.types import NS_PER_S
from tests.unit.services.mapper.rooms import ROBOT, ROOM, RoomDrive, box
from tests.unit.services.mapper.test_mapper import kernels

HALF = {
    "angle_min": -pi / 2, "angle_increment": pi / 180, "n_beams": 181, "scan_time": 0.1, "rate": 5,
    "range_min": 0.05, "range_max": 8.0,
}  # fmt: skip
FRONT = Laser(name="front", mount=Mount(x=0.15, y=0.0, yaw=0.0), **HALF)
REAR = Laser(name="rear", mount=Mount(x=-0.15, y=0.0, yaw=pi), **HALF)
BOTH = ROBOT.model_copy(update={"laser": FRONT, "lasers": (FRONT, REAR)})
FRONT_MAPS = ROBOT.model_copy(update={"laser": FRONT, "lasers": (FRONT, REAR.model_copy(update={"mapping": False}))})
ROUND = [arc(0.06, 0.12)] * 30
DEAD_END = np.array([*box(-1.5, -1.0, 60.0, 1.0), *box(-1.5, 0.6, -0.9, 1.0)])
"""A corridor that ends behind the robot."""


class TwoLaserDrive(RoomDrive):
    """`delay`: s from the second laser's last beam to the first one's.  `changed`: what the second laser sends."""

    def __init__(self, segments, robot=BOTH, noise=0.01, delay=0.0, odometry_scale=1.0):
        super().__init__(segments, None, noise, robot)
        self.delay, self.odometry_scale = delay, odometry_scale
        self.changed = lambda scan: scan

    def step(self, motion, with_odometry=True):
        begin, start = self.now, self.true
        path = [start @ Pose2(motion.x * k / 20, motion.y * k / 20, motion.yaw * k / 20) for k in range(21)]
        late = round(self.delay * 100)
        measured = self.scan(path[10 - late : 21 - late], begin + (10 - late) * NS_PER_S // 100, REAR)
        second = self.changed(measured)
        if second is not None:
            self.mapper.now = second.stamp + NS_PER_S // 10
            self.take(self.mapper.second_scan(second))
        super().step(motion, with_odometry)

    def odometry(self, stamp, pose, v=0.0, w=0.0):
        super().odometry(stamp, Pose2(pose.x * self.odometry_scale, pose.y, pose.yaw), v, w)


def driven(segments=ROOM, motions=ROUND, **options):
    drive = TwoLaserDrive(segments, **options)
    for motion in motions:
        drive.step(motion)
    drive.publish_map()
    return drive


def away(drive):
    return hypot(drive.error.x, drive.error.y)


def test_the_map_shows_what_only_the_second_laser_has_seen():
    known = []
    for robot in (BOTH, FRONT_MAPS):
        drive = driven(robot=robot, motions=[Pose2()] * 5, noise=0.0)
        row, column = drive.grid.cell(-2.5, 1.0)  # behind the robot
        known.append(drive.grid.holds(row, column) and drive.grid.cells[row, column] >= 0)
    assert known == [True, False]


@pytest.mark.parametrize("delay", [0.0, 0.05, 0.1])
def test_scans_of_different_times_are_one_set_of_points(delay):
    drive = driven(motions=[arc(0.1, 0.25)] * 30, delay=delay)
    assert away(drive) < 0.02
    assert abs(drive.error.yaw) < 0.01
    assert {str(pose.state) for pose in drive.poses[1:]} == {"good"}
    assert all(pose.quality > 0.9 for pose in drive.poses[2:])


def test_the_second_laser_holds_the_pose_where_the_first_one_sees_a_bare_corridor():
    motions = [Pose2(0.1, 0.0, 0.0)] * 50
    off = [abs(driven(DEAD_END, motions, robot=robot, odometry_scale=1.08).error.x) for robot in (BOTH, FRONT_MAPS)]
    assert off[0] < 0.05
    assert off[1] > 0.15


def test_without_its_scans_the_poses_are_those_of_the_first_laser_to_the_byte():
    def poses(robot, silent):
        drive = TwoLaserDrive(ROOM, robot)
        if silent:
            drive.changed = lambda scan: None
        for motion in ROUND:
            drive.step(motion)
        return [repr(pose) for pose in drive.poses]

    assert poses(BOTH, silent=True) == poses(FRONT_MAPS, silent=False) == poses(FRONT_MAPS, silent=True)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_laser_that_is_turned_on_its_mount_is_left_out_and_used_again_when_it_fits(noise):
    drive = driven(noise=noise)
    drive.changed = lambda scan: replace(scan, ranges=np.roll(scan.ranges, 30))
    for motion in ROUND:
        drive.step(motion)
    assert away(drive) < 0.03
    assert "the second laser contradicts the first one" in drive.logs[-1]
    assert "without the second laser" in drive.mapper.state()
    assert str(drive.poses[-1].state) == "good"
    drive.changed = lambda scan: scan
    for motion in ROUND:
        drive.step(motion)
    assert away(drive) < 0.03
    assert drive.logs[-1] == "the second laser fits again: mapping with both lasers"
    assert "without" not in drive.mapper.state()


def test_a_laser_that_repeats_its_scan_does_not_hold_the_pose_back():
    drive = driven()
    first = []
    drive.changed = lambda scan: replace((first or first.append(scan) or first)[0], stamp=scan.stamp)
    for motion in ROUND:
        drive.step(motion)
        assert away(drive) < 0.03
    assert drive.mapper.rejections.counts["scan_2", "repeated"] > 0


def test_a_scan_that_is_too_old_for_the_first_lasers_is_not_used():
    drive = driven()
    drive.changed = lambda scan: replace(scan, stamp=scan.stamp - NS_PER_S // 2)
    drive.step(Pose2())
    assert not drive.mapper.slam.tracked.beams.has_second
    drive.changed = lambda scan: scan
    drive.step(Pose2())
    assert drive.mapper.slam.tracked.beams.has_second


def test_each_scan_of_the_second_laser_is_used_once():
    drive = driven()
    drive.changed = lambda scan: None
    drive.step(Pose2())
    assert not drive.mapper.slam.tracked.beams.has_second


def test_a_second_laser_that_is_not_for_mapping_changes_nothing():
    drive = driven(robot=FRONT_MAPS)
    assert not drive.mapper.slam.tracked.beams.has_second
    assert not any(key == "scan_2" for key, _ in drive.mapper.rejections.counts)


def test_without_odometry_both_lasers_are_matched():
    drive = driven()
    for motion in ROUND:
        drive.step(motion, with_odometry=False)
    assert "no odometry" in drive.mapper.state()
    assert away(drive) < 0.06


def test_warming_up_compiles_all_that_two_lasers_need():
    MapperService(MapperConfig(), BOTH).warm_up()
    before = {name: list(kernel.signatures) for name, kernel in kernels().items()}
    drive = driven()
    drive.changed = lambda scan: replace(scan, ranges=np.roll(scan.ranges, 30))
    drive.step(Pose2())
    assert {name: list(kernel.signatures) for name, kernel in kernels().items()} == before
