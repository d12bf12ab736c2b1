# SPDX-License-Identifier: Apache-2.0
"""Journals come back as the events that were taken, and what is lost leaves a hole of its size."""

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared import requests, topics
from shared.geometry import Pose2
from shared.messages import Journal, MapUpdate
from shared.rejections import RejectionCause
from shared.requests import LoadMap
from shared.runners.host import JOURNAL_FULL, REJECTED, REQUEST, Host, Sent
from shared.runners.journal import HOLE, Event, events_of
from tests.toys import build, eventful


def journals() -> dict[str, list[Journal]]:
    found: dict[str, list[Journal]] = {}

    def record(sent: Sent) -> None:
        if isinstance(sent.message, Journal):
            found.setdefault(sent.message.session, []).append(sent.message)

    eventful(record)
    return found


ALL = journals()


@given(st.sampled_from(sorted(ALL)), st.data())
def test_lost_journals_leave_holes_and_all_else_as_it_was(session, data):
    whole = ALL[session]
    lost = data.draw(st.sets(st.integers(0, len(whole) - 1)))
    kept = [journal for i, journal in enumerate(whole) if i not in lost]
    events = events_of(data.draw(st.permutations(kept + kept[:1])))
    each = [events_of([Journal(j.stamp, session, 0, j.events)]) for j in whole]
    assert [e for e in events if e.kind != HOLE] == [e for i, part in enumerate(each) if i not in lost for e in part]
    last = max((i for i in range(len(whole)) if i not in lost), default=-1)
    n_lost = sum(len(msgpack.unpackb(whole[i].events)) for i in lost if i < last)
    assert sum(e.number for e in events if e.kind == HOLE) == n_lost


@given(st.binary(max_size=60))
def test_a_journal_of_any_bytes_is_a_hole(events):
    good = Journal(0, "s", 7, msgpack.packb([[1, 5, 0]]))
    found = events_of([Journal(0, "s", 0, events), good])
    assert found[-1] == Event(1, 5, 0)


@pytest.mark.parametrize("entry", [[], [9, 1], [0, 1, 0, 0], [1, 1], [3, 1, "key"], "text", 7])
def test_an_entry_that_makes_no_sense_makes_its_journal_a_hole(entry):
    bad = Journal(0, "s", 0, msgpack.packb([[1, 1, 0], entry]))
    assert events_of([bad, Journal(0, "s", 2, msgpack.packb([[1, 5, 0]]))]) == [Event(HOLE, 0, 2), Event(1, 5, 0)]


def test_each_journal_can_be_read_alone():
    host = Host(build("odometry"), "odometry", "s")
    base = Host(build("base_driver"), "base_driver", "b")
    read = []
    for now in (10, 20):
        (sent,) = base.tick(0, now)
        assert isinstance(sent, Sent)
        host.message(sent.key, sent.message, sent.envelope, now)
        journal = host.journal(now)
        assert journal is not None
        assert isinstance(journal.message, Journal)
        read.append(events_of([Journal(now, "s", 0, journal.message.events)]))
    key = topics.WHEELS.key
    assert read == [[Event(0, 10, 0, key, "b")], [Event(0, 20, 1, key, "b")]]


def test_large_requests_are_told_in_several_journals_and_read_as_one():
    host = Host(build("mapper"), "mapper", "s")
    payloads = [bytes([k]) * (JOURNAL_FULL // 2) for k in range(5)]
    none = np.zeros(0, np.int32)
    load = LoadMap(0, MapUpdate(0, 1, 1, 0.05, none, none, np.zeros((0, 4096), np.int8)), Pose2())
    for payload in payloads:
        host.request(requests.LOAD_MAP.key, load, payload, 10)
        host.tick(0, 10)
    journals = []
    while (journal := host.journal(20)) is not None:
        assert isinstance(journal.message, Journal)
        assert len(journal.payload) < 2 * JOURNAL_FULL
        journals.append(journal.message)
    assert len(journals) > 1
    events = events_of(journals)
    assert [event.payload for event in events if event.kind == REQUEST] == payloads
    assert len(events) == 10
    assert host.journal(30) is None


def test_what_the_runner_rejected_comes_back_as_it_was_told_to_the_service():
    host = Host(build("odometry"), "odometry", "s")
    host.rejected("base/wheels", RejectionCause.SEQUENCE, "the sequence stands still", 3, 5)
    assert host.service.rejections.counts == {("base/wheels", "sequence"): 3}
    journal = host.journal(6)
    assert journal is not None
    assert isinstance(journal.message, Journal)
    assert events_of([journal.message]) == [
        Event(REJECTED, 5, 3, "base/wheels", why="sequence", words="the sequence stands still")
    ]
