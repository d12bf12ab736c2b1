# SPDX-License-Identifier: Apache-2.0
"""A turn on the spot and a straight drive as tasks: by the amount, up to an obstacle, until they are canceled."""

from math import pi

import numpy as np
import pytest

from shared import reasons, requests, topics
from shared.geometry import wrapped
from shared.messages import EmergencyStop, NavState
from shared.requests import Cancel, ClearCostmaps, DriveStraight, Pause, Spin
from tests.lockstep.stack import LockstepStack

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here


@pytest.fixture
def stack(tmp_path):
    return LockstepStack(tmp_path)


def spin(stack, angle, seconds=0.0):
    return stack.lockstep.ask(requests.SPIN, Spin(stack.now, angle, seconds))


def drive(stack, distance, seconds=0.0):
    return stack.lockstep.ask(requests.DRIVE_STRAIGHT, DriveStraight(stack.now, distance, seconds))


def nav(stack):
    return stack.newest["nav/status"]


@pytest.mark.parametrize("angle", [pi / 2, -1.0, 2 * pi + 0.5])
def test_the_robot_turns_by_the_angle_and_stands(stack, angle):
    before = stack.truth.world_from_base
    assert spin(stack, angle).accepted
    stack.until(lambda: abs(nav(stack).distance_left) < abs(angle) / 2, 30.0)
    stack.until(stack.ended, 30.0)
    assert nav(stack).state is NavState.REACHED
    stack.lockstep.run(1.0)
    after = stack.truth.world_from_base
    assert abs(wrapped(after.yaw - before.yaw - angle)) < 0.1
    assert after.distance(before) < 0.1
    stack.stands_for(1.0)


@pytest.mark.parametrize("distance", [-0.3, 0.6])
def test_the_robot_drives_by_the_distance_and_stands(stack, distance):
    before = stack.truth.world_from_base
    assert drive(stack, distance).accepted
    stack.until(stack.ended, 30.0)
    assert nav(stack).state is NavState.REACHED
    stack.lockstep.run(1.0)
    there = before.inverse() @ stack.truth.world_from_base
    assert there.x == pytest.approx(distance, abs=0.05)
    assert abs(there.yaw) < 0.1


def test_the_robot_stops_before_a_wall_and_gives_the_reason(stack):
    assert drive(stack, -3.0).accepted  # the wall is a metre behind
    stack.until(stack.ended, 40.0)
    status = nav(stack)
    assert status.state is NavState.FAILED
    assert status.reason in (reasons.MOTION_BLOCKED.code, reasons.OBSTACLE.code)
    assert status.detail
    assert stack.truth.n_contacts == 0
    stack.stands_for(1.0)


def test_a_motion_that_takes_too_long_ends_with_the_reason(stack):
    assert drive(stack, 2.0, seconds=2.0).accepted
    stack.until(stack.ended, 5.0)
    assert nav(stack).reason == reasons.MOTION_TOO_LONG.code
    stack.lockstep.run(0.5)
    stack.stands_for(1.0)


def test_a_motion_is_canceled_and_is_not_paused(stack):
    assert spin(stack, 6.0).accepted
    stack.lockstep.run(1.0)
    assert not stack.lockstep.ask(requests.PAUSE, Pause(stack.now, True)).accepted
    assert stack.lockstep.ask(requests.CANCEL, Cancel(stack.now)).accepted
    assert nav(stack).state is NavState.CANCELED
    stack.lockstep.run(1.0)
    stack.stands_for(1.0)


def test_stop_ends_a_motion_and_refuses_another(stack):
    assert spin(stack, 6.0).accepted
    stack.lockstep.run(1.0)
    stack.lockstep.publish(topics.ESTOP(EmergencyStop(stack.now, True, "test")))
    stack.until(stack.ended, 2.0)
    assert nav(stack).state is NavState.CANCELED
    refused = spin(stack, 1.0)
    assert (refused.accepted, refused.reason) == (False, reasons.ESTOP.code)


def test_a_goal_takes_the_place_of_a_motion(stack):
    assert spin(stack, 6.0).accepted
    stack.lockstep.run(0.5)
    stack.go(1.5)
    stack.until(stack.reached, 40.0)


def test_a_robot_that_cannot_reverse_refuses_to_and_drives_ahead(tmp_path):
    stack = LockstepStack(tmp_path, settings=("robot.drive.max_reverse_speed=0",))
    assert drive(stack, -0.3).reason == reasons.NO_REVERSE.code
    assert drive(stack, 0.4).accepted
    stack.until(stack.ended, 30.0)
    assert nav(stack).state is NavState.REACHED


def test_cleared_costmaps_hold_nothing_until_the_next_scan(stack):
    costmap = stack.lockstep.service("local_ctrl").costmap
    stack.lockstep.run(1.0)
    assert costmap.evidence.any()
    assert stack.lockstep.ask(requests.CLEAR_COSTMAPS, ClearCostmaps(stack.now)).accepted
    assert not costmap.evidence.any()
    stack.lockstep.run(1.0)
    assert costmap.evidence.any()


def test_a_cleared_square_is_about_the_robot(stack):
    local_ctrl = stack.lockstep.service("local_ctrl")
    stack.lockstep.run(1.0)
    costmap, n_cells = local_ctrl.costmap, int((local_ctrl.costmap.evidence != 0).sum())
    assert stack.lockstep.ask(requests.CLEAR_COSTMAPS, ClearCostmaps(stack.now, 2.0)).accepted
    here = local_ctrl.inputs.odometry.odom_from_base
    rows, columns = np.nonzero(costmap.evidence)
    away = np.maximum(
        np.abs(costmap.x0 + columns * costmap.resolution - here.x),
        np.abs(costmap.y0 + rows * costmap.resolution - here.y),
    )
    assert 0 < len(rows) < n_cells
    assert away.min() > 1.0
