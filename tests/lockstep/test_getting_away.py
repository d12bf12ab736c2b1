# SPDX-License-Identifier: Apache-2.0
"""What stands close beside the robot does not hold it for ever."""

from math import cos, radians, sin

import pytest

from tests.lockstep.stack import LockstepStack

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here

ROOM = """
start: {{x: 1.5, y: 2.0}}
walls:
  - {{points: [[0, 0], [7, 0], [7, 4], [0, 4]], closed: true}}
cylinders:
  - {{x: {x}, y: {y}, radius: 0.25}}
"""


@pytest.mark.parametrize("bearing", [0, 67, 90])
def test_a_robot_with_a_cylinder_a_centimetre_from_its_body_gets_to_its_goal(tmp_path, bearing):
    reach = 0.2175 if bearing == 67 else 0.2  # of the outline: a corner, a side
    away = reach + 0.25 + 0.01
    x, y = 1.5 + away * cos(radians(bearing)), 2.0 + away * sin(radians(bearing))
    stack = LockstepStack(tmp_path, ROOM.format(x=x, y=y), settings=("navigator.leg.progress_time=2",))
    stack.go(2.5)
    stack.until(stack.ended, 90.0)
    assert stack.reached()
    assert stack.truth.n_contacts == 0
