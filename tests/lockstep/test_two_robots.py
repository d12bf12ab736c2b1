# SPDX-License-Identifier: Apache-2.0
"""Robots in one world: each laser sees the others, bodies touch, and each robot's recording replays to the byte."""

from math import pi

import numpy as np
import pytest

from services.sim.drive import wheel_targets
from shared import requests, topics
from shared.config import UserError, configured
from shared.geometry import Pose2
from shared.messages import MotorCommand, Velocity
from shared.recording import Recording
from shared.requests import Navigate
from shared.runners.replay import replay
from tests.lockstep.stack import QUICK
from zenav.scenario.robot_group import RobotGroup
from zenav.scenario.shared_world import start_poses
from zenav.stack.hardware import simulated_world
from zenav.stack.service_loader import build_service

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here


def group(tmp_path, *starts):
    """The robots have names of their own, whatever `--name` says."""
    return RobotGroup("green@x80sv", "room", ("red", "blue"), settings=QUICK, starts=starts, folder=tmp_path)


def facing(tmp_path, gap):
    """Two robots in the room, `gap` m from middle to middle, that face each other."""
    return group(tmp_path, Pose2(1.5, 1.0, 0.0), Pose2(1.5 + gap, 1.0, pi))


def ahead(scan, laser):
    """m to what is straight ahead of the laser."""
    bearings = laser.mount.yaw + scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
    return float(np.nanmin(scan.ranges[np.cos(bearings) > np.cos(0.05)]))


def test_each_robot_measures_the_other_where_it_is(tmp_path):
    scans = {}
    with facing(tmp_path, 1.5) as robots:
        for member in robots.members:
            member.lockstep.watch(topics.SCAN.key, lambda scan, of=member.name: scans.update({of: scan}))
        robots.run(2.0)
    body = robots.members[0].scenario.file.robot
    front, laser_x = float(body.corners[:, 0].max()), body.laser.mount.x
    for name in ("red", "blue"):
        assert ahead(scans[name], body.laser) == pytest.approx(1.5 - front - laser_x, abs=0.05)


def test_a_robot_that_is_driven_towards_another_is_stopped_by_its_guard(tmp_path):
    with facing(tmp_path, 1.5) as robots:
        red = robots.members[0]
        robots.run(2.0)
        for _ in range(100):
            red.lockstep.publish(topics.TELEOP(Velocity(red.lockstep.now, 0.3, 0.0, "")))
            robots.run(0.04)
    assert red.truth.world_from_base.x > 1.6, "it drove"
    assert [member.truth.n_contacts for member in robots.members] == [0, 0]


def test_robots_that_touch_feel_it_both_and_get_apart_again(tmp_path):
    with facing(tmp_path, 1.5) as robots:
        red, blue = robots.members
        robots.run(0.5)
        red.lockstep.kill("base_driver")  # it would command zero
        for _ in range(80):
            robots.run(0.05)
            push(red, 4.0)
        assert [member.truth.n_contacts for member in robots.members] == [1, 1]
        at = red.truth.world_from_base.x
        for _ in range(20):
            robots.run(0.05)
            push(red, -4.0)
        assert red.truth.world_from_base.x < at - 0.1
        assert not red.truth.contact
        assert not blue.truth.contact


def push(member, speed):
    """Turns the wheels past all services, rad/s."""
    per_count = wheel_targets(1.0, 1.0, member.scenario.file.robot.drive)
    command = MotorCommand(member.lockstep.now, *(speed / turn for turn in per_count))
    member.lockstep.publish(topics.MOTORS(command), "base_driver")


def test_each_robots_recording_replays_to_the_byte_with_the_others_in_it(tmp_path):
    with facing(tmp_path, 2.9) as robots:
        robots.run(2.0)
        red, blue = robots.members
        navigate = Navigate(red.lockstep.now, (Pose2(1.5, 0.0),), 0.0, 1, True)
        assert red.lockstep.ask(requests.NAVIGATE, navigate).accepted
        robots.run(3.0)
        assert red.truth.world_from_base.x > 2.0, "it drove"
        assert blue.truth.n_contacts == 0
    for member in robots.members:
        assert_replays(tmp_path / f"{member.name}.mcap", member.scenario.file, ("sim", "local_ctrl"))


def assert_replays(path, file, names):
    done = replay(Recording(path), list(names), lambda name: build_service(name, file, file.robot))
    assert not done.gaps
    for name in names:
        assert done.sent[name]
        for sent in done.sent[name]:
            assert done.recorded[sent.key, sent.envelope.session][sent.envelope.sequence] == sent.payload


def test_a_world_without_room_for_so_many_is_named():
    world = simulated_world(configured("x80sv", ["sim.world=room"]))
    with pytest.raises(UserError, match="world room has room for"):
        start_poses(world, 200, 0.3)
    starts = start_poses(world, 4, 0.3)
    assert starts[0] == world.start
    assert min(a.distance(b) for a in starts for b in starts if a is not b) >= 1.2
