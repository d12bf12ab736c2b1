# SPDX-License-Identifier: Apache-2.0
"""Over Zenoh: what is too large or counted wrongly ends with a clear error at once, and health counts it."""

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgpack
import numpy as np
import pytest
import zenoh

from shared import requests, topics
from shared.codec import Envelope, decode, encode
from shared.config import Section, UserError
from shared.geometry import Pose2
from shared.messages import Health, MapUpdate, WheelState
from shared.requests import MAX_ROUTE_POSES, FetchMap, LoadMap, MapPart, Navigate, Reply
from shared.runners import transport
from shared.service import Answer, Out, Service, answer, every
from tests.stack.test_live import ROBOT, CancellingNavigator, CountingOdometry, running, where
from zenav.client import Client

__all__ = ["where"]

LARGE = transport.MAX_PAYLOAD + 1
AT_ONCE = 1.0  # s; Zenoh's own answer would be its timeout
TIMEOUT = 10.0


def tiles(n: int, stamp: int = 1) -> MapUpdate:
    """A map of n tiles, 4 kB each."""
    places = np.arange(n, dtype=np.int32)
    return MapUpdate(stamp, 1, 1, 0.05, places // 200, places % 200, np.zeros((n, 4096), np.int8))


class RoutePublisher(CancellingNavigator):
    @answer(requests.NAVIGATE)
    def navigate(self, request: Navigate) -> Answer[Reply]:
        yield from ()
        return Reply(self.now, True, "", f"{len(request.poses)} poses")


class RejectingMapper(Service):
    """Its map, its replies and the maps it takes are as large as they are made."""

    n_tiles = 1

    def __init__(self) -> None:
        super().__init__(Section(), ROBOT)

    @every(hz=10)
    def draw(self) -> Out:
        yield topics.MAP(tiles(self.n_tiles, self.now))

    @answer(requests.FETCH_MAP)
    def fetch(self, request: FetchMap) -> Answer[MapPart]:
        yield from ()
        return MapPart(self.now, True, "", "", 1, 1, bytes(request.part))

    @answer(requests.LOAD_MAP)
    def load(self, request: LoadMap) -> Answer[Reply]:
        yield from ()
        return Reply(self.now, True, "", "")


class Healths:
    """The newest health message of a service."""

    def __init__(self, session: zenoh.Session, name: str) -> None:
        self.newest: Health | None = None
        self.changed = threading.Condition()
        self.subscriber = session.declare_subscriber(f"{ROBOT.name}/health/{name}", self.take)

    def take(self, sample: zenoh.Sample) -> None:
        with self.changed:
            self.newest = decode(Health, sample.payload.to_bytes())[0]
            self.changed.notify_all()

    def has(self, key: str, why: str, n: int) -> Health:
        """Waits until so many are counted."""

        def holds() -> bool:
            return self.newest is not None and (key, why, n) in self.newest.rejected

        with self.changed:
            assert self.changed.wait_for(holds, TIMEOUT), self.newest
            assert self.newest is not None
            return self.newest


@contextmanager
def watched(service: Service, name: str, where: transport.StackAddress) -> Iterator[tuple[zenoh.Session, Healths]]:
    with running(service, name, where), transport.opened(where) as tool:
        yield tool, Healths(tool, name)


def refusal_of(tool: zenoh.Session, request: requests.Request[Any, Any], payload: bytes) -> Any:
    """The refusing reply to a request, which comes at once."""
    begun = time.monotonic()
    (reply,) = tool.get(f"{ROBOT.name}/{request.key}", payload=payload, timeout=TIMEOUT)
    assert time.monotonic() - begun < AT_ONCE
    assert reply.ok is not None
    refusal, _ = decode(request.reply, reply.ok.payload.to_bytes())
    assert not refusal.accepted
    return refusal


def test_a_request_over_the_limit_is_refused_at_once_and_counted(where):
    with watched(CancellingNavigator(), "navigator", where) as (tool, healths):
        refusal = refusal_of(tool, requests.CANCEL, bytes(LARGE))
        assert (refusal.reason, refusal.detail) == ("too_large", "4.0 MiB where a message may have 4")
        assert refusal_of(tool, requests.CANCEL, bytes(2 * LARGE)).reason == "too_large"
        assert refusal_of(tool, requests.CANCEL, bytes(transport.MAX_PAYLOAD - 100)).reason == "bad_request"
        assert "request/cancel" in healths.has("request/cancel", "size", 2).last_error


def test_the_client_refuses_what_is_over_the_limit_before_it_is_sent(where):
    with running(RejectingMapper(), "mapper", where), Client(ROBOT.name, where) as client:
        assert client.ask(requests.LOAD_MAP, LoadMap(1, tiles(900), Pose2())).accepted
        begun = time.monotonic()
        with pytest.raises(UserError, match=r"request/load_map: the message is too large: 4\.3 MiB .* may have 4"):
            client.ask(requests.LOAD_MAP, LoadMap(1, tiles(1100), Pose2()), timeout=TIMEOUT)
        assert time.monotonic() - begun < AT_ONCE


def test_a_reply_over_the_limit_is_an_error_at_once_and_counted(where):
    with watched(RejectingMapper(), "mapper", where) as (tool, healths):
        payload = encode(FetchMap(1, 1, LARGE), Envelope("operator", "o", 0, 1))
        assert refusal_of(tool, requests.FETCH_MAP, payload).reason == "too_large"
        healths.has("request/fetch_map", "size", 1)


def test_a_route_of_too_many_poses_is_refused_with_the_limit(where):
    with running(RoutePublisher(), "navigator", where), Client(ROBOT.name, where) as client:
        poses = tuple(Pose2(0.1 * i, 0.0, 0.0) for i in range(MAX_ROUTE_POSES + 1))
        reply = client.ask(requests.NAVIGATE, Navigate(1, poses[:-1], 0.0, 1, True))
        assert reply.detail == "10000 poses"
        refusal = client.ask(requests.NAVIGATE, Navigate(1, poses, 0.0, 1, True))
        assert (refusal.accepted, refusal.reason) == (False, "bad_request")
        assert refusal.detail == "a route of 10001 poses, where 10000 are the limit"


def test_a_message_over_the_limit_is_counted_where_it_comes_and_the_next_is_taken(where):
    odometry = CountingOdometry()
    with watched(odometry, "odometry", where) as (tool, healths):
        key = f"{ROBOT.name}/base/wheels"
        for _ in range(3):
            tool.put(key, bytes(LARGE))
        assert "base/wheels: 3 rejected: 4.0 MiB where" in healths.has("base/wheels", "size", 3).last_error
        for i in range(5):
            tool.put(key, encode(WheelState(i, 0, 0.0, 0.0, 0.0, 0.0), Envelope("base_driver", "b", i, i)))
        assert odometry.enough.wait(TIMEOUT)


def test_a_service_s_own_message_over_the_limit_is_counted_and_the_next_goes_out(where):
    mapper = RejectingMapper()
    mapper.n_tiles = 1100
    arrived = threading.Event()
    with watched(mapper, "mapper", where) as (tool, healths):
        tool.declare_subscriber(f"{ROBOT.name}/map", lambda _: arrived.set())
        with healths.changed:
            assert healths.changed.wait_for(
                lambda: (
                    healths.newest is not None and any(row[:2] == ("map", "size") for row in healths.newest.rejected)
                ),
                TIMEOUT,
            )
        assert not arrived.is_set()
        mapper.n_tiles = 1
        assert arrived.wait(TIMEOUT)


@pytest.mark.parametrize(("sequences", "words"), [([0, 0, 0, 0], "stands still"), ([3, 2, 1, 0], "goes back")])
def test_sequences_that_do_not_rise_are_counted_and_the_service_knows(where, sequences, words):
    odometry = CountingOdometry()
    told = threading.Event()
    with watched(odometry, "odometry", where) as (tool, healths):
        for sequence in sequences:
            message = WheelState(1, 0, 0.0, 0.0, 0.0, 0.0)
            tool.put(f"{ROBOT.name}/base/wheels", encode(message, Envelope("base_driver", "b", sequence, 1)))
            told.wait(0.08)
        health = healths.has("base/wheels", "sequence", 3)
        assert f"the sequence {words}" in health.last_error
        assert odometry.rejections.last_problem("base/wheels") == f"the sequence {words}"
        assert len(odometry.seen) == 1


def test_fields_of_a_newer_version_are_ignored_and_named_in_health(where):
    odometry = CountingOdometry()
    with watched(odometry, "odometry", where) as (tool, healths):
        stamp = time.time_ns()
        tree = msgpack.unpackb(encode(WheelState(stamp, 0, 0.0, 0.0, 0.0, 0.0), Envelope("base_driver", "s", 0, stamp)))
        for sequence in range(5):
            grown = {**tree, "stamp": stamp + sequence, "temperature": 40.0, "@": ["base_driver", "s", sequence, stamp]}
            tool.put(f"{ROBOT.name}/base/wheels", msgpack.packb(grown))
        with healths.changed:
            words = "base/wheels: unknown field temperature ignored"
            assert healths.changed.wait_for(lambda: healths.newest and healths.newest.last_error == words, TIMEOUT)
        assert healths.newest.bad_messages == 0
    assert len(odometry.seen) == 5
