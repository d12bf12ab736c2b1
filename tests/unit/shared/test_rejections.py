# SPDX-License-Identifier: Apache-2.0
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.rejections import RECENT, RejectionCause, Rejections, duration
from shared.stamps import FUTURE, fresh, supersedes

S = 1_000_000_000
NOW = 1_790_000_000 * S  # the year 2026
stamps = st.one_of(st.integers(0, 2 * NOW), st.integers(NOW - 2 * S, NOW + 2 * S))

OFFSETS = {
    NOW - NOW // S: (RejectionCause.OLD, "scan: stamps are 57 years old; are they ns?"),
    NOW: (RejectionCause.OLD, "scan: stamps are 57 years old; are they ns?"),
    NOW - NOW // 1000: (RejectionCause.OLD, "scan: stamps are 57 years old; are they ns?"),
    round(0.3 * S): (RejectionCause.OLD, "scan: stamps are 0.3 s old"),
    10 * S: (RejectionCause.OLD, "scan: stamps are 10.0 s old"),
    -S: (RejectionCause.AHEAD, "scan: stamps are 1.0 s ahead"),
    -3600 * S: (RejectionCause.AHEAD, "scan: stamps are 1 h ahead"),
}


def judged(rejections, ages, key="scan", every=S // 10):
    """Gives messages of these ages (ns), one after the other; returns when the last came."""
    now, last = NOW, None
    for i, age in enumerate(ages):
        now = NOW + i * every
        if rejections.judge(key, now - age, last, now, 0.27):
            last = now - age
    return now


@pytest.mark.parametrize("age", OFFSETS)
def test_a_bad_stamp_is_counted_by_kind_and_told_in_words(age):
    kind, words = OFFSETS[age]
    rejections = Rejections()
    now = judged(rejections, [age] * 3)
    assert rejections.counts == {("scan", kind): 3}
    assert rejections.stamp_problem("scan", now) == rejections.late_cause("scan", now) == words
    assert rejections.stamp_problem("scan", now + RECENT) == words
    assert rejections.stamp_problem("scan", now + RECENT + 1) == "", "the input is silent: that is another cause"


def test_a_stamp_that_stands_still_or_goes_back_is_a_sequence_that_does_not_rise():
    rejections = Rejections()
    assert rejections.judge("hardware/board", NOW, None, NOW, 0.2)
    for i in (1, 2, 3, 4):
        now = NOW + i * S // 50
        assert not rejections.judge("hardware/board", NOW, NOW, now, 0.2)
    assert rejections.stamp_problem("hardware/board", now) == "board: stamps stand still"
    assert not rejections.judge("hardware/board", NOW - 1, NOW, now, 0.2)
    assert rejections.stamp_problem("hardware/board", now) == "board: stamps go back"
    assert rejections.counts == {("hardware/board", RejectionCause.SEQUENCE): 5}


def test_a_good_message_ends_the_words_and_the_counts_stay():
    rejections = Rejections()
    now = judged(rejections, [10 * S] * 5 + [0])
    assert rejections.late_cause("scan", now) == ""
    assert rejections.counts == {("scan", RejectionCause.OLD): 5}


def test_a_burst_after_a_moment_s_load_is_counted_and_not_told():
    rejections = Rejections()
    now = judged(rejections, [S, S, S], every=1_000_000)
    assert rejections.stamp_problem("scan", now) == ""
    assert rejections.counts == {("scan", RejectionCause.OLD): 3}


def test_messages_that_are_late_but_used_are_told_while_more_of_their_age_is_in_the_stamp_than_in_silence():
    rejections = Rejections()
    now = judged(rejections, [S // 4])
    assert rejections.counts == {}
    assert rejections.late_cause("scan", now + S // 5) == "scan: stamps are 0.2 s old"
    assert rejections.late_cause("scan", now + S // 4) == ""
    assert rejections.stamp_problem("scan", now) == ""


def test_what_the_runner_rejects_is_told_alike():
    rejections = Rejections()
    for i in (0, 1):
        rejections.reject("scan", RejectionCause.SEQUENCE, "the sequence stands still", NOW + i * S // 10, n=3)
    assert rejections.stamp_problem("scan", NOW + S // 10) == "scan: the sequence stands still"
    assert rejections.counts == {("scan", RejectionCause.SEQUENCE): 6}


@given(stamps, st.none() | stamps, stamps)
def test_the_one_rule_is_that_of_the_stamps(stamp, last, now):
    usable = fresh(stamp, now, 0.27) and supersedes(stamp, last, now)
    rejections = Rejections()
    assert rejections.judge("scan", stamp, last, now, 0.27) is usable
    assert sum(rejections.counts.values()) == (not usable)


def test_what_does_not_fit_the_configuration_is_no_wrong_stamp():
    rejections = Rejections()
    for i in range(2):
        now = NOW + i * S // 10
        assert not rejections.judge("scan", now, None, now, 0.27, unfit="2 beams came")
    assert rejections.counts == {("scan", RejectionCause.CONTENT): 2}
    assert rejections.content_problem("scan", now) == "2 beams came"
    assert rejections.content_problem("scan", now + RECENT + 1) == ""
    assert rejections.stamp_problem("scan", now) == rejections.late_cause("scan", now) == ""
    assert not rejections.judge("scan", now - S, None, now, 0.27, unfit="2 beams came")
    assert rejections.counts["scan", RejectionCause.OLD] == 1, "its stamp comes first"
    assert rejections.content_problem("scan", now) == ""


@pytest.mark.parametrize("kind", [FUTURE, -FUTURE])
def test_the_limit_ahead_is_that_of_two_machines_clocks(kind):
    assert Rejections().judge("scan", NOW + kind, None, NOW, 0.1)


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.25, "0.2 s"),
        (119, "119.0 s"),
        (180, "3 min"),
        (3600, "1 h"),
        (86400, "24 h"),
        (864000, "10 days"),
        (2e9, "63 years"),
    ],
)
def test_durations_are_told_in_the_unit_of_their_size(seconds, words):
    assert duration(round(seconds * 1e9)) == words
