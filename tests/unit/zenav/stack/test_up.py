# SPDX-License-Identifier: Apache-2.0
"""What `zenav up` does with a wrong world, while it waits for the mapper, and when its terminal is gone."""

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from shared.config import UserError
from shared.messages import MapMode
from zenav.client.map_modes import OnMap
from zenav.console.shutdown import StopFlag
from zenav.stack import up as command
from zenav.stack.launch import free_stack
from zenav.stack.up import UpOptions


class WaitingLauncher:
    """Counts its steps; in the second one the user asks to end."""

    def __init__(self, stop: StopFlag) -> None:
        self.stop, self.n_steps, self.logs = stop, 0, Path("logs")

    def step(self) -> None:
        self.n_steps += 1
        if self.n_steps == 2:
            self.stop.set()


SILENT = SimpleNamespace(answers=lambda request, seconds: False)


def plan(on_map):
    return SimpleNamespace(options=SimpleNamespace(on_map=on_map), saved=b"a map")


def test_while_the_mapper_does_not_answer_services_are_watched_and_ctrl_c_ends_it():
    stop = StopFlag()
    launcher = WaitingLauncher(stop)
    command._give_map(plan(object()), SILENT, launcher, stop)
    assert launcher.n_steps == 2


def test_a_mapper_that_never_answers_is_an_error(monkeypatch):
    monkeypatch.setattr(command, "START_LIMIT", 0.0)
    stop = StopFlag()
    with pytest.raises(UserError, match="the mapper does not answer"):
        command._give_map(plan(object()), SILENT, WaitingLauncher(stop), stop)


def test_a_map_without_a_mapper_is_refused_before_anything_starts(monkeypatch):
    monkeypatch.setattr(OnMap, "read", lambda self, file: b"a map")
    on_map = OnMap(Path("office"), MapMode.LOCALISE, None)
    with pytest.raises(UserError, match="a map is for the mapper"):
        command._planned(UpOptions(world="room", only=["sim", "base_driver"], on_map=on_map, page=False))


WRONG_WORLD = """
walls:
  - points: [[0, 0], [5, 0]]
people:
  - {route: [[-1, 0], [6, 0]], speed: 1.0}
"""


def test_a_wrong_world_is_named_before_a_service_starts_and_leaves_nothing(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(command, "warm_first", lambda *_: None)  # its kernels are compiled: the world was right before
    Path("wrong.yaml").write_text(WRONG_WORLD)
    with free_stack() as claim:
        number = str(claim.where.domain)
    with pytest.raises(UserError, match=r"wrong.yaml:5.*runs into something"):
        command.up(UpOptions(world="wrong.yaml", stack=number))
    assert list(Path("out").iterdir()) == []
    assert capsys.readouterr().err == ""


def test_a_terminal_that_was_closed_does_not_end_the_end(monkeypatch):
    def write(text: str) -> None:
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(sys, "stderr", SimpleNamespace(write=write, isatty=lambda: False, flush=lambda: None))
    command._print_line("zenav", "ending")
