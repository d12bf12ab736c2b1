# SPDX-License-Identifier: Apache-2.0
"""A single motion: it is driven once, also where local control is restarted meanwhile."""

import pytest

from services.navigator.motion import MAX_GROWTH, straight, turn
from services.navigator.status_cache import StatusCache
from shared import reasons
from shared.messages import FollowState, FollowStatus, NavState, Recovery

STEP_S = 0.2


def endings(motion, lefts):
    """How the motion ends, or None, after each status of local control with so much left, rad or m."""
    statuses, order, now = StatusCache(), Recovery(0, 7, motion.kind, motion.amount), 0
    for left in lefts:
        now += round(STEP_S * 1e9)
        state = FollowState.FOLLOWING if left else FollowState.ARRIVED
        statuses.add_follow(FollowStatus(now, order.id, state, "", left), now)
        yield motion.ending(STEP_S, order, statuses, now)


@pytest.mark.parametrize(("motion", "amount"), [(turn, -1.5), (straight, 1.5), (straight, -1.5)])
def test_a_motion_that_begins_again_ends_as_interrupted(motion, amount):
    *before, last = endings(motion(amount, 0.0), [1.5, 1.0, 0.5, 1.5])
    assert before == [None, None, None]
    assert last == (NavState.FAILED, reasons.INTERRUPTED)


def test_a_motion_whose_rest_grows_a_little_goes_on():
    rests = [1.0, 0.5, 0.5 + 0.9 * MAX_GROWTH, 0.1, 0.0]
    *before, last = endings(turn(1.0, 0.0), rests)
    assert before == [None] * 4
    assert last == (NavState.REACHED, None)
