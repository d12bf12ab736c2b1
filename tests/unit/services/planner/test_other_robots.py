# SPDX-License-Identifier: Apache-2.0
"""The planner plans again where a robot that stands moved, or where this robot begins or ends to make way."""

import numpy as np
import pytest

from services.planner.other_robots import PlannerTraffic
from shared import sample_messages as sample
from shared.geometry import Pose2
from tests.unit.services.local_ctrl.test_other_robots import told


def standing(x):
    return told(3, closed_xs=np.float32([x]), closed_ys=np.float32([1.0]), closed_radii=np.float32([0.3]))


def test_a_robot_that_stands_is_a_polygon_and_its_noise_changes_nothing():
    traffic = PlannerTraffic()
    assert not traffic.update(told(3))
    assert traffic.update(standing(2.0))
    assert not traffic.update(standing(2.02))
    (polygon,) = traffic.polygons
    assert np.hypot(polygon[:, 0] - 2.0, polygon[:, 1] - 1.0) == pytest.approx(0.3)
    assert traffic.update(told(3))
    assert traffic.polygons == ()


def test_a_robot_that_makes_way_plans_to_its_refuge_and_back_to_its_goal():
    traffic, goal = PlannerTraffic(), sample.goal(0, 1, Pose2(5.0, 0.0, 1.0))
    assert traffic.goal(goal) is goal
    assert traffic.update(told(3, gives_way=True, refuge=Pose2(1.0, 2.0)))
    assert traffic.goal(goal).map_from_goal == Pose2(1.0, 2.0)
    assert traffic.update(told(3))
    assert traffic.goal(goal) is goal
