# SPDX-License-Identifier: Apache-2.0
"""How old a thing is, and which of two came first: laws, also where clocks differ or were set back."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.codec import Envelope
from shared.stamps import FUTURE, fresh, is_known, is_older, precedes, supersedes

MS = 1_000_000
NOW = 10_000 * MS
STAMPS = st.integers(0, 2**62)


@pytest.mark.parametrize(
    ("age_ms", "expected"), [(-101, False), (-100, True), (0, True), (200, True), (200.001, False), (1e9, False)]
)
def test_fresh_is_young_and_not_from_the_future(age_ms, expected):
    assert fresh(NOW - round(age_ms * MS), NOW, 0.2) is expected


@given(st.integers(0, 2**62), st.integers(0, 2**62))
def test_newer_supersedes_unless_the_clock_was_set_back(stamp, last):
    assert supersedes(stamp, last, last) is (stamp > last)
    assert supersedes(stamp, None, last)
    assert supersedes(stamp, last, last - FUTURE - 1)
    assert supersedes(last, last, last - FUTURE) is False


@given(STAMPS, STAMPS, STAMPS)
def test_one_precedes_another_or_is_it_or_supersedes_it(stamp, other, now):
    assert precedes(stamp, other, now) + (stamp == other <= now + FUTURE) + supersedes(stamp, other, now) == 1


@given(STAMPS, STAMPS, STAMPS, st.integers(0, 9), st.integers(0, 9))
def test_in_a_session_the_sequence_decides_which_message_is_older_and_between_two_the_stamp(sent, last, now, k, n):
    before = Envelope("mapper", "a", n, last)
    assert is_older(Envelope("mapper", "a", k, sent), before, now) is (k < n)
    assert is_older(Envelope("mapper", "b", k, sent), before, now) is precedes(sent, last, now)
    assert is_known(Envelope("mapper", "a", k, sent), before, now) is (k <= n)
    assert is_known(Envelope("mapper", "b", k, sent), before, now) is precedes(sent, last, now)
