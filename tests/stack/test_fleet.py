# SPDX-License-Identifier: Apache-2.0
"""`zenav fleet` and `--name`: robots of one kind on this computer and at one router."""

import json
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from shared.config import UserError
from shared.runners.presence import announce, presences
from shared.runners.transport import opened, stack_address
from tests.stack.test_client import ReachingNavigator, StopGuard
from tests.stack.test_live import running
from zenav.__main__ import _status
from zenav.stack.launch import free_stack


class Robot:
    """A robot of toy services."""

    def __init__(self, open_things: ExitStack, name: str, stack: str) -> None:
        self.name, self.stack, self.guard, self.navigator = name, stack, StopGuard(), ReachingNavigator()
        for service, of in ((self.guard, "guard"), (self.navigator, "navigator")):
            open_things.enter_context(running(service, of, stack_address(stack), name))


@pytest.fixture
def two() -> Iterator[tuple[Robot, Robot]]:
    """Robots red and blue in stacks of their own."""
    with ExitStack() as open_things:
        claims = [open_things.enter_context(free_stack()) for _ in range(2)]
        red, blue = (Robot(open_things, n, str(c.where.domain)) for n, c in zip(("red", "blue"), claims, strict=True))
        yield red, blue


@pytest.fixture
def router() -> Iterator[str]:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{s.getsockname()[1]}"
    command = [sys.executable, "-m", "zenav.stack.router", endpoint]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        assert process.stderr.readline() == f"router: listening on {endpoint}\n"
        yield endpoint
        process.send_signal(signal.SIGTERM)


def stacks(*robots: Robot) -> list[str]:
    return [word for robot in robots for word in ("--stack", robot.stack)]


def test_a_tool_with_a_name_reaches_the_robot_of_this_name_alone(router, capsys):
    with ExitStack() as open_things:
        red, blue = (Robot(open_things, name, router) for name in ("red", "blue"))
        assert _status(["goto", "1", "-2", "--name", "blue", "--stack", router]) == 0
        assert (len(red.navigator.asked), len(blue.navigator.asked)) == (0, 1)
        assert _status(["estop", "--name", "red", "--stack", router]) == 0
        assert (red.guard.pressed, blue.guard.pressed) == (True, False)
        assert _status(["fleet", "list", "--json", "--stack", router]) == 0
        rows = [json.loads(line) for line in capsys.readouterr().out.splitlines() if line.startswith("{")]
        assert [(row["name"], row["state"]) for row in rows] == [("blue", "reached"), ("red", "stopped")]


def test_the_list_shows_the_robots_of_every_stack_with_their_links(two, capsys):
    assert _status(["fleet", "list", "--json", *stacks(*two)]) == 0
    rows = {row["name"]: row for row in map(json.loads, capsys.readouterr().out.splitlines())}
    assert {(name, row["stack"], row["state"]) for name, row in rows.items()} == {
        (robot.name, robot.stack, "idle") for robot in two
    }
    assert all(row["received"] == 1.0 and 0.0 <= row["delay"] < 1.0 for row in rows.values())


def test_the_list_finds_the_stacks_of_this_computer(two, capsys):
    assert _status(["fleet", "list", "--json"]) == 0
    assert {robot.stack for robot in two} <= {
        json.loads(line)["stack"] for line in capsys.readouterr().out.splitlines()
    }


def test_stop_all_stops_each_robot_and_says_how_many(two, capsys):
    assert _status(["fleet", "stop", "--all", *stacks(*two)]) == 0
    assert all(robot.guard.pressed for robot in two)
    assert capsys.readouterr().out == "STOP is pressed on 2 robots\n"


def test_stop_by_name_stops_no_other_and_names_the_one_that_is_not_there(two, capsys):
    red, blue = two
    assert _status(["fleet", "stop", "red", "green", *stacks(*two)]) == 1
    assert (red.guard.pressed, blue.guard.pressed) == (True, False)
    told = capsys.readouterr()
    assert told.out == "STOP is pressed on 1 robot\n"
    assert told.err.startswith("green: it was not heard")
    assert "switch them off by hand" in told.err


def test_a_robot_whose_guard_hangs_is_named(router, capsys):
    with running(ReachingNavigator(), "navigator", stack_address(router), "red"):
        assert _status(["fleet", "stop", "--all", "--stack", router]) == 1
    told = capsys.readouterr()
    assert told.out == "STOP is pressed on 0 robots\n"
    assert told.err.startswith("red: the guard does not answer")


def test_stop_needs_names_or_all(capsys):
    assert _status(["fleet", "stop"]) == 2
    assert _status(["fleet", "stop", "red", "--all"]) == 2
    assert "hint: zenav fleet stop red blue" in capsys.readouterr().err


def test_goto_sends_the_robot_wherever_it_is(two, capsys):
    red, blue = two
    assert _status(["fleet", "goto", "blue", "1", "-2", *stacks(*two)]) == 0
    assert (len(red.navigator.asked), len(blue.navigator.asked)) == (0, 1)
    assert _status(["fleet", "goto", "bleu", "1", "-2", *stacks(*two)]) == 2
    assert "blue" in capsys.readouterr().err


def test_two_robots_of_one_name_in_two_stacks_are_told_and_not_sent(capsys):
    with ExitStack() as open_things:
        claims = [open_things.enter_context(free_stack()) for _ in range(2)]
        robots = [Robot(open_things, "red", str(claim.where.domain)) for claim in claims]
        assert _status(["fleet", "list", *stacks(*robots)]) == 0
        assert "several robots are named red" in capsys.readouterr().err
        assert _status(["fleet", "goto", "red", "1", "2", *stacks(*robots)]) == 2
        assert "have a robot named red" in capsys.readouterr().err
        assert not any(robot.navigator.asked for robot in robots)


def test_a_second_robot_of_a_name_is_refused_with_both_addresses_until_the_first_ends(router):
    where = stack_address(router)
    with opened(where) as other:
        with opened(where) as session:
            announce(session, "blue", is_shared=True)
            token = announce(session, "red", is_shared=True)
            with pytest.raises(UserError, match=r"^(.+ \(pid \d+\)) is a robot named red already, and \1 would be"):
                announce(other, "red", is_shared=True)
            assert len(presences(other, "red")) == 1
            token.undeclare()
        announce(other, "blue", is_shared=True)


def test_the_list_says_where_a_robot_runs_and_its_version(router, capsys):
    with running(ReachingNavigator(), "navigator", stack_address(router), "red"), opened(stack_address(router)) as here:
        token = announce(here, "red", is_shared=True)
        assert _status(["fleet", "list", "--json", "--stack", router]) == 0
        token.undeclare()
    row = json.loads(capsys.readouterr().out)
    assert "(pid" in row["address"]
    assert row["version"]


@pytest.mark.parametrize("name", ["Red", "a/b", "red*"])
def test_a_wrong_name_is_one_line(name, capsys):
    assert _status(["config", "show", "--name", name]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 2
