# SPDX-License-Identifier: Apache-2.0
"""Board and laser both as bytes on wires: the drivers meet what they meet on the robot."""

from pathlib import Path

import pytest

from shared import requests
from shared.requests import Break
from tests.lockstep.stack import MS, STACK, Stack

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here

EMULATED = ("sim.hardware=emulated", "base_driver.port.device=wired", "lidar_driver.port.device=wired")


def wired(folder: Path) -> Stack:
    return Stack(folder, settings=EMULATED, names=(*STACK, "lidar_driver"))


def test_on_emulated_hardware_the_robot_reaches_its_goal(tmp_path):
    stack = wired(tmp_path)
    stack.go(6.5, 0.5)
    stack.until(stack.reached, 30.0)
    assert stack.truth.n_contacts == 0
    assert stack.truth.distance > 5.5


@pytest.mark.parametrize("fault", ["laser_stopped", "laser_unplugged"])
def test_without_the_laser_the_robot_stands_until_it_is_back(tmp_path, fault):
    stack = wired(tmp_path)
    stack.go(6.5)
    stack.drives()
    assert stack.lockstep.ask(requests.FAULT, Break(stack.now, fault, 3.0, False)).accepted
    assert stack.until(lambda: not stack.commanded, 1.0) <= 300 * MS
    stack.lockstep.run(0.2)
    assert stack.guard.reason == "scan_old"
    stack.until(stack.reached, 40.0)
    assert stack.truth.n_contacts == 0
