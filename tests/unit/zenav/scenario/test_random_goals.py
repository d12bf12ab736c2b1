# SPDX-License-Identifier: Apache-2.0
"""Random goals of one robot, in worlds that are made of answers."""

from types import SimpleNamespace

import numpy as np
import pytest

from shared.config import UserError, load_robot
from shared.geometry import Pose2
from shared.messages import NavState, NavStatus, Truth
from shared.requests import Reply
from zenav.scenario.path_finder import PathFinder
from zenav.scenario.random_goals import RandomGoals
from zenav.scenario.scenario import load_scenario


class IdleRobot:
    """Stands at 0 0, and takes every goal."""

    name, world_name, start, pose = "red", "hall", Pose2(), None
    nav = NavStatus(1, 0, NavState.IDLE, "", "", "", Pose2(), 0.0, 0.0, 0, 1, 0)
    truth = Truth(1, Pose2(), Pose2(), 0.0, 0.0, False, 0, 0.0, *[np.empty(0, np.float32)] * 2)

    def __init__(self) -> None:
        self.goals: list[Pose2] = []

    def now(self) -> int:
        return 1

    def ask(self, request, message) -> Reply:
        self.goals += message.poses
        return Reply(1, True, "", "", len(self.goals))


def goal_of(distances):
    robot, drawn = IdleRobot(), iter(distances)
    paths = SimpleNamespace(random_pose=lambda rng: Pose2(next(drawn)))
    RandomGoals(robot, paths, np.random.default_rng(0)).step()
    return robot.goals


def test_a_goal_is_the_first_one_far_enough():
    assert goal_of([1.0, 3.5, 9.0]) == [Pose2(3.5)]


def test_in_a_world_that_is_too_small_a_goal_is_the_farthest_one():
    assert goal_of(1.0 + k % 7 / 10 for k in range(5000)) == [Pose2(1.6)]


def test_a_world_without_room_to_turn_is_refused():
    paths = PathFinder(load_scenario("x80sv", "room", 0, []).world, load_robot("x80sv").robot)
    paths.clearance[:] = 0.05
    with pytest.raises(UserError, match="no place at which the robot can turn"):
        paths.random_pose(np.random.default_rng(0))
