# SPDX-License-Identifier: Apache-2.0
"""A receiver of all keys polls: the messages since the last poll are there, in order, with their times of arrival."""

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
import zenoh

from shared.runners import transport
from tests.stack.processes import ROBOT, wait
from tests.stack.test_live import free_stack

N = 20
KEY = f"{ROBOT.name}/odom"


@pytest.fixture(params=["peers", "router"])
def where(request) -> Iterator[transport.StackAddress]:
    if request.param == "peers":
        yield transport.StackAddress(free_stack())
        return
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    with zenoh.open(transport.router_configuration(endpoint)):
        yield transport.stack_address(endpoint)


@pytest.fixture
def link(where) -> Iterator[tuple[zenoh.Session, zenoh.Publisher]]:
    """A receiver of all keys, and a publisher of another session."""
    with ExitStack() as stack:
        sender = stack.enter_context(transport.opened(where, "odometry"))
        receiver = stack.enter_context(transport.opened(where, "recorder", everything=True))
        yield receiver, sender.declare_publisher(KEY)


def matched(publisher: zenoh.Publisher) -> None:
    found = threading.Event()
    publisher.declare_matching_listener(lambda status: found.set() if status.matching else None)
    there: object = publisher.matching_status  # its stub says bool, it is an object
    assert getattr(there, "matching", False) or found.wait(60)


def taken(everything: transport.Everything, last: bytes) -> list[transport.RawSample]:
    """What came, until this payload did."""
    found, limit = list[transport.RawSample](), time.monotonic() + 20
    while not found or found[-1].payload != last:
        assert time.monotonic() < limit
        wait(0.001)
        found += [arrival for arrival in everything.take_all() if arrival.key == KEY]
    return found


def test_what_nobody_looked_at_has_the_time_when_it_came(link, monkeypatch):
    receiver, publisher = link
    everything, came, heard = transport.Everything(receiver, ROBOT.name), list[int](), threading.Semaphore(0)

    def hear(sample: zenoh.Sample) -> None:
        came.append(time.time_ns())
        heard.release()

    receiver.declare_subscriber(KEY, hear)
    matched(publisher)
    sent = []
    for i in range(N):
        sent.append(time.time_ns())
        publisher.put(bytes([i]))
        assert heard.acquire(timeout=60)
    found = taken(everything, bytes([N - 1]))
    assert [arrival.payload for arrival in found] == [bytes([i]) for i in range(N)]
    assert not any(arrival.latched for arrival in found)
    for before, arrival, after in zip(sent, found, came):
        assert before <= arrival.at <= after
    assert everything.take_all() == []

    publisher.put(b"set back")
    assert heard.acquire(timeout=60)
    monkeypatch.setattr(time, "time_ns", lambda: sent[0])
    assert [arrival.at for arrival in taken(everything, b"set back")] == [sent[0]]


def test_of_more_than_it_keeps_the_newest_stay(link, monkeypatch):
    receiver, publisher = link
    monkeypatch.setattr(transport, "RING", 5)
    everything, heard = transport.Everything(receiver, ROBOT.name), threading.Semaphore(0)
    receiver.declare_subscriber(KEY, lambda _: heard.release())
    matched(publisher)
    for i in range(N):
        publisher.put(bytes([i]))
        assert heard.acquire(timeout=60)
    found = taken(everything, bytes([N - 1]))
    assert [arrival.payload for arrival in found] == [bytes([i]) for i in range(N - len(found), N)]
    assert 5 <= len(found) <= 6  # the last may come while the others are taken
