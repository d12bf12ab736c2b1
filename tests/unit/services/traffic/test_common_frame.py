# SPDX-License-Identifier: Apache-2.0
"""The frame of robots that explore together: they hear each other although each one has a map of its own."""

from dataclasses import replace

import numpy as np
import pytest

from services.traffic.common_frame import EXPLORES_NS, CommonFrame, common_frame, moved_intent
from services.traffic.config import TrafficConfig
from services.traffic.service import TrafficService
from shared import sample_messages as sample
from shared import topics
from shared.config import load_robot
from shared.geometry import Pose2
from shared.messages import Localization
from tests.unit.services.traffic.intents import intent

S = 1_000_000_000
ROBOT = load_robot("x80sv").robot


class Robot:
    """The traffic of one robot that stands in its own map."""

    def __init__(self, name, pose):
        self.service = TrafficService(TrafficConfig(), ROBOT.model_copy(update={"name": name}))
        self.pose, self.intents, self.others = pose, [], None

    def call(self, method, now, *arguments):
        self.service.now = now
        for effect in getattr(self.service, method)(*arguments):
            if effect.topic is topics.INTENT:
                self.intents.append(effect.message)
            elif effect.topic is topics.OTHER_ROBOTS:
                self.others = effect.message

    def step(self, now, state=Localization.GOOD):
        self.call("pose", now, replace(sample.pose_estimate(now, self.pose), state=state))
        self.call("tick", now)


def test_robots_that_explore_together_are_where_they_are_in_each_others_map():
    common_from_red, common_from_blue = Pose2(3.0, 1.0, 0.5), Pose2(-2.0, 4.0, -1.2)
    red, blue = Robot("red", Pose2(1.0, 2.0, 0.3)), Robot("blue", Pose2(0.5, -1.0, 2.0))
    red.call("explores", S, sample.exploration_share(S, "red", ("blue",), common_from_red))
    blue.call("explores", S, sample.exploration_share(S, "blue", ("red",), common_from_blue))
    for k in range(1, 8):
        now = S + k * S // 5
        for robot, other in ((red, blue), (blue, red)):
            robot.step(now)
            for message in robot.intents:
                other.call("heard", now, message)
            robot.intents.clear()
    seen = common_from_blue @ blue.pose
    expected = common_from_red.inverse() @ seen
    assert red.others.names == ("blue",)
    assert (red.others.xs[0, 0], red.others.ys[0, 0]) == pytest.approx((expected.x, expected.y), abs=1e-5)


def test_a_robot_that_ended_its_exploration_shares_no_frame():
    told = sample.exploration_share(S, "red", ("green", "blue"), Pose2(1.0, 0.0, 0.0))
    assert common_frame("red", "", told, 2 * S) == CommonFrame("explored by blue, green, red", Pose2(1.0, 0.0, 0.0))
    assert common_frame("red", "", told, S + EXPLORES_NS) == CommonFrame()
    assert common_frame("red", "office", told, 2 * S) == CommonFrame("office")


def test_an_intent_moves_to_another_frame_and_back():
    told = intent(S, at=Pose2(1.0, 2.0, 0.5), path=[(1.0, 2.0), (2.0, 2.0)])
    there = Pose2(4.0, -3.0, 1.5)
    moved = moved_intent(moved_intent(told, there), there.inverse())
    np.testing.assert_allclose(moved.xs, told.xs, atol=1e-5)
    np.testing.assert_allclose(moved.ys, told.ys, atol=1e-5)
    assert moved_intent(told, Pose2()) is told
