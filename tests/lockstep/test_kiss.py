# SPDX-License-Identifier: Apache-2.0
"""The whole stack drives with the kiss-icp package as registrar."""

from math import hypot

from shared.messages import Localization
from tests.lockstep.stack import LockstepStack


def test_the_robot_drives_to_its_goal_and_back_with_the_kiss_registrar(tmp_path):
    stack = LockstepStack(tmp_path, settings=("mapper.registration.registrar=kiss",))
    worst = 0.0

    def follow(estimate) -> None:
        nonlocal worst
        here = stack.truth.start.inverse() @ stack.truth.world_from_base
        moved = stack.truth.v * (stack.now - estimate.stamp) * 1e-9  # the scan is older than the truth
        off = here.inverse() @ estimate.map_from_base
        worst = max(worst, hypot(off.x, off.y) - abs(moved))
        assert estimate.state is Localization.GOOD

    stack.lockstep.watch("pose", follow)
    for goal in (7.0, 0.5):
        stack.go(goal)
        stack.until(stack.reached, 60.0)
    assert worst < 0.08
