# SPDX-License-Identifier: Apache-2.0
"""A robot whose pose is lost has no place to publish."""

import pytest

from shared.geometry import Pose2
from shared.messages import Localization
from tests.unit.services.traffic.intents import intent
from tests.unit.services.traffic.test_common_frame import Robot, S


@pytest.mark.parametrize("hears_another", [False, True])
def test_a_lost_robot_publishes_no_intent_until_it_is_found(hears_another):
    robot = Robot("red", Pose2(1.0, 2.0, 0.3))
    n_intents = []
    for k, state in enumerate([Localization.GOOD] * 10 + [Localization.LOST] * 10 + [Localization.POOR] * 10):
        now = S + k * S // 5
        if hears_another:
            robot.call("heard", now, intent(now))
        robot.step(now, state)
        n_intents.append(len(robot.intents))
    found, lost, found_again = n_intents[9], n_intents[19] - n_intents[9], n_intents[29] - n_intents[19]
    assert found > 0
    assert lost == 0
    assert found_again == found
