# SPDX-License-Identifier: Apache-2.0
"""An unreachable goal is refused with a reason. The robot stands, and drives to the next goal."""

import pytest

from shared import requests
from shared.geometry import Pose2
from shared.reasons import REASONS
from shared.requests import Navigate
from tests.lockstep.stack import QUICK, LockstepStack

pytestmark = pytest.mark.timeout(600)  # with an empty cache the kernels are compiled here


def asked(stack, *places, tolerance=0.0):
    poses = tuple(Pose2(x, y, 0.0) for x, y in places)
    return stack.lockstep.ask(requests.NAVIGATE, Navigate(stack.now, poses, 0.0, 1, True, (), tolerance))


@pytest.mark.parametrize(
    ("x", "y", "reason"), [(50.0, 50.0, "goal_outside"), (1e6, -1e6, "goal_outside"), (2.0, -1.5, "goal_blocked")]
)
def test_a_goal_outside_the_map_or_in_a_wall_is_refused_in_the_reply_and_the_next_one_is_reached(
    tmp_path, x, y, reason
):
    stack = LockstepStack(tmp_path, settings=QUICK)
    reply = asked(stack, (x, y))
    assert (reply.accepted, reply.reason, reply.task_id) == (False, reason, 0)
    assert REASONS[reason].text in reply.detail
    assert "pose 1 of 1" in reply.detail
    assert REASONS[reason].hint
    stack.stands_for(1.0)
    stack.go(1.0)
    stack.until(stack.ended, 20.0)
    assert stack.reached()
    assert stack.truth.n_contacts == 0


def test_a_route_is_refused_by_the_number_of_its_pose_and_the_present_task_goes_on(tmp_path):
    stack = LockstepStack(tmp_path, settings=QUICK)
    stack.go(3.0)
    stack.drives(0.3)
    reply = asked(stack, (1.0, 0.0), (2.0, 0.0), (2.0, -1.5))
    assert (reply.accepted, reply.reason, reply.task_id) == (False, "goal_blocked", 1)
    assert "pose 3 of 3" in reply.detail
    stack.until(stack.ended, 20.0)
    assert stack.reached()


def test_a_later_pose_may_lie_where_the_map_has_yet_to_grow_and_not_outside_a_map_that_stays(tmp_path):
    stack = LockstepStack(tmp_path, settings=QUICK)
    assert asked(stack, (1.0, 0.0), (30.0, 0.0)).accepted
    assert stack.lockstep.ask(requests.START_MAP, requests.StartMap(stack.now, "localise", 0)).accepted
    stack.lockstep.run(3.0)
    reply = asked(stack, (1.0, 0.0), (30.0, 0.0))
    assert (reply.accepted, reply.reason) == (False, "goal_outside")
    assert "pose 2 of 2" in reply.detail


def test_a_goal_that_a_tolerance_makes_reachable_is_driven_to(tmp_path):
    stack = LockstepStack(tmp_path, settings=QUICK)
    assert not asked(stack, (2.0, -1.5)).accepted
    assert asked(stack, (2.0, -1.5), tolerance=1.5).accepted
    stack.until(stack.ended, 20.0)
    assert stack.reached()


def test_without_a_map_a_goal_is_taken_and_waits_for_it(tmp_path):
    stack = LockstepStack(tmp_path, settings=QUICK)
    stack.lockstep.kill("navigator")
    stack.lost["map"] = lambda sent: True
    stack.start("navigator")
    stack.lockstep.run(0.5)
    assert asked(stack, (2.0, -1.5)).accepted
