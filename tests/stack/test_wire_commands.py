# SPDX-License-Identifier: Apache-2.0
"""`zenav topic pub`, `topic check` and `request` against toy services over Zenoh."""

import json
import os
import signal
from collections.abc import Iterator

import pytest

from tests.stack.processes import once
from tests.stack.test_client import ReachingNavigator, StopGuard
from tests.stack.test_live import running
from zenav.__main__ import _status
from zenav.stack.launch import free_stack

ZERO = '{"v": 0.25, "w": 0, "reason": ""}'


@pytest.fixture(scope="module")
def toys() -> Iterator[tuple[list[str], StopGuard]]:
    guard, navigator = StopGuard(), ReachingNavigator()
    with free_stack() as claim, running(guard, "guard", claim.where), running(navigator, "navigator", claim.where):
        yield ["--stack", str(claim.where.domain)], guard


def test_a_message_is_published_once_or_again_and_again(toys, capsys):
    stack, guard = toys
    assert _status(["topic", "pub", "cmd/teleop", ZERO, *stack]) == 0
    assert capsys.readouterr().out == "cmd/teleop: 1 message as operator\n"
    ends = once(lambda: len(guard.driven) > 4, lambda: os.kill(os.getpid(), signal.SIGINT))
    assert _status(["topic", "pub", "cmd/teleop", ZERO, "--hz", "20", *stack]) == 0
    ends.join()
    assert len(guard.driven) > 3
    assert set(guard.driven) == {(0.25, 0.0)}


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["topic", "pub", "cmd/teleop", '{"v": 99}'], "not a Velocity"),
        (["topic", "pub", "cmd/vel", ZERO], "published by guard"),
        (["topic", "pub", "scan/x", ZERO], "scan/x is not a topic"),
        (["topic", "pub", "hardware/motors", '{"left": 0, "right": 0}', "--as", "base_driver"], "nothing listens to"),
        (["topic", "check", "odom", "--seconds", "0.5"], "nothing on odom"),
        (["request", "fly"], "fly is not a request"),
        (["request", "navigate", '{"poses": []}'], "missing"),
    ],
)
def test_a_wrong_argument_is_one_line_and_a_hint(toys, capsys, arguments, said):
    assert _status([*arguments, *toys[0]]) == 2
    what, hint = capsys.readouterr().err.splitlines()
    assert said in what
    assert hint.startswith("hint: ")


def test_a_request_prints_its_reply_and_a_refusal_its_hint(toys, capsys):
    route = {"dwell": 0, "loops": 1, "any_heading": True}
    assert _status(["request", "navigate", json.dumps({**route, "poses": [[1, 0, 0]]}), *toys[0]]) == 0
    assert json.loads(capsys.readouterr().out)["accepted"] is True
    assert _status(["request", "navigate", json.dumps({**route, "poses": [[101, 0, 0]]}), *toys[0]]) == 1
    shown = capsys.readouterr()
    assert json.loads(shown.out)["reason"] == "goal_outside"
    assert "outside the map\nhint: " in shown.err


def test_messages_that_pass_are_counted(toys, capsys):
    assert _status(["topic", "check", "guard/status", "--seconds", "1", *toys[0]]) == 0
    assert "messages of guard pass" in capsys.readouterr().out
