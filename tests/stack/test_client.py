# SPDX-License-Identifier: Apache-2.0
"""The tools' session against toy services over Zenoh."""

import json
import os
import signal
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from services.mapper.maps.map_file import unpack_map
from shared import requests, sample_messages, topics
from shared.config import Section, UserError
from shared.geometry import Pose2
from shared.messages import (
    EmergencyStop,
    Goal,
    GuardState,
    GuardStatus,
    MapMode,
    MapUpdate,
    NavState,
    NavStatus,
    Velocity,
)
from shared.reasons import MAP_REFUSED, NO_GRAPH
from shared.requests import Cancel, Explore, FetchMap, GiveMap, MapPart, Navigate, Pause, Reply, StartMap
from shared.service import Answer, Out, Service, answer, every, on
from tests.stack.processes import once
from tests.stack.test_live import ROBOT, running
from zenav.__main__ import _status
from zenav.client import Client
from zenav.stack.launch import free_stack


class ReachingNavigator(Service):
    """Reaches every goal after a few ticks, unless `slow`."""

    slow = False

    def __init__(self) -> None:
        super().__init__(Section(), ROBOT)
        self.task, self.left, self.state_now = 0, 0, NavState.IDLE
        self.canceled = threading.Event()
        self.asked: list[Navigate | Pause | Explore] = []

    @answer(requests.EXPLORE)
    def explore(self, request: Explore) -> Answer[Reply]:
        self.asked.append(request)
        self.task, self.left, self.state_now = self.task + 1, 4, NavState.EXPLORING
        yield self.status()
        return Reply(self.now, True, "", "", self.task)

    @answer(requests.PAUSE)
    def pause(self, request: Pause) -> Answer[Reply]:
        self.asked.append(request)
        yield self.status()
        return Reply(self.now, True, "", "", self.task)

    @answer(requests.NAVIGATE)
    def navigate(self, request: Navigate) -> Answer[Reply]:
        if request.poses[0].x > 100:
            return Reply(self.now, False, "goal_outside", "")
        self.asked.append(request)
        self.task, self.left, self.state_now = self.task + 1, 4, NavState.NAVIGATING
        yield topics.GOAL(Goal(self.now, self.task, True, request.poses[0], 0.1, 0.1, False))
        return Reply(self.now, True, "", "", self.task)

    @answer(requests.CANCEL)
    def cancel(self, request: Cancel) -> Answer[Reply]:
        self.state_now = NavState.CANCELED
        self.canceled.set()
        yield self.status()
        return Reply(self.now, True, "", "", self.task)

    @every(hz=20)
    def tick(self) -> Out:
        if self.state_now in (NavState.NAVIGATING, NavState.EXPLORING) and not self.slow:
            self.left -= 1
            self.state_now = NavState.REACHED if self.left < 0 else self.state_now
        yield self.status()

    def status(self):  # type: ignore[no-untyped-def]
        return topics.NAV_STATUS(
            NavStatus(self.now, self.task, self.state_now, "", "", "", Pose2(), self.left, 1.0, 0, 1, 0)
        )


class StopGuard(Service):
    """Obeys STOP."""

    def __init__(self) -> None:
        super().__init__(Section(), ROBOT)
        self.pressed = False
        self.driven: list[tuple[float, float]] = []

    @on(topics.TELEOP)
    def teleop(self, velocity: Velocity) -> Out:
        self.driven.append((velocity.v, velocity.w))
        return ()

    @on(topics.ESTOP)
    def estop(self, stop: EmergencyStop) -> Out:
        self.pressed = stop.pressed
        return ()

    @every(hz=20)
    def tick(self) -> Out:
        state = GuardState.STOPPED if self.pressed else GuardState.IDLE
        yield topics.GUARD(GuardStatus(self.now, state, "", "", "", 0.5))


class TileMapper(Service):
    """A new tile each tick, three in all, a pose, and no pose graph."""

    def __init__(self) -> None:
        super().__init__(Section(), ROBOT)
        self.version = 0
        self.parts: list[bytes] = []
        self.started: list[StartMap] = []

    @answer(requests.FETCH_MAP)
    def fetch(self, request: FetchMap) -> Answer[MapPart]:
        yield from ()
        return MapPart(self.now, False, NO_GRAPH.code, "")

    @answer(requests.START_MAP)
    def start(self, request: StartMap) -> Answer[Reply]:
        assert request.mode is MapMode.LOCALISE
        self.started.append(request)
        yield from ()
        return Reply(self.now, len(self.started) < 3, MAP_REFUSED.code, "")

    @answer(requests.GIVE_MAP)
    def give(self, request: GiveMap) -> Answer[Reply]:
        self.parts.append(request.data)
        yield from ()
        return Reply(self.now, True, "", "")

    @every(hz=20)
    def tick(self) -> Out:
        if self.version < 3:
            self.version += 1
            row = np.array([self.version], np.int32)
            cells = np.full((1, 4096), 100 * (self.version % 2), np.int8)
            yield topics.MAP(MapUpdate(self.now, 1, self.version, 0.05, row, row, cells))
        yield topics.POSE(sample_messages.pose_estimate(self.now))


@pytest.fixture
def where():
    with free_stack() as claim:
        yield claim.where


def test_goto_succeeds_where_the_navigator_says_so(where, capsys):
    with running(ReachingNavigator(), "navigator", where):
        assert _status(["goto", "1", "-2", "--stack", str(where.domain)]) == 0
        assert "(1.00, -2.00)" in capsys.readouterr().out
        assert _status(["goto", "101", "0", "--stack", str(where.domain)]) == 2
        assert "outside the map" in capsys.readouterr().err


def test_a_route_is_driven_paused_and_gone_on_with(where, capsys):
    navigator, stack = ReachingNavigator(), ["--stack", str(where.domain)]
    with running(navigator, "navigator", where):
        assert _status(["route", "1,-2,90", "3,4,-90", "--loops", "2", "--dwell", "1.5", *stack]) == 0
        assert _status(["route", "--pause", *stack]) == 0
        assert _status(["route", "--resume", *stack]) == 0
    route, pause, resume = navigator.asked
    assert [(p.x, p.y, round(p.yaw, 4)) for p in route.poses] == [(1, -2, 1.5708), (3, 4, -1.5708)]
    assert (route.loops, route.dwell, route.any_heading) == (2, 1.5, False)
    assert (pause.paused, resume.paused) == (True, False)
    assert "paused\ngoing on\n" in capsys.readouterr().out


def test_explore_waits_for_its_end(where, capsys):
    navigator = ReachingNavigator()
    with running(navigator, "navigator", where):
        assert _status(["explore", "--stack", str(where.domain)]) == 0
    assert [type(request) for request in navigator.asked] == [Explore]


def test_ctrl_c_cancels_the_goal_and_says_so(where, capsys):
    navigator = ReachingNavigator()
    navigator.slow = True
    with running(navigator, "navigator", where):
        ends = once(lambda: navigator.asked, lambda: os.kill(os.getpid(), signal.SIGINT))
        assert _status(["goto", "1", "2", "--stack", str(where.domain)]) == 130
        ends.join()
    assert navigator.canceled.is_set()
    assert "canceled" in capsys.readouterr().err


def _hold_keys(terminal: int, driven: list[tuple[float, float]]) -> None:
    """Holds keys until the robot drives their way, then the next ones, as a terminal repeats them; then quits."""
    limit = time.monotonic() + 60
    for key, way in ((b"w", (0.2, 0.0)), (b"w\x1b[D", (0.2, 1.57)), (b"\x1b[D", (0.0, 1.57))):
        while not any((round(v, 2), round(w, 2)) == way for v, w in driven) and time.monotonic() < limit:
            os.write(terminal, key)
            threading.Event().wait(0.1)
    os.write(terminal, b"q")


def test_keys_drive_and_their_end_stands(where, capsys, monkeypatch):
    guard = StopGuard()
    terminal, keyboard = os.openpty()
    with (
        running(guard, "guard", where),
        os.fdopen(keyboard) as keys,
        ThreadPoolExecutor(1) as typist,
    ):
        monkeypatch.setattr(sys, "stdin", keys)
        typed = typist.submit(_hold_keys, terminal, guard.driven)
        assert _status(["teleop", "--speed", "0.2", "--turn", "90", "--stack", str(where.domain)]) == 0
        typed.result()
    os.close(terminal)
    ways = list(dict.fromkeys((round(v, 2), round(w, 2)) for v, w in guard.driven))
    assert {(0.2, 0.0), (0.2, 1.57), (0.0, 1.57)} <= set(ways)
    assert guard.driven[-1] == (0.0, 0.0)


def test_a_map_is_saved_shown_and_given_back(where, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    mapper, stack = TileMapper(), ["--stack", str(where.domain)]
    with running(mapper, "mapper", where):
        with Client(ROBOT.name, where) as client:
            client.follow(topics.MAP)
            assert client.wait(topics.MAP, lambda m: len(m.rows) == 3, 30) is not None
        assert _status(["map", "show", *stack]) == 0
        assert "###" in capsys.readouterr().out
        assert _status(["map", "save", "room", *stack]) == 0
        assert {path.name for path in (tmp_path / "maps" / "room").iterdir()} == {"map.pgm", "map.yaml", "map.png"}
        assert _status(["map", "load", "room", "--at", "2", "-1", "90", *stack]) == 0
        assert _status(["map", "load", "room", *stack]) == 0
        assert _status(["map", "load", "room", *stack]) == 2
    near, anywhere, _ = mapper.started
    (at,) = near.at
    assert (at.x, at.y, round(at.yaw, 4)) == (2, -1, 1.5708)
    assert anywhere.at == ()
    tiles = unpack_map(mapper.parts[0], "what was given").tiles
    saved = [tuple(tile) for tile in zip(tiles.rows, tiles.columns, tiles.cells[:, 0])]
    assert saved == [(1, 1, 100), (2, 2, 0), (3, 3, 100)]


def test_a_canceled_goto_is_no_success(where, capsys):
    navigator = ReachingNavigator()
    navigator.slow = True
    with running(navigator, "navigator", where):
        ends = once(lambda: navigator.asked, lambda: _cancel(where))
        assert _status(["goto", "1", "2", "--stack", str(where.domain)]) == 1
        ends.join()
    assert navigator.canceled.is_set()


def _cancel(where) -> None:  # type: ignore[no-untyped-def]
    with Client(ROBOT.name, where) as client:
        client.answers(requests.CANCEL, 30.0)
        client.ask(requests.CANCEL, Cancel(client.now()))


def test_stop_is_confirmed_and_released(where, capsys):
    guard = StopGuard()
    with running(guard, "guard", where):
        assert _status(["estop", "--stack", str(where.domain)]) == 0
        assert guard.pressed
        assert _status(["estop", "--release", "--stack", str(where.domain)]) == 0
        assert not guard.pressed


def test_a_stop_that_nobody_confirms_is_an_error(where, capsys):
    assert _status(["estop", "--stack", str(where.domain)]) == 2
    assert "not confirmed" in capsys.readouterr().err


def test_a_tool_that_comes_late_gets_the_whole_map(where):
    with running(TileMapper(), "mapper", where) as live:
        with Client(ROBOT.name, where) as early:
            early.follow(topics.MAP)
            assert early.wait(topics.MAP, lambda m: m.version == 3, 30) is not None
            assert early.wait(topics.MAP, lambda m: len(m.rows) == 3, 30) is not None
        assert live.host.service.version == 3
        with Client(ROBOT.name, where) as late:
            late.follow(topics.MAP)
            assert late.wait(topics.MAP, lambda m: len(m.rows) == 3, 30) is not None
            assert len(late.latched_value(topics.MAP).rows) == 3


def test_a_new_session_waits_for_a_kept_value_until_its_service_is_known(where, monkeypatch):
    monkeypatch.setattr("shared.runners.client.SETTLING_S", 20.0)
    with Client(ROBOT.name, where) as client, ThreadPoolExecutor() as asking:
        asked = asking.submit(client.latched_value, topics.MAP)
        with running(TileMapper(), "mapper", where):
            assert asked.result(30) is not None


def test_echo_and_hz_are_data(where, capsys):
    with running(StopGuard(), "guard", where):
        assert _status(["topic", "echo", "guard/status", "-n", "3", "--json", "--stack", str(where.domain)]) == 0
        rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
        assert [row["state"] for row in rows] == ["idle"] * 3
        assert _status(["topic", "hz", "guard/status", "--seconds", "1", "--json", "--stack", str(where.domain)]) == 0
        assert json.loads(capsys.readouterr().out)["hz"] > 1


def test_the_first_request_of_a_session_waits_until_its_service_is_known(where, monkeypatch):
    monkeypatch.setattr("shared.runners.client.SETTLING_S", 20.0)
    with Client(ROBOT.name, where) as client, ThreadPoolExecutor() as asking:
        asked = asking.submit(client.ask, requests.CANCEL, Cancel(client.now()))
        with running(ReachingNavigator(), "navigator", where):
            assert asked.result(20).accepted


def test_a_request_that_nobody_answers_is_an_error(where):
    with Client(ROBOT.name, where) as client, pytest.raises(UserError, match="navigator does not run"):
        client.ask(requests.CANCEL, Cancel(client.now()))


def test_two_stacks_do_not_hear_each_other(where):
    with free_stack() as other, running(StopGuard(), "guard", where), Client(ROBOT.name, other.where) as client:
        client.follow(topics.GUARD)
        with Client(ROBOT.name, where) as same:
            same.follow(topics.GUARD)
            assert same.wait(topics.GUARD, lambda s: True, 30) is not None
        assert client.latest(topics.GUARD) is None
