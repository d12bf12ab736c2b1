# SPDX-License-Identifier: Apache-2.0
"""What a process said of the right of way does not hold for ever after it."""

import numpy as np
import pytest

from services.local_ctrl.other_robots import LocalTraffic
from services.traffic.config import TrafficConfig
from services.traffic.service import TrafficService
from shared import sample_messages as sample
from shared import topics
from shared.config import load_robot
from shared.geometry import Pose2
from shared.messages import MapState
from tests.unit.services.traffic.intents import intent

S = 1_000_000_000
ROBOT = load_robot("x80sv").robot


def run(seconds, begin, blue_is_there):
    """The rights of way of a fresh process of red's, from `begin` on, ns."""
    service, told = TrafficService(TrafficConfig(), ROBOT.model_copy(update={"name": "red"})), []
    for now in range(begin, begin + round(seconds * S), S // 5):
        service.now = now
        list(service.map_state(MapState(now, 0, "office", ())))
        list(service.pose(sample.pose_estimate(now, Pose2())))
        if blue_is_there:
            list(service.heard(intent(now, at=Pose2(3.0, 0.0))))
        told += [effect.message for effect in service.tick() if effect.topic is topics.RIGHT_OF_WAY]
    return told


def test_a_robot_drives_on_where_traffic_is_started_again_and_the_others_are_gone():
    local = LocalTraffic()
    *_, local.right_of_way = run(1.0, S, blue_is_there=True)
    assert local.fault(10 * S) is not None
    for told in run(5.0, 10 * S, blue_is_there=False):
        local.right_of_way = told
    assert local.fault(15 * S) is None
    assert local.cleared(np.zeros((1, 2)), Pose2()) == np.inf


@pytest.mark.parametrize("blue_is_there", [True, False])
def test_a_fresh_process_calls_the_robot_alone_only_after_a_lease_without_another_one(blue_is_there):
    told = run(5.0, S, blue_is_there)
    assert {message.active for message in told} == {blue_is_there}
    assert len(told) > 20 if blue_is_there else [message.stamp for message in told] == [S + 11 * S // 5]
