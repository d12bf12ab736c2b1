# SPDX-License-Identifier: Apache-2.0
"""What people are asked, and what counts as an answer."""

from io import StringIO

import pytest

from shared.config import UserError
from zenav.__main__ import _status
from zenav.calibrate.commands import ask_answers, read_end_pose
from zenav.calibrate.live import confirm
from zenav.calibrate.motor_response import WheelTurn


class Terminal(StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def types(monkeypatch):
    return lambda text, terminal=True: monkeypatch.setattr("sys.stdin", (Terminal if terminal else StringIO)(text))


@pytest.mark.parametrize(("typed", "answer"), [("\n", ""), ("LB\n", "lb"), ("what?\n\n", ""), ("x\n-\n", "-")])
def test_what_turned_is_asked_until_it_is_an_answer(types, typed, answer):
    types(typed)
    assert ask_answers(WheelTurn(0, 0.08, 0.08, 0.0)) == answer


@pytest.mark.parametrize("typed", ["0.1 -0.25\n", "0.1, -0.25\n", "no idea\n0.1 -0.25\n", "1\n9 9\n0.1 -0.25\n"])
def test_an_end_is_asked_until_it_is_two_metres(types, typed):
    types(typed)
    assert read_end_pose() == (0.1, -0.25)


def test_an_input_that_ends_is_told(types):
    types("")
    with pytest.raises(UserError, match="input has ended"):
        read_end_pose()


@pytest.mark.parametrize("typed", ["y\n", "Yes\n"])
def test_only_a_yes_starts_the_robot(types, typed, capsys):
    types(typed)
    confirm("it drives", False)
    assert "it drives" in capsys.readouterr().err
    for other in ("\n", "n\n", "", "go\n"):
        types(other)
        with pytest.raises(UserError, match="not started"):
            confirm("it drives", False)


def test_nobody_there_starts_nothing_but_with_yes(types):
    types("", False)
    with pytest.raises(UserError, match="no terminal"):
        confirm("it drives", False)
    confirm("it drives", True)


@pytest.mark.parametrize("command", ["odometry", "motors", "motors --blocks"])
def test_a_drive_without_a_stack_or_a_yes_ends_in_one_line(types, command, capsys):
    types("", False)
    assert _status(["calibrate", *command.split()]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert lines[-2:] == ["no terminal to confirm the drive", "hint: say --yes where the floor is free"]
    types("", False)
    assert _status(["calibrate", "odometry", "--measured", "--yes"]) == 2
