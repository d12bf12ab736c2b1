# SPDX-License-Identifier: Apache-2.0
"""STOP of a fleet: a stack that is away keeps no other robot from it."""

import pytest

from shared.config import UserError
from shared.robot_view import RobotView
from shared.runners.transport import StackAddress
from zenav.fleet import commands

HERE, AWAY = "tcp/127.0.0.1:7447", "tcp/127.0.0.1:7448"
ROBOTS = {HERE: ["red", "blue"]}


class FakeListener:
    """A fake of FleetListener with the robots of ROBOTS."""

    def __init__(self, stacks):
        self.stacks = stacks

    def __enter__(self):
        for stack in self.stacks:
            if stack not in ROBOTS:
                raise UserError(f"no router answers at {stack}", "is it running?")
        return self

    def __exit__(self, *_):
        pass

    def hear(self, seconds, until):
        until([RobotView(name, stack) for stack in self.stacks for name in ROBOTS[stack]])


@pytest.fixture
def stopped(monkeypatch):
    names = []

    def stop(name, where, press, by):
        assert (where, press) == (StackAddress(router=HERE), True)
        names.append(name)
        if name == "blue":
            raise UserError("the guard does not answer", "")

    monkeypatch.setattr(commands, "FleetListener", FakeListener)
    monkeypatch.setattr(commands, "confirm_stop_of", stop)
    return names


def test_a_stack_that_is_away_keeps_no_robot_of_another_from_stop(stopped, capsys):
    assert commands.stop_robots([AWAY, HERE], [], True) == 1
    assert sorted(stopped) == ["blue", "red"]
    out, err = capsys.readouterr()
    assert out == "STOP is pressed on 1 robot\n"
    assert f"stack {AWAY}: no router answers at {AWAY}" in err
    assert "blue: the guard does not answer" in err


def test_robots_are_stopped_by_name_and_one_that_is_not_heard_is_named(stopped, capsys):
    assert commands.stop_robots([AWAY, HERE], ["red", "green"], False) == 1
    assert stopped == ["red"]
    assert "green: it was not heard in stacks" in capsys.readouterr().err
    assert commands.stop_robots([HERE], ["green"], False) == 0, "of one stack it need not be heard"


def test_one_stack_that_is_away_is_an_error(stopped):
    with pytest.raises(UserError, match="no router answers"):
        commands.stop_robots([AWAY], [], True)
