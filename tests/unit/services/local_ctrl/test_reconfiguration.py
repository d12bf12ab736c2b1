# SPDX-License-Identifier: Apache-2.0
"""Local control takes settings while it drives: limits and costs change, its costmap and last solution stay."""

import numpy as np
import pytest

from services.local_ctrl.config import CONTROLLERS
from services.local_ctrl.service import LocalCtrlService
from services.local_ctrl.warm_up import drive
from shared.config import load_robot
from shared.requests import SetSettings
from tests.unit.services.local_ctrl.tiny_world import QUICK

ROBOT = load_robot("x80sv").robot


def changed(service: LocalCtrlService, **values: str) -> None:
    names = tuple(name.replace("__", ".") for name in values)
    list(service.set_settings(SetSettings(service.now, names, tuple(values.values()), False)))
    assert [name in service.run_time for name in names] == [bool(text) for text in values.values()]


def driving(controller: str) -> LocalCtrlService:
    service = LocalCtrlService(QUICK.model_copy(update={"controller": controller}), ROBOT)
    service.name = "local_ctrl"
    drive(service)
    return service


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_a_lower_speed_reaches_every_part_and_the_costmap_stays(controller):
    service = driving(controller)
    before, costmap, size = service.path_follower.controller, service.costmap, service.costmap.field.shape
    content = costmap.hit_at.copy()
    changed(service, local_ctrl__max_speed="0.3", robot__drive__max_turn_rate="0.5")
    controller_now = service.path_follower.controller
    for limits in (service.limits, controller_now.limits, service.path_follower.limits, service.estimate.limits):
        assert (limits.v_max, limits.w_max) == (0.3, 0.5)
    assert type(controller_now) is type(before)
    assert controller_now.n_solved == before.n_solved
    assert service.costmap is costmap
    assert costmap.field.shape == size
    np.testing.assert_array_equal(costmap.hit_at, content)


def test_mppi_continues_from_its_last_solution_with_the_new_weights():
    service = driving("mppi")
    service.path_follower.controller.mean[:] = 0.25, 0.1
    changed(service, local_ctrl__mppi__critics__obstacle="7", local_ctrl__mppi__clearance="0.6")
    mppi = service.path_follower.controller
    assert (mppi.weights.obstacle, mppi.weights.clearance) == (7.0, 0.6)
    assert np.all(mppi.mean == (0.25, 0.1))


def test_settings_that_are_reset_are_those_of_the_start():
    service = driving("mppi")
    changed(service, local_ctrl__max_speed="0.3")
    changed(service, local_ctrl__max_speed="")
    assert service.config == service.started.config
    assert service.limits.v_max == ROBOT.drive.max_speed


def test_range_sensors_and_dynamic_obstacles_are_switched_off_at_once():
    service = driving("mppi")
    assert service.ranges_wanted.any()
    changed(service, local_ctrl__costmap__ultrasonic="false", local_ctrl__costmap__infrared="false")
    assert not service.ranges_wanted.any()
    changed(service, local_ctrl__costmap__dynamic_obstacles__enabled="true")
    service.costmap.dynamic_obstacles.by_key["scan"].all.append(object())
    changed(service, local_ctrl__costmap__dynamic_obstacles__enabled="false")
    assert service.costmap.dynamic_obstacles.by_key["scan"].all == []
