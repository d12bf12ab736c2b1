# SPDX-License-Identifier: Apache-2.0
"""Robots that hear each other pass a door one after the other; a dead one and a cut network leave no contact."""

from math import pi

import numpy as np
import pytest

from shared import requests, topics
from shared.geometry import Pose2
from shared.messages import NavState
from shared.requests import Navigate
from shared.task_state import FINAL_STATES
from tests.lockstep.stack import QUICK
from tests.lockstep.test_two_robots import assert_replays
from zenav.scenario.path_finder import PathFinder
from zenav.scenario.random_goals import RandomGoals, place
from zenav.scenario.robot_group import RobotGroup

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here

TWO_ROOMS = """
start: {x: 1.5, y: 2.0}
walls:
  - {points: [[0, 0], [9, 0], [9, 4], [0, 4]], closed: true}
  - {points: [[4.5, 0], [4.5, 1.5]]}
  - {points: [[4.5, 2.5], [4.5, 4]]}
boxes:
  - {x: 0.3, y: 3.5, size: [0.5, 0.6]}
  - {x: 8.6, y: 0.4, size: [0.5, 0.5]}
goals:
  - {name: right, x: 7.0, y: 2.0}
"""
LEFT, RIGHT = Pose2(1.5, 2.0, 0.0), Pose2(7.5, 2.0, pi)


class TwoRooms:
    """Red in the left room and blue in the right one, each with the map, and a door of 1 m between the rooms."""

    def __init__(self, tmp_path):
        path = tmp_path / "rooms.yaml"
        path.write_text(TWO_ROOMS)
        self.robots = RobotGroup(
            "x80sv", str(path), ("red", "blue"), settings=QUICK, starts=(LEFT, RIGHT), folder=tmp_path
        )
        self.red, self.blue = self.robots.members
        self.reasons = {"red": set(), "blue": set()}
        self.told = {}
        for member in self.robots.members:
            reasons = self.reasons[member.name]
            member.lockstep.watch(topics.NAV_STATUS.key, lambda nav, to=reasons: to.add((nav.reason, nav.detail)))
            member.lockstep.watch(topics.RIGHT_OF_WAY.key, lambda told, of=member.name: self.told.update({of: told}))
        paths = PathFinder(self.robots.world, self.red.scenario.file.robot)
        drivers = [RandomGoals(member, paths, np.random.default_rng(0)) for member in self.robots.members]
        place(drivers, paths, self.robots.run)

    def go(self, member, goal):
        assert member.ask(requests.NAVIGATE, Navigate(member.now(), (goal,), 0.0, 1, True)).accepted

    def until(self, holds, seconds):
        for _ in range(round(seconds / 0.2)):
            self.robots.run(0.2)
            assert [member.truth.n_contacts for member in self.robots.members] == [0, 0]
            if holds():
                return True
        return False


def test_two_robots_swap_rooms_through_a_door_and_each_recording_replays(tmp_path):
    rooms = TwoRooms(tmp_path)
    with rooms.robots:
        rooms.go(rooms.red, Pose2(7.0, 3.2))
        rooms.go(rooms.blue, Pose2(2.0, 0.8))
        assert rooms.until(lambda: all(m.nav.state in FINAL_STATES for m in rooms.robots.members), 40.0)
        assert [member.nav.state for member in rooms.robots.members] == [NavState.REACHED] * 2
    waited = {
        (name, detail) for name, seen in rooms.reasons.items() for reason, detail in seen if reason == "right_of_way"
    }
    assert waited & {("blue", "waits for red"), ("red", "waits for blue")}, "one of them waited, and says so"
    for member in rooms.robots.members:
        assert_replays(tmp_path / f"{member.name}.mcap", member.scenario.file, ("traffic", "planner", "navigator"))


def test_a_robot_that_dies_in_the_door_is_an_obstacle_and_its_lease_ends(tmp_path):
    rooms = TwoRooms(tmp_path)
    with rooms.robots:
        rooms.go(rooms.blue, Pose2(2.0, 0.8))
        assert rooms.until(lambda: abs(rooms.blue.truth.world_from_base.x - 4.5) < 0.15, 20.0)
        rooms.blue.die()
        rooms.go(rooms.red, Pose2(7.0, 3.2))
        assert rooms.until(lambda: rooms.red.nav.state in FINAL_STATES, 60.0), "it does not wait for ever"
    assert rooms.red.nav.state is NavState.FAILED, "no other way leads there"
    assert len(rooms.told["red"].closed_xs) == 1
    assert "blue" not in rooms.told["red"].waits_for


def test_robots_whose_network_is_cut_before_a_door_are_careful_and_do_not_touch(tmp_path):
    rooms = TwoRooms(tmp_path)
    with rooms.robots:
        shares = []
        rooms.red.lockstep.watch(topics.RIGHT_OF_WAY.key, lambda told: shares.append(told.speed_share))
        rooms.go(rooms.red, Pose2(7.0, 3.2))
        rooms.go(rooms.blue, Pose2(2.0, 0.8))
        rooms.until(lambda: False, 1.0)
        rooms.robots.hears = lambda speaker, listener: False
        rooms.until(lambda: False, 15.0)
        assert min(shares) < 1.0, "it is careful where the other was going"
        rooms.robots.hears = lambda speaker, listener: True
        assert rooms.until(lambda: all(m.nav.state in FINAL_STATES for m in rooms.robots.members), 90.0)
