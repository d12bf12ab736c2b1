# SPDX-License-Identifier: Apache-2.0
"""The whole stack with bumpers, cliff sensors and a hardware e-stop, on the virtual clock."""

import numpy as np

from shared import requests, topics
from shared.messages import GuardState
from shared.polygon import signed_distances
from shared.requests import Break
from tests.lockstep.stack import HALL, MS, LockstepStack

SENSORS = (
    "robot.bumpers=[{name: front, bearing: 0, width: 2.5}, {name: back, bearing: 3.14159, width: 2.5}]",
    "robot.cliffs=[{name: left, x: 0.18, y: 0.09}, {name: ahead, x: 0.2, y: 0}, {name: right, x: 0.18, y: -0.09}]",
    "robot.estop_input=true",
    "robot.imu={}",
)
HOLE = np.array([[4.5, 1.7], [4.9, 1.7], [4.9, 2.3], [4.5, 2.3]])
HALL_WITH_HOLE = HALL + f"cliffs:\n  - {{points: {HOLE.tolist()}}}\n"


def broken(stack: LockstepStack, fault: str, seconds: float = 0.0, mended: bool = False) -> None:
    assert stack.lockstep.ask(requests.FAULT, Break(stack.now, fault, seconds, mended)).accepted


def test_with_these_sensors_the_robot_arrives_as_without(tmp_path):
    stack = LockstepStack(tmp_path, settings=SENSORS)
    stack.go(7.0)
    stack.until(stack.reached, 40.0)
    assert stack.truth.n_contacts == 0


def test_a_bumper_stops_a_robot_at_full_speed_within_a_tick_and_it_backs_off_and_drives_around(tmp_path):
    stack = LockstepStack(tmp_path, settings=SENSORS)
    stack.go(7.0)
    stack.drives()
    broken(stack, "bumper", 1.0)
    assert stack.until(lambda: not stack.commanded, 1.0) <= 100 * MS  # the board hears of it at its next tick
    assert stack.guard.reason == "bumper"
    at = stack.truth.world_from_base.x
    stack.until(lambda: stack.truth.v < -0.05, 10.0)
    stack.until(stack.reached, 60.0)
    assert stack.truth.world_from_base.x > at
    assert stack.truth.n_contacts == 0


def test_a_robot_stops_before_a_hole_that_no_laser_sees_and_drives_around_it(tmp_path):
    slow = "robot.drive.max_speed=0.4"  # so that it stands within what its cliff sensors look ahead
    stack = LockstepStack(tmp_path, world=HALL_WITH_HOLE, settings=(*SENSORS, slow))

    def look(truth):
        here = truth.world_from_base
        nearest.append(float(signed_distances(HOLE, np.array([[here.x, here.y]]))[0]))

    nearest: list[float] = []
    held: list[str] = []
    stack.lockstep.watch(topics.TRUTH.key, look)
    stack.lockstep.watch(topics.GUARD.key, lambda status: held.append(status.reason))
    stack.go(7.0)
    stack.until(stack.reached, 120.0)
    assert min(nearest) > 0.05  # the axis of the wheels stays on the floor
    assert "cliff" in held


def test_the_button_stops_and_its_release_moves_nothing(tmp_path):
    stack = LockstepStack(tmp_path, settings=SENSORS)
    stack.go(7.0)
    stack.drives()
    broken(stack, "estop_input", 2.0)
    assert stack.until(lambda: not stack.commanded, 1.0) <= 100 * MS
    assert (stack.guard.state, stack.guard.reason) == (GuardState.STOPPED, "estop_input")
    stack.lockstep.run(1.5)
    stack.stands_for(3.0)
    assert (stack.guard.state, stack.guard.reason) == (GuardState.STOPPED, "estop")
    stack.stop(False)
    stack.stands_for(3.0)
    stack.go(7.0)
    stack.until(stack.reached, 40.0)


def test_silent_contacts_stop_the_robot_and_it_goes_on_by_itself(tmp_path):
    stack = LockstepStack(tmp_path, settings=SENSORS)
    stack.go(7.0)
    stack.drives()
    broken(stack, "contacts_silent", 1.5)
    assert stack.until(lambda: not stack.commanded, 1.0) <= 400 * MS
    assert stack.guard.reason == "contacts_old"
    stack.until(stack.reached, 40.0)


def test_a_silent_inertial_sensor_leaves_the_wheels(tmp_path):
    stack = LockstepStack(tmp_path, settings=SENSORS)
    stack.go(7.0)
    stack.drives()
    broken(stack, "imu_silent", 3.0)
    stack.until(stack.reached, 40.0)
    assert stack.truth.n_contacts == 0
