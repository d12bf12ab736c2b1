# SPDX-License-Identifier: Apache-2.0
"""A robot whose pose is lost holds nothing. Where it believes to be is of use to those that are lost too."""

import numpy as np
import pytest

from services.traffic.neighbours import LEASE_NS, Neighbours
from shared.geometry import Pose2
from shared.messages import Localization
from tests.unit.services.traffic.intents import intent
from tests.unit.services.traffic.test_common_frame import Robot, S

PATH = [(2.0, 0.0), (3.0, 0.0), (4.0, 0.0)]
BLUE = Pose2(1.5, 2.0, 0.0)


def robot_on_map():
    robot = Robot("red", Pose2(1.0, 2.0, 0.3))
    robot.service.map_name = "office"
    return robot


def hearing(state, *said):
    """A robot in a state that hears others for 3 s. said: the intents of each by time, ns."""
    robot = robot_on_map()
    for k in range(15):
        now = S + k * S // 5
        for intent_at in said:
            robot.call("heard", now, intent_at(now))
        robot.step(now, state)
    return robot


@pytest.mark.parametrize("hears_another", [False, True])
def test_a_robot_says_that_it_is_lost_until_it_is_found(hears_another):
    robot, said = robot_on_map(), []
    for k, state in enumerate([Localization.GOOD] * 10 + [Localization.LOST] * 10 + [Localization.POOR] * 10):
        now = S + k * S // 5
        if hears_another:
            robot.call("heard", now, intent(now))
        n = len(robot.intents)
        robot.step(now, state)
        said += [(state, sent) for sent in robot.intents[n:]]
    assert len(said) == (30 if hears_another else 6)
    assert all(sent.lost == (state is Localization.LOST) for state, sent in said)
    assert all(sent.held == len(sent.xs) == 0 for state, sent in said if sent.lost)


def test_a_lost_robot_counts_as_silent():
    neighbours = Neighbours()
    neighbours.hear(intent(0, path=PATH), 0)
    for now in range(S // 5, 2 * LEASE_NS, S // 5):
        neighbours.hear(intent(now, lost=True), now)
    assert neighbours.alive("office", now) == []
    assert [n.robot.name for n in neighbours.silent("office", now)] == ["blue"]
    assert [said.robot for said in neighbours.lost("office", now)] == ["blue"]
    assert neighbours.lost("lab", now) == []
    assert neighbours.lost("office", now + LEASE_NS) == []
    neighbours.hear(intent(now), now)
    assert [n.robot.name for n in neighbours.alive("office", now)] == ["blue"]
    assert neighbours.lost("office", now) == []


def lost_blue(now):
    return intent(now, at=BLUE, lost=True)


def test_a_lost_robot_leaves_other_lost_robots_out_of_its_scans():
    others = hearing(Localization.LOST, lost_blue).others
    assert others.names == ("blue",)
    assert np.allclose((others.xs[0], others.ys[0]), [[BLUE.x], [BLUE.y]])


def test_a_robot_that_knows_its_place_takes_no_account_of_lost_robots():
    robot = hearing(Localization.GOOD, lost_blue)
    assert robot.others is None
    assert not robot.service.is_active


def test_a_lost_robot_hears_found_and_lost_ones():
    robot = hearing(Localization.LOST, lost_blue, lambda now: intent(now, name="green", at=Pose2(0.0, 1.0, 0.0)))
    assert robot.others.names == ("green", "blue")
    assert robot.others.problem() is None
