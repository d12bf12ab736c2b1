# SPDX-License-Identifier: Apache-2.0
"""The live view: a client of Foxglove's protocol against toy services, and against a whole simulated stack."""

import json
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from math import pi, sqrt

import numpy as np
import pytest

from shared import requests, topics
from shared.config import Section
from shared.geometry import Pose2
from shared.messages import MapMode, NavState, Odometry, Velocity
from shared.requests import Reply, StartMap
from shared.runners.transport import StackAddress
from shared.service import Answer, Out, Service, answer, every
from tests.stack.foxglove_app import FakeApp, stamped, twist
from tests.stack.processes import running as stack_of
from tests.stack.processes import wait
from tests.stack.test_client import ReachingNavigator, StopGuard
from tests.stack.test_live import ROBOT, running
from tests.unit.zenav.foxglove.test_layout import named_topics
from tests.unit.zenav.foxglove.test_schemas import cell_at
from zenav.__main__ import _status
from zenav.client import Client
from zenav.console.shutdown import StopFlag
from zenav.foxglove.server import live_view
from zenav.stack.launch import free_stack


@pytest.fixture
def where() -> Iterator[StackAddress]:
    with free_stack() as claim:
        yield claim.where


@contextmanager
def served(where: StackAddress) -> Iterator[int]:
    """A live view of a stack, in a thread; its port."""
    stop = StopFlag()
    with Client(ROBOT.name, where) as client, live_view(client, ROBOT, "127.0.0.1", 0) as view:
        thread = threading.Thread(target=view.run, args=(stop,))
        thread.start()
        try:
            yield view.port
        finally:
            stop.set()
            thread.join(10)
            assert not thread.is_alive()


def test_a_goal_of_the_3d_panel_is_given_to_the_navigator_and_shown(where):
    navigator = ReachingNavigator()
    with running(navigator, "navigator", where), served(where) as port, FakeApp(port) as app:
        app.announce("/move_base_simple/goal", "geometry_msgs/PoseStamped")
        app.publish("/move_base_simple/goal", stamped(2.0, -1.0, z=sqrt(0.5), w=sqrt(0.5)))
        app.until(lambda: app.told("task 1"))
        app.subscribe("/nav/status", "/nav/goal")
        app.until(lambda: (app.last("/nav/status") or {}).get("state") == "reached")
        goal = app.until(lambda: app.last("/nav/goal"))
    (request,) = navigator.asked
    (pose,) = request.poses
    assert (pose.x, pose.y, round(pose.yaw, 6)) == (2.0, -1.0, round(pi / 2, 6))
    assert not request.any_heading
    assert (goal["frame_id"], goal["pose"]["position"]["x"]) == ("map", 2.0)


BAD = [
    (stamped(2.0, 1.0, frame="odom"), "frame 'odom'"),
    (stamped(float("nan"), 1.0), "x is not finite"),
    (stamped(1.0, float("-inf")), "y is not finite"),
    (stamped(1e9, 1.0), "farther out"),
    (stamped(1.0, 1.0, w=0.0), "no turn about the vertical"),
    ({"header": {"frame_id": "map"}}, "no 'pose'"),
    (b"\xff{", "not JSON"),
    (b"[1, 2]", "not a JSON object"),
]


def test_bad_messages_are_refused_and_told_and_the_next_good_one_is_taken(where, capsys):
    navigator = ReachingNavigator()
    with running(navigator, "navigator", where), served(where) as port, FakeApp(port) as app:
        app.announce("/goal", "geometry_msgs/PoseStamped")
        for content, words in BAD:
            app.statuses.clear()
            app.publish("/goal", content)
            app.until(lambda words=words: app.told(words))
        app.announce("/goal_pose", "sensor_msgs/Image")
        app.until(lambda: app.told("/goal_pose takes geometry_msgs/PoseStamped"))
        app.announce("/clicked_point", "geometry_msgs/PointStamped")
        app.until(lambda: app.told("nothing listens on /clicked_point"))
        app.announce("/initialpose", "geometry_msgs/PoseStamped", encoding="cdr")
        app.until(lambda: app.told("/initialpose takes json, not cdr"))
        app.publish("/goal_pose", stamped(1.0, 1.0))
        app.until(lambda: app.told("a channel that was refused"))
        assert navigator.asked == []
        app.publish("/goal", stamped(101.0, 1.0))
        app.until(lambda: app.told("outside the map"))
        app.publish("/goal", stamped(1.0, 1.0))
        app.until(lambda: app.told("task 1"))
    assert "refused from client" in capsys.readouterr().err


class AppMapper(Service):
    """Takes any pose."""

    def __init__(self) -> None:
        super().__init__(Section(), ROBOT)
        self.asked: list[StartMap] = []

    @answer(requests.START_MAP)
    def start(self, request: StartMap) -> Answer[Reply]:
        self.asked.append(request)
        yield from ()
        return Reply(self.now, True, "", "")


def test_a_pose_estimate_tells_the_mapper_where_the_robot_is(where):
    mapper = AppMapper()
    with running(mapper, "mapper", where), served(where) as port, FakeApp(port) as app:
        app.announce("/initialpose", "geometry_msgs/PoseWithCovarianceStamped")
        there = stamped(3.0, 4.0)
        app.publish("/initialpose", {**there, "pose": {"pose": there["pose"], "covariance": [0] * 36}})
        app.until(lambda: app.told("pose (3.00, 4.00, 0 degrees)"))
    (request,) = mapper.asked
    assert (request.mode, request.transfer, request.at) == (MapMode.CONTINUE, 0, (Pose2(3.0, 4.0, 0.0),))


def drives(guard: StopGuard, v: float) -> bool:
    return bool(guard.driven) and guard.driven[-1] == (v, 0.0)


def test_teleop_drives_while_it_sends_and_stands_when_it_stops_sending(where):
    guard = StopGuard()
    with running(guard, "guard", where), served(where) as port, FakeApp(port) as app:
        app.announce("/teleop", "geometry_msgs/Twist")
        app.until(lambda: drives(guard, 0.3), meanwhile=lambda: app.publish("/teleop", twist(0.3, 0.0)))
        app.until(lambda: drives(guard, 0.0))
        app.until(lambda: drives(guard, -0.1), meanwhile=lambda: app.publish("/teleop", twist(-0.1, 0.0)))


def test_teleop_stands_at_once_when_its_client_is_gone(where):
    guard = StopGuard()
    with running(guard, "guard", where), served(where) as port, FakeApp(port) as watcher:
        app = FakeApp(port)
        app.announce("/cmd_vel", "geometry_msgs/Twist")
        app.until(lambda: drives(guard, 0.3), meanwhile=lambda: app.publish("/cmd_vel", twist(0.3, 0.0)))
        app.publish("/cmd_vel", twist(0.3, 0.0))
        app.socket.cut()  # no goodbye: a browser that was killed
        watcher.until(lambda: drives(guard, 0.0))
        watcher.until(lambda: watcher.told("the robot stands"))
        n_sent = len(guard.driven)
        wait(1.5)
        assert len(guard.driven) < n_sent + 15, "then it falls silent, so that the navigator may drive"


def test_one_client_drives_and_another_is_refused_until_it_lets_go(where):
    guard = StopGuard()
    with running(guard, "guard", where), served(where) as port, FakeApp(port) as first, FakeApp(port) as second:
        for app in (first, second):
            app.announce("/teleop", "geometry_msgs/Twist")

        def both() -> None:
            first.publish("/teleop", twist(0.3, 0.0))
            second.publish("/teleop", twist(-0.3, 0.0))

        first.until(lambda: drives(guard, 0.3), meanwhile=lambda: first.publish("/teleop", twist(0.3, 0.0)))
        second.until(lambda: second.told("drives: it must let go"), meanwhile=both)
        assert (-0.3, 0.0) not in guard.driven
        second.until(lambda: drives(guard, -0.3), meanwhile=lambda: second.publish("/teleop", twist(-0.3, 0.0)))


def test_another_tool_that_drives_has_the_robot_whoever_came_first(where):
    guard = StopGuard()
    with (
        running(guard, "guard", where),
        served(where) as port,
        FakeApp(port) as app,
        Client(ROBOT.name, where) as keyboard,
    ):
        app.announce("/teleop", "geometry_msgs/Twist")
        app.until(lambda: drives(guard, -0.3), meanwhile=lambda: app.publish("/teleop", twist(-0.3, 0.0)))

        def both() -> None:
            keyboard.publish(topics.TELEOP(Velocity(keyboard.now(), 0.2, 0.0, "")))
            app.publish("/teleop", twist(-0.3, 0.0))

        app.until(lambda: app.told("somebody drives from elsewhere"), meanwhile=both)
        app.until(lambda: drives(guard, 0.2), meanwhile=both)
        guard.driven.clear()
        app.until(lambda: len(guard.driven) > 20, meanwhile=both)
        assert set(guard.driven) == {(0.2, 0.0)}
        app.until(lambda: drives(guard, -0.3), meanwhile=lambda: app.publish("/teleop", twist(-0.3, 0.0)))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (twist(float("nan"), 0.0), "x is not finite"),
        (twist(0.1, float("inf")), "z is not finite"),
        (twist(1e3, 0.0), "faster than any robot"),
        ({**twist(0.1, 0.0), "linear": {"x": 0.1, "y": 0.1, "z": 0}}, "nothing else"),
        ({"linear": {"x": True}, "angular": {"z": 0}}, "x is no number"),
        ({"linear": {"x": 10**400}, "angular": {"z": 0}}, "x is not finite"),
    ],
)
def test_a_velocity_that_is_none_drives_nothing(where, content, words):
    guard = StopGuard()
    with running(guard, "guard", where), served(where) as port, FakeApp(port) as app:
        app.announce("/teleop", "geometry_msgs/Twist")
        app.publish("/teleop", content)
        app.until(lambda: app.told(words))
    assert guard.driven == []


def test_services_stop_release_explore_and_cancel(where):
    guard, navigator = StopGuard(), ReachingNavigator()
    navigator.slow = True
    with (
        running(guard, "guard", where),
        running(navigator, "navigator", where),
        served(where) as port,
        FakeApp(port) as app,
    ):
        assert app.call("/estop") == {"success": True, "message": "STOP is pressed"}
        assert guard.pressed
        assert app.call("/estop_release")["success"]
        assert not guard.pressed
        assert app.call("/explore") == {"success": True, "message": "exploring"}
        assert app.call("/cancel")["success"]
        assert navigator.canceled.is_set()
        assert "no JSON object" in app.call("/cancel", b"[]")["failure"]


def test_without_a_stack_it_says_so_and_waits_for_it(where):
    with served(where) as port, FakeApp(port) as app:
        app.until(lambda: app.told("no stack answers"))
        assert not app.call("/cancel")["success"]
        with running(ReachingNavigator(), "navigator", where):
            app.until(lambda: app.told("the stack is there"))
            app.subscribe("/nav/status", "/health/navigator")
            app.until(lambda: app.last("/nav/status") and app.last("/health/navigator"))
        app.subscribe("/diagnostics")

        def stale() -> bool:
            told = [message["status"][0] for _, message in app.messages.get("/diagnostics", [])]
            return any(status["name"] == "service navigator" and status["level"] == 3 for status in told)

        app.until(stale)
        assert not app.told("navigator is silent"), "that the stack is gone says enough"
        app.until(lambda: app.statuses.count(app.statuses[0]) == 2)


def test_a_service_that_falls_silent_is_named_and_told_when_it_is_back(where):
    with running(StopGuard(), "guard", where), served(where) as port, FakeApp(port) as app:
        with running(ReachingNavigator(), "navigator", where):
            app.subscribe("/health/navigator")
            app.until(lambda: app.last("/health/navigator"))
        app.until(lambda: app.told("navigator is silent"))
        with running(ReachingNavigator(), "navigator", where):
            app.until(lambda: app.told("navigator is back"))


class Odometer(Service):
    @every(hz=50)
    def tick(self) -> Out:
        yield topics.ODOM(Odometry(self.now, Pose2(), 0.1, 0.0, np.zeros(9)))


def test_a_client_that_does_not_read_holds_nobody_up(where):
    with running(Odometer(Section(), ROBOT), "odometry", where), served(where) as port, FakeApp(port) as quick:
        quick.subscribe("/odom", "/tf")
        stuck = FakeApp(port)
        stuck.subscribe("/odom", "/tf", "/health/odometry")
        n_before = len(quick.messages.get("/odom", []))
        quick.until(lambda: len(quick.messages.get("/odom", [])) > n_before + 100)
        stuck.socket.cut()
    stamps = [at for at, _ in quick.messages["/odom"]]
    assert stamps == sorted(set(stamps))


def test_a_taken_port_is_an_error_of_one_line(where, capsys):
    with served(where) as port:
        assert _status(["foxglove", "--stack", str(where.domain), "--port", str(port)]) == 2
    told = [line for line in capsys.readouterr().err.splitlines() if "listen" in line or "hint" in line]
    assert told == [
        f"cannot listen on 127.0.0.1:{port}: Address already in use (os error 98)",
        "hint: another `zenav foxglove`? choose --port",
    ]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_command_ends_on_a_signal_and_frees_its_port(where, number):
    command = [sys.executable, "-m", "zenav", "foxglove", "--stack", str(where.domain), "--port", "0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        line = process.stderr.readline()
        port = int(line.split("ws://127.0.0.1:")[1].split(":")[0])
        with FakeApp(port) as app:
            assert "/map" in app.channels
            os.kill(process.pid, number)
            assert process.wait(10) == 0
        opened_on(where, port)


def opened_on(where: StackAddress, port: int) -> None:
    with Client(ROBOT.name, where) as client, live_view(client, ROBOT, "127.0.0.1", port) as view:
        assert view.port == port


def test_the_app_sees_a_simulated_robot_and_sends_it_to_a_goal(tmp_path):
    with stack_of(tmp_path) as stack, served(stack.where) as port, FakeApp(port) as app:
        app.subscribe("/map", "/scan", "/pose", "/tf", "/plan", "/robot", "/debug/costmap", "/debug/rollouts")
        for topic in ("/map", "/scan", "/pose", "/robot", "/debug/costmap"):
            app.until(lambda topic=topic: app.last(topic), meanwhile=stack.launcher.step)

        def frames() -> set[tuple[str, str]]:
            received = [t for _, m in app.messages.get("/tf", []) for t in m["transforms"]]
            return {(t["parent_frame_id"], t["child_frame_id"]) for t in received}

        app.until(lambda: len(frames()) >= 3, meanwhile=stack.launcher.step)
        assert frames() == {("map", "odom"), ("odom", "base_link"), ("base_link", "laser")}
        pose = app.last("/pose")["pose"]["position"]
        (_, cell) = cell_at(app.last("/map"), pose["x"], pose["y"])
        assert 0 <= cell < 50, "the robot stands on free ground"
        scan = app.last("/scan")
        assert np.isfinite(scan["ranges"]).sum() > 100

        app.announce("/goal", "foxglove.PoseInFrame")
        app.publish("/goal", {"timestamp": {"sec": 0, "nsec": 0}, "frame_id": "map", "pose": stamped(0.5, 0.0)["pose"]})

        def there() -> bool:
            nav = stack.client.latest(topics.NAV_STATUS)
            return nav is not None and nav.task_id > 0 and nav.state is NavState.REACHED

        app.until(there, 60, stack.launcher.step)
        app.until(lambda: abs(app.last("/pose")["pose"]["position"]["x"] - 0.5) < 0.3)
        assert any(message["poses"] for _, message in app.messages["/plan"])
        ways = [entity for _, message in app.messages["/debug/rollouts"] for entity in message["entities"]]
        assert len(ways[0]["lines"]) > 10
        assert app.times == sorted(app.times)

        app.announce("/teleop", "geometry_msgs/Twist")
        moved = stack.client.latest(topics.TRUTH).distance

        def driven() -> bool:
            return stack.client.latest(topics.TRUTH).distance > moved + 0.05

        app.until(driven, 20, lambda: app.publish("/teleop", twist(-0.1, 0.6)))
        app.socket.close()
        stack.until(lambda: stack.client.latest(topics.TRUTH).v == 0)


def test_the_layout_names_what_is_there(capsys):
    assert _status(["foxglove", "--layout"]) == 0
    assert named_topics(json.loads(capsys.readouterr().out))
