# SPDX-License-Identifier: Apache-2.0
"""What a board measures beside its wheels, as messages."""

import pytest

from services.base_driver.boards.device import BoardInput
from services.base_driver.body_sensors import BodySensors
from shared import topics
from shared.config import load_robot

ROBOT = load_robot("turtlebot2").robot


@pytest.mark.parametrize(("has_gyro", "keys"), [(True, [topics.IMU.key]), (False, [])])
def test_a_gyro_is_published_unless_it_is_switched_off(has_gyro, keys):
    received = BoardInput()
    received.yaw_rate = 0.25
    assert [publication.topic.key for publication in BodySensors(ROBOT, has_gyro).publications(received, 10**9)] == keys
