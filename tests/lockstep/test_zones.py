# SPDX-License-Identifier: Apache-2.0
"""A robot with a minimum turning radius, and zones that are set while it drives.

It drives around the keep-out zone and slowly through the speed zone. A goal in the keep-out zone is refused. It
reaches its goal with the heading, and no command is tighter than the radius.
"""

from math import pi

import pytest

from shared import requests
from shared.geometry import Pose2, wrapped
from shared.requests import Navigate, SetZones
from shared.zones import ZoneConfig
from tests.lockstep.stack import LockstepStack

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here

RADIUS = 0.5
CAR = (
    f"robot.drive.min_turning_radius={RADIUS}",
    "robot.drive.turns_in_place=false",
    "local_ctrl.controller=pursuit",
)


def test_in_arcs_like_a_car_s_zones_set_under_way_are_kept_out_of_and_slow(tmp_path):
    stack = LockstepStack(tmp_path, settings=CAR)
    driven: list[tuple[float, float, float]] = []
    commands: list[tuple[float, float]] = []
    goal = Pose2(4.6, 0.2, pi / 2)
    assert stack.lockstep.ask(requests.NAVIGATE, Navigate(stack.now, (goal,), 0.0, 1, False)).accepted
    for key in ("cmd/nav", "cmd/vel"):
        stack.lockstep.watch(key, lambda command: commands.append((abs(command.v), abs(command.w))))
    stack.drives(0.3)
    keep = ZoneConfig(corners=((2.2, -0.4), (2.6, -0.4), (2.6, 3.0), (2.2, 3.0))).zone("stairs")
    slow = ZoneConfig(corners=((3.2, -3.0), (3.8, -3.0), (3.8, 3.0), (3.2, 3.0)), speed=0.3).zone("hall")
    assert stack.lockstep.ask(requests.SET_ZONES, SetZones(stack.now, (keep, slow))).accepted
    into = Navigate(stack.now, (Pose2(2.4, 0.0, 0.0),), 0.0, 1, True)
    assert stack.lockstep.ask(requests.NAVIGATE, into).reason == "goal_keep_out"
    told = set()
    stack.lockstep.watch("nav/status", lambda nav: told.add(nav.reason))
    stack.lockstep.watch("sim/truth", lambda truth: driven.append((*xy(truth), truth.v)))
    stack.until(stack.ended, 60.0)
    assert stack.reached()
    assert stack.truth.n_contacts == 0
    assert max(y for x, y, _ in driven if 2.1 < x < 2.7) < -0.4 - 0.2
    assert max(v for x, _, v in driven if 3.25 < x < 3.75) < 0.34
    assert "speed_zone" in told
    there = stack.truth.start.inverse() @ stack.truth.world_from_base
    assert there.distance(goal) < 0.2
    assert abs(wrapped(there.yaw - goal.yaw)) < 0.3
    assert len(commands) > 100
    assert all(w <= v / RADIUS + 1e-6 for v, w in commands)


def xy(truth):
    """m, in `map`, whose origin is the robot's start."""
    pose = truth.start.inverse() @ truth.world_from_base
    return pose.x, pose.y
