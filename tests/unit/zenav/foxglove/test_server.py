# SPDX-License-Identifier: Apache-2.0
"""The time that an app gets: late ticks of the simulator never set it back."""

from hypothesis import given
from hypothesis import strategies as st

from shared.runners.client import CLOCK_AGE, Timekeeper
from shared.types import NS_PER_S
from zenav.foxglove.server import time_to_show

EPOCH = 10**18
delays = st.lists(st.floats(0.0, 0.9 * CLOCK_AGE), min_size=1, max_size=40)


@given(delays)
def test_ticks_that_come_late_never_set_an_apps_clock_back(late):
    keeper, shown, arrived = Timekeeper(), 0, 0.0
    for k, delay in enumerate(late):
        sent = 0.05 * k
        arrived = max(arrived, sent + delay)
        keeper.add_clock(EPOCH + round(sent * NS_PER_S), arrived)
        at = time_to_show(keeper.now(EPOCH, arrived + 0.04), shown)
        assert at >= shown
        shown = at


def test_an_app_follows_a_clock_that_was_set_far_back():
    assert time_to_show(EPOCH - 3 * NS_PER_S, EPOCH) == EPOCH - 3 * NS_PER_S
    assert time_to_show(EPOCH, 0) == EPOCH
