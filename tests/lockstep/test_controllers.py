# SPDX-License-Identifier: Apache-2.0
"""The whole stack drives to a goal by each controller, around what stands in the way; MPPI does in the other tests."""

import pytest

from tests.lockstep.stack import LockstepStack

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here

ROOM = """
start: {x: 1.0, y: 2.0}
walls:
  - {points: [[0, 0], [6, 0], [6, 4], [0, 4]], closed: true}
boxes:
  - {x: 2.8, y: 2.0, size: [0.4, 0.8]}
"""


@pytest.mark.parametrize("name", ["dwa", "pursuit"])
def test_it_drives_to_a_goal_without_contact(tmp_path, name):
    stack = LockstepStack(tmp_path, ROOM, settings=(f"local_ctrl.controller={name}",))
    stack.go(3.8)
    stack.until(stack.ended, 40.0)
    assert stack.reached()
    assert stack.truth.n_contacts == 0
