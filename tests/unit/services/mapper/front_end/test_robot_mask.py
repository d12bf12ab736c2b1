# SPDX-License-Identifier: Apache-2.0
"""Beams that end on another robot measure nothing; all others stay."""

from math import pi

import numpy as np
import pytest

from services.mapper.front_end.robot_mask import MAX_AGE_NS, RobotMask
from shared import sample_messages as sample
from shared.codec import CodecError, Envelope, decode, encode
from shared.config import load_robot
from shared.geometry import Pose2
from shared.messages import OtherRobots

NOW = 10**13
LASER = load_robot("x80sv").robot.laser
ROBOT = Pose2(3.0, 2.0, pi / 2)


def test_the_beams_on_a_robot_are_taken_out_and_no_others():
    scan = sample.scan(NOW, LASER, np.full(LASER.n_beams, 2.0, np.float32))
    ahead = ROBOT @ Pose2(LASER.mount.x + 2.0, LASER.mount.y)
    place = np.array([[ahead.x, ahead.x]], np.float32), np.array([[ahead.y, ahead.y]], np.float32)
    mask = RobotMask()
    assert mask.masked(scan, LASER.mount, ROBOT, NOW) is scan
    mask.others = OtherRobots(NOW, ("blue",), np.full(1, 0.3, np.float32), 0.25, *place)
    taken = np.asarray(mask.masked(scan, LASER.mount, ROBOT, NOW).ranges) == 0.0
    bearings = LASER.mount.yaw + LASER.angle_min + LASER.angle_increment * np.arange(LASER.n_beams)
    assert taken[np.cos(bearings) > np.cos(0.2)].all()
    assert not taken[np.cos(bearings) < np.cos(0.35)].any()
    assert mask.masked(scan, LASER.mount, ROBOT, NOW + 2 * MAX_AGE_NS) is scan, "too old"


def test_places_that_are_stamped_ahead_count_as_those_of_now():
    scan = sample.scan(NOW, LASER, np.full(LASER.n_beams, 2.0, np.float32))
    ahead = ROBOT @ Pose2(LASER.mount.x + 2.0, LASER.mount.y)
    goes_away = np.linspace(0.0, 9.0, 17, dtype=np.float32)[None]
    mask = RobotMask()
    stamp = NOW + MAX_AGE_NS // 2
    mask.others = OtherRobots(
        stamp,
        ("blue",),
        np.full(1, 0.3, np.float32),
        0.25,
        np.float32(ahead.x) + goes_away,
        np.float32(ahead.y) + goes_away,
    )
    assert (np.asarray(mask.masked(scan, LASER.mount, ROBOT, NOW).ranges) == 0.0).any()


def test_robots_without_a_place_are_refused_before_they_arrive():
    no_places = np.zeros((1, 0), np.float32)
    others = OtherRobots(NOW, ("blue",), np.full(1, 0.3, np.float32), 0.25, no_places, no_places)
    with pytest.raises(CodecError, match="robots without a place"):
        decode(OtherRobots, encode(others, Envelope("traffic", "t", 0, NOW)))
