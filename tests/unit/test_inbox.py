# SPDX-License-Identifier: Apache-2.0
"""The inbox never blocks its writers, never grows without bound, and keeps order."""

import threading

from hypothesis import given
from hypothesis import strategies as st

from shared.runners.inbox import Inbox

filed = st.lists(st.tuples(st.sampled_from(["scan", "odom"]), st.integers(0, 99)), max_size=60)


def emptied(inbox: Inbox) -> list[tuple[str, int]]:
    items = []
    while (item := inbox.take(0)) is not None:
        items.append((item[0].key, item[1]))
    return items


@given(filed)
def test_all_keeps_everything_in_order_and_latest_the_last(items):
    inbox = Inbox()
    slots = {"scan": inbox.slot("scan", "latest"), "odom": inbox.slot("odom", "all")}
    for key, n in items:
        inbox.file(slots[key], n)
    taken = emptied(inbox)
    assert [n for key, n in taken if key == "odom"] == [n for key, n in items if key == "odom"]
    assert [n for key, n in taken if key == "scan"] == [n for key, n in items if key == "scan"][-1:]


@given(st.integers(0, 20))
def test_what_waits_is_taken_without_what_comes_meanwhile(n):
    inbox = Inbox()
    slot = inbox.slot("odom", "all")
    for i in range(n):
        inbox.file(slot, i)
    for _, i in inbox.take_waiting():
        inbox.file(slot, n + i)
    assert [i for _, i in emptied(inbox)] == list(range(n, 2 * n))


@given(st.integers(1, 5), st.integers(0, 30))
def test_a_full_place_drops_its_oldest_and_counts(capacity, n):
    inbox = Inbox()
    slot = inbox.slot("odom", "all", capacity)
    for i in range(n):
        assert inbox.file(slot, i) == (i < capacity)
    assert [i for _, i in emptied(inbox)] == list(range(n))[-capacity:]
    assert slot.dropped == max(0, n - capacity)


def test_a_waiting_reader_wakes_when_something_is_filed():
    inbox = Inbox()
    slot = inbox.slot("odom", "all")
    found: list[object] = []
    reader = threading.Thread(target=lambda: found.append(inbox.take(10)))
    reader.start()
    inbox.file(slot, 5)
    reader.join(5)
    assert found == [(slot, 5)]


def drained(inbox):
    return [(slot.key, item) for slot, item in iter(lambda: inbox.take(0), None)]


def test_a_scan_that_replaces_an_unread_one_comes_after_the_odometry_that_arrived_before_it():
    inbox = Inbox()
    scan, odom = inbox.slot("scan", "latest"), inbox.slot("odom", "all")
    for tick in range(100):  # s/50: the process pauses for 2 s
        inbox.file(odom, tick)
        if tick % 5 == 0:
            inbox.file(scan, tick)
    order = drained(inbox)
    assert order.index(("scan", 95)) == order.index(("odom", 95)) + 1
    assert [item for key, item in order if key == "odom"] == list(range(100))
    assert scan.dropped == 19
