# SPDX-License-Identifier: Apache-2.0
"""Zones that are set while the robot drives: around the one, slowly through the other, and no goal in a third."""

import pytest

from shared import requests
from shared.geometry import Pose2
from shared.requests import Navigate, SetZones
from shared.zones import ZoneConfig
from tests.lockstep.stack import Stack

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here


def test_zones_set_under_way_are_kept_out_of_and_slow(tmp_path):
    stack = Stack(tmp_path, settings=("local_ctrl.mppi.rollouts=200",))
    driven: list[tuple[float, float, float]] = []
    stack.go(6.5)
    stack.drives()
    keep = ZoneConfig(corners=((2.6, -0.5), (3.2, -0.5), (3.2, 3.0), (2.6, 3.0))).zone("stairs")
    slow = ZoneConfig(corners=((4.0, -3.0), (5.5, -3.0), (5.5, 3.0), (4.0, 3.0)), speed=0.3).zone("hall")
    assert stack.lockstep.ask(requests.SET_ZONES, SetZones(stack.now, (keep, slow))).accepted
    into = Navigate(stack.now, (Pose2(3.0, 0.0, 0.0),), 0.0, 1, True)
    assert stack.lockstep.ask(requests.NAVIGATE, into).reason == "goal_keep_out"
    told = set()
    stack.lockstep.watch("nav/status", lambda nav: told.add(nav.reason))
    stack.lockstep.watch("sim/truth", lambda truth: driven.append((*xy(truth), truth.v)))
    stack.until(stack.ended, 40.0)
    assert stack.reached()
    assert stack.truth.n_contacts == 0
    assert max(y for x, y, _ in driven if 2.4 < x < 3.4) < -0.5 - 0.2
    assert max(v for x, _, v in driven if 4.05 < x < 5.45) < 0.34
    assert max(v for x, _, v in driven if x > 5.8) > 0.5
    assert "speed_zone" in told


def xy(truth):
    """m, in `map`, whose origin is the robot's start."""
    pose = truth.start.inverse() @ truth.world_from_base
    return pose.x, pose.y
