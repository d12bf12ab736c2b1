# SPDX-License-Identifier: Apache-2.0
"""`zenav fleet task` and `dispatch` as processes, with robots of toy services at one router."""

import json
import signal
import subprocess
import sys
import threading
import time
from contextlib import ExitStack

import pytest

from shared import sample_messages, topics
from shared.config import Section
from shared.messages import Localization
from shared.runners.transport import stack_address
from shared.service import Out, Service, every
from tests.stack.test_client import ROBOT, ReachingNavigator, StopGuard
from tests.stack.test_fleet import router  # noqa: F401  # a fixture
from tests.stack.test_live import running
from zenav.__main__ import _status

LIMIT_S = 30.0


class StandingMapper(Service):
    """A pose that is known."""

    def __init__(self) -> None:
        super().__init__(Section(), ROBOT)

    @every(hz=5)
    def tick(self) -> Out:
        estimate = sample_messages.pose_estimate(self.now)
        assert estimate.state is Localization.GOOD
        yield topics.POSE(estimate)


def robot(open_things, name, where):
    """Its navigator and guard."""
    navigator, guard = ReachingNavigator(), StopGuard()
    for service, of in ((navigator, "navigator"), (guard, "guard"), (StandingMapper(), "mapper")):
        open_things.enter_context(running(service, of, stack_address(where), name))
    return navigator, guard


def dispatcher(open_things, queue, where):
    """A process that gives out the queue's tasks."""
    command = [sys.executable, "-m", "zenav", "fleet", "dispatch", "--queue", str(queue), "--stack", where]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    open_things.enter_context(process)
    open_things.callback(process.kill)
    return process


def tasks(queue, capsys):
    capsys.readouterr()
    assert _status(["fleet", "task", "list", "--all", "--json", "--queue", str(queue)]) == 0
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def until(queue, capsys, states):
    limit = time.monotonic() + LIMIT_S
    while [task["state"] for task in tasks(queue, capsys)] != states:
        assert time.monotonic() < limit, tasks(queue, capsys)
        threading.Event().wait(0.1)


def test_tasks_survive_a_killed_dispatcher_and_go_to_the_robot_that_is_not_stopped(router, tmp_path, capsys):  # noqa: F811
    queue = tmp_path / "fleet.sqlite"
    with ExitStack() as open_things:
        red, red_guard = robot(open_things, "red", router)
        blue, _ = robot(open_things, "blue", router)
        red_guard.pressed = True
        assert _status(["fleet", "task", "add", "1,2 -> 3,4", "--queue", str(queue)]) == 0
        first = dispatcher(open_things, queue, router)
        until(queue, capsys, ["done"])
        assert [pose.x for pose in blue.asked[0].poses] == [1, 3]
        first.kill()
        first.wait()
        assert _status(["fleet", "task", "add", "5,6", "--only", "red", "--queue", str(queue)]) == 0
        second = dispatcher(open_things, queue, router)
        assert second.stdout.readline().endswith("1 wait\n")
        assert _status(["fleet", "dispatch", "--queue", str(queue), "--stack", router]) == 2
        assert "another process gives out the tasks" in capsys.readouterr().err
        red_guard.pressed = False
        until(queue, capsys, ["done", "done"])
        assert (len(red.asked), len(blue.asked)) == (1, 1)
        second.send_signal(signal.SIGTERM)
        assert second.wait(10) == 0


@pytest.mark.parametrize(
    ("words", "error"),
    [
        (["add", "nowhere"], "'nowhere' is no"),
        (["add", "1,2 ->"], "is no pose"),
        (["add", "1,2,90 -> 3,4"], "some poses have a heading"),
        (["cancel", "3"], "no task 3"),
    ],
)
def test_wrong_tasks_are_refused_in_one_line_and_the_queue_stays_empty(words, error, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert _status(["fleet", "task", *words]) == 2
    assert error in capsys.readouterr().err.splitlines()[0]
    assert tasks("fleet.sqlite", capsys) == []
