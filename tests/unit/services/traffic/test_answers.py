# SPDX-License-Identifier: Apache-2.0
"""A new path is said at once, and driven on as soon as the others have answered: not at the next tick."""

import numpy as np

from services.traffic.config import TrafficConfig
from services.traffic.service import TrafficService
from shared import sample_messages as sample
from shared import topics
from shared.config import load_robot
from shared.geometry import Pose2
from shared.grid import update_of_cells
from shared.messages import MapState, Path
from tests.unit.services.traffic.intents import intent

S = 1_000_000_000


class Red:
    """Red on a free floor of 9.6 m, at (1.6, 1.6)."""

    def __init__(self):
        self.service = TrafficService(TrafficConfig(), load_robot("x80sv").robot.model_copy(update={"name": "red"}))
        self.call("map_state", S, MapState(S, 0, "office", ()))
        self.call("map", S, update_of_cells(np.zeros((192, 192), np.int8), 0.05, -3.2, -3.2))
        self.call("goal", S, sample.goal(S, 1, Pose2(4.6, 1.6)))
        self.call("pose", S, sample.pose_estimate(S, Pose2(1.6, 1.6)))

    def call(self, method, now, *arguments):
        """The messages that follow, by key."""
        self.service.now = now
        return {effect.topic.key: effect.message for effect in getattr(self.service, method)(*arguments)}

    def plan(self, now, x, y):
        """A plan straight to x, y."""
        xs, ys = np.linspace(1.6, x, 31), np.linspace(1.6, y, 31)
        return self.call("new_plan", now, Path(now, 1, 1, "", xs, ys, np.zeros(31), 3.0, 3.0))

    def blue(self, now, answer):
        return self.call("heard", now, intent(now, at=Pose2(-2.0, 5.0), heard=(("red", answer),)))


def test_a_new_path_is_said_at_once_and_driven_on_with_the_answer():
    red = Red()
    red.blue(S, 0)
    red.call("tick", S)
    said = red.plan(S + 1, 4.6, 1.6)
    claim = said[topics.INTENT.key].claim
    assert len(said[topics.INTENT.key].xs) > 5
    assert len(said[topics.RIGHT_OF_WAY.key].xs) <= 2, "blue has not heard of it"
    assert not red.blue(S + 2, claim - 1), "an answer to an older path"
    answered = red.blue(S + 3, claim)[topics.RIGHT_OF_WAY.key]
    assert len(answered.xs) > 5
    assert not red.blue(S + 4, claim), "nothing is missing any more"


def test_the_same_plan_again_says_nothing():
    red = Red()
    red.blue(S, 0)
    red.call("tick", S)
    red.plan(S + 1, 4.6, 1.6)
    assert not red.plan(S + 2, 4.6, 1.6)
