# SPDX-License-Identifier: Apache-2.0
"""A goal that nobody can reach is refused in words, the robot stands, and the next goal is driven to."""

import pytest

from shared.reasons import REASONS
from tests.lockstep.stack import Stack

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here


@pytest.mark.parametrize(
    ("x", "y", "reason"), [(50.0, 50.0, "goal_outside"), (1e6, -1e6, "goal_outside"), (2.0, -1.5, "goal_blocked")]
)
def test_a_goal_outside_the_map_or_in_a_wall_is_told_and_the_next_one_is_reached(tmp_path, x, y, reason):
    stack = Stack(tmp_path)
    stack.go(x, y)
    stack.until(stack.ended, 10.0)
    assert not stack.reached()
    assert stack.newest["nav/status"].reason == reason
    assert REASONS[reason].mend
    stack.stands_for(1.0)
    stack.go(1.0)
    stack.until(stack.ended, 20.0)
    assert stack.reached()
    assert stack.truth.n_contacts == 0
