# SPDX-License-Identifier: Apache-2.0
"""Which messages a subscriber takes."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import topics
from shared.codec import Envelope
from shared.runners.admission import SILENT_AFTER, Admission, Verdict

MS = 1_000_000
SECOND = 1000 * MS


def at(sequence: int, sent: int, session: str = "a", publisher: str = "guard") -> Envelope:
    return Envelope(publisher, session, sequence, sent)


@given(st.lists(st.integers(0, 30), max_size=40))
def test_what_is_taken_from_one_session_only_rises(sequences):
    admission = Admission(topics.CMD_VEL)
    taken = [n for n in sequences if admission.judge(at(n, n), n) in (Verdict.TAKE, Verdict.GAP)]
    assert taken == sorted(set(taken))
    assert not sequences or taken[-1] == max(sequences)


def test_a_gap_is_told():
    admission = Admission(topics.MAP)
    assert admission.judge(at(0, 0, publisher="mapper"), 0) is Verdict.TAKE
    assert admission.judge(at(2, 1, publisher="mapper"), 1) is Verdict.GAP


def test_a_second_commander_is_an_intruder_until_the_first_fell_silent():
    admission = Admission(topics.CMD_VEL)
    assert admission.judge(at(5, 0), 0) is Verdict.TAKE
    assert admission.judge(at(0, 10, "b"), 10 * MS) is Verdict.INTRUDER
    assert admission.judge(at(6, 20), 20 * MS) is Verdict.TAKE
    assert admission.judge(at(1, 30, "b"), 20 * MS + SILENT_AFTER) is Verdict.TAKE
    assert admission.judge(at(7, 40), 21 * MS + SILENT_AFTER) is Verdict.INTRUDER


def test_a_burst_of_an_old_session_after_a_partition_is_old():
    admission = Admission(topics.CMD_VEL)
    admission.judge(at(0, 900 * MS, "b"), 900 * MS)
    later = 900 * MS + 2 * SILENT_AFTER
    assert admission.judge(at(7, 100 * MS, "a"), later) is Verdict.OLD


@pytest.mark.parametrize("publisher", ["operator", "local_ctrl", "", "GUARD"])
def test_only_the_registrys_publisher_is_heard(publisher):
    assert Admission(topics.CMD_VEL).judge(at(0, 0, publisher=publisher), 0) is Verdict.INTRUDER


def test_stop_is_taken_from_every_operator_also_from_one_whose_clock_is_behind():
    admission = Admission(topics.ESTOP)
    assert admission.judge(at(0, 60 * SECOND, "a", "dashboard"), 60 * SECOND) is Verdict.TAKE
    assert admission.judge(at(0, 42 * SECOND, "b", "operator"), 62 * SECOND) is Verdict.TAKE
    assert admission.judge(at(0, 42 * SECOND, "b", "operator"), 62 * SECOND) is Verdict.OLD
    assert admission.judge(at(0, 55 * SECOND, "c", "operator"), 63 * SECOND, kept=True) is Verdict.OLD
    assert admission.judge(at(1, 61 * SECOND, "a", "dashboard"), 64 * SECOND, kept=True) is Verdict.TAKE


def test_events_of_one_publisher_are_taken_in_the_order_of_sending():
    admission = Admission(topics.GOAL)
    assert admission.judge(at(0, 20, "b", "navigator"), 20) is Verdict.TAKE
    assert admission.judge(at(1, 15, "a", "navigator"), 30) is Verdict.OLD


def test_what_is_kept_is_taken_where_its_last_part_was_overheard():
    admission = Admission(topics.MAP)
    mapper = [at(n, n, publisher="mapper") for n in range(10)]
    assert admission.judge(mapper[6], 6) is Verdict.TAKE
    assert not admission.complete
    assert admission.judge(mapper[5], 7, kept=True) is Verdict.OLD
    assert not admission.complete
    assert admission.judge(mapper[6], 7, kept=True) is Verdict.TAKE
    assert admission.complete
    assert admission.judge(mapper[6], 8, kept=True) is Verdict.OLD
    assert admission.judge(mapper[7], 8) is Verdict.TAKE
    assert admission.judge(mapper[9], 9) is Verdict.GAP
    assert not admission.complete
    assert admission.judge(mapper[9], 9, kept=True) is Verdict.TAKE
    assert admission.complete


@given(st.integers(0, 4), st.integers(0, 4), st.sets(st.integers(0, 8)))
def test_a_message_that_a_kept_value_overtook_is_no_fault_but_its_repetition_is(position, overtaken, lost):
    admission = Admission(topics.MAP)
    mapper = [at(n, n, publisher="mapper") for n in range(10)]
    for envelope in mapper:
        if envelope.sequence == position:
            admission.judge(mapper[position + overtaken], 10, kept=True)
        if envelope.sequence not in lost and admission.judge(envelope, 10) is Verdict.OLD:
            assert admission.words == ""
            assert envelope.sequence <= position + overtaken
    for envelope in mapper:
        assert admission.judge(envelope, 11) is Verdict.OLD
        assert admission.words


@given(st.lists(st.tuples(st.integers(0, 12), st.booleans()), max_size=30))
def test_complete_means_that_nothing_is_missing(arrivals):
    admission, have = Admission(topics.MAP), set[int]()
    for now, (sequence, kept) in enumerate(arrivals):
        if admission.judge(at(sequence, sequence, publisher="mapper"), now, kept) in (Verdict.TAKE, Verdict.GAP):
            have |= set(range(sequence + 1)) if kept else {sequence}
        if have:
            assert admission.complete == (have == set(range(max(have) + 1)))


def test_what_came_from_a_clock_that_was_ahead_makes_nothing_old():
    now = 1000 * SECOND
    for topic, publisher in ((topics.GOAL, "navigator"), (topics.SCAN, "lidar_driver")):
        admission = Admission(topic)
        assert admission.judge(at(0, now + 10 * SECOND, "a", publisher), now) is Verdict.TAKE
        later = now + 2 * SECOND
        assert admission.judge(at(0, now - MS, "d", publisher), later) is Verdict.OLD
        assert admission.judge(at(0, later, "b", publisher), later) is Verdict.TAKE
        assert admission.judge(at(0, later - MS, "c", publisher), later + SECOND) is Verdict.OLD
