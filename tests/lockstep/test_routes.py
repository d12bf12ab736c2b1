# SPDX-License-Identifier: Apache-2.0
"""The robot stops where it must and nowhere else: poses are passed, and a new goal ahead is taken at speed."""

import pytest

from shared import requests
from shared.geometry import Pose2
from shared.requests import Navigate
from tests.lockstep.stack import QUICK, LockstepStack

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here


def test_a_pose_on_the_way_is_passed_and_a_new_goal_ahead_is_taken_at_speed(tmp_path):
    stack = LockstepStack(tmp_path, settings=QUICK)
    speeds: list[tuple[float, float]] = []
    stack.lockstep.watch("sim/truth", lambda truth: speeds.append((truth.world_from_base.x, truth.v)))
    poses = (Pose2(1.5, 0.0), Pose2(6.0, 0.0))
    assert stack.lockstep.ask(requests.NAVIGATE, Navigate(stack.now, poses, 0.0, 1, True)).accepted
    stack.until(lambda: stack.newest["nav/status"].waypoint == 1, 8.0)
    stack.drives()
    assert min(v for x, v in speeds if x > 1.2) > 0.3, "it slows down for a pose that is not the last"
    speeds.clear()
    stack.go(6.8, 0.4)
    stack.lockstep.run(1.5)
    assert min(v for _, v in speeds) > 0.7
    assert stack.truth.n_contacts == 0


def test_every_pose_of_a_route_with_headings_is_driven_to(tmp_path):
    stack = LockstepStack(tmp_path, settings=QUICK)
    nearest = [9.0, 9.0, 9.0]
    poses = (Pose2(1.5, 0.0, 0.0), Pose2(3.0, 0.0, 0.0), Pose2(2.0, 0.0, 0.0))

    def passes(truth):
        place = Pose2(-1.0, -2.0, 0.0) @ truth.world_from_base
        waypoint = stack.newest["nav/status"].waypoint
        nearest[waypoint] = min(nearest[waypoint], place.distance(poses[waypoint]))

    stack.lockstep.run(0.1)
    stack.lockstep.watch("sim/truth", passes)
    assert stack.lockstep.ask(requests.NAVIGATE, Navigate(stack.now, poses, 0.0, 1, False)).accepted
    stack.until(stack.reached, 60.0)
    assert max(nearest) < 0.25, "a pose counted as reached where the robot never was"
    assert stack.truth.n_contacts == 0
