# SPDX-License-Identifier: Apache-2.0
"""The age of messages by their publishers' clocks: delays are seen, wrong clocks are not."""

from hypothesis import given
from hypothesis import strategies as st

from services.ros2.sender_clocks import MAX_PUBLISHERS, SenderClocks
from shared.minimum_delay import WINDOW_NS

MS = 1_000_000
START = 1_000_000_000_000
GID = b"publisher"


@given(
    offset=st.integers(-(10**18), 10**18),
    delays=st.lists(st.integers(0, 2000), min_size=2, max_size=80),
)
def test_the_age_is_the_delay_over_the_fastest_message_whatever_the_clocks_say(offset, delays):
    clocks, seen = SenderClocks(), []
    for i, delay in enumerate(delays):
        sent = START + i * 50 * MS
        seen.append(delay)
        assert clocks.age(GID, sent - offset, sent + delay * MS) == (delay - min(seen)) * MS


def test_a_burst_after_a_broken_link_is_old():
    clocks = SenderClocks()
    for i in range(20):
        assert clocks.age(GID, i * 50 * MS, START + i * 50 * MS) == 0
    back = START + 4000 * MS
    ages = [clocks.age(GID, i * 50 * MS, back) for i in range(20, 80)]
    assert ages == [(4000 - i * 50) * MS for i in range(20, 80)]
    assert clocks.age(GID, 4050 * MS, START + 4050 * MS) == 0


def test_a_clock_that_was_set_is_believed_after_the_window():
    """Forward at once; back after its old minimum is forgotten: until then messages are old, and the robot stands."""
    clocks = SenderClocks()
    for i in range(20):
        clocks.age(GID, i * 50 * MS, START + i * 50 * MS)
    assert clocks.age(GID, 1050 * MS + 3000 * MS, START + 1050 * MS) == 0
    ages = [clocks.age(GID, i * 50 * MS, START + i * 50 * MS) for i in range(22, 22 + 2 * WINDOW_NS // (50 * MS) + 2)]
    assert ages[0] == 3000 * MS
    assert ages[-1] == 0


def test_publishers_are_apart_and_their_number_is_bounded():
    clocks = SenderClocks()
    for i in range(3 * MAX_PUBLISHERS):
        assert clocks.age(i.to_bytes(2), 0, START + i) == 0
    assert len(clocks._minima) == MAX_PUBLISHERS
