# SPDX-License-Identifier: Apache-2.0
"""`zenav config set` on running processes: what holds, what is refused, a killed service, and a file of the values."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from shared import requests
from shared.config import UserError, configured, load_robot
from shared.requests import SetSettings
from tests.stack.processes import StackProcesses, running, wait
from zenav.__main__ import _status
from zenav.client import Client
from zenav.page.target import PageTarget
from zenav.page.tools import run
from zenav.stack.launch import ROOT, free_stack
from zenav.stack.runtime_settings import RunningSettings

WEIGHT, SPEED = "planner.cost.clearance_weight", "robot.drive.max_speed"

pytestmark = pytest.mark.timeout(300)


@pytest.fixture
def stack(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with running(tmp_path, ("planner", "local_ctrl", "guard"), settings=(f"{SPEED}=0.7",)) as stack:
        yield stack


def command(stack: StackProcesses, *arguments: str) -> int:
    return _status(["config", *arguments, "--stack", str(stack.where.domain)])


def refusal(stack: StackProcesses, capsys, *arguments: str) -> tuple[str, str]:
    assert command(stack, *arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    what, hint = err.splitlines()
    return what, hint.removeprefix("hint: ")


def value(stack: StackProcesses, capsys, name: str) -> float:
    assert command(stack, "get", name) == 0
    return json.loads(capsys.readouterr().out)


def test_settings_change_on_a_running_stack_survive_a_crash_and_become_a_file(stack, capsys):
    assert command(stack, "set", WEIGHT, "9", f"{SPEED}=0.4") == 0
    shown = capsys.readouterr().out
    assert f"{WEIGHT} = 9.0 (was 5.0)" in shown
    assert f"{SPEED} = 0.4 (was 0.7)" in shown
    before = stack.pid("planner")
    os.kill(before, signal.SIGKILL)
    stack.until(lambda: stack.launcher.children["planner"].n_restarts == 1 and stack.up())
    assert value(stack, capsys, WEIGHT) == 9.0
    assert command(stack, "list", "--json") == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert {row["name"] for row in rows if row["set"]} == {WEIGHT, SPEED}
    assert command(stack, "save", "tuned.yaml") == 0
    saved = load_robot("tuned.yaml")
    assert saved.robot.drive.max_speed == 0.4
    assert saved.tree["planner"]["cost"]["clearance_weight"] == 9.0
    assert load_robot("x80sv").robot.drive.max_speed == 0.8
    capsys.readouterr()
    assert "exists" in refusal(stack, capsys, "save", "tuned.yaml")[0]
    assert command(stack, "reset") == 0
    assert f"{WEIGHT} = 5.0 (was 9.0)" in capsys.readouterr().out
    assert value(stack, capsys, WEIGHT) == 5.0
    assert value(stack, capsys, SPEED) == 0.7


def test_what_is_refused_changes_nothing_and_has_a_hint(stack, capsys):
    assert refusal(stack, capsys, "set", "planner.cost.clearance_wait=4")[1] == f"did you mean `{WEIGHT}`?"
    assert "needs a restart" in refusal(stack, capsys, "set", f"{WEIGHT}=4", "guard.stops.scan_age=0.1")[0]
    assert "less than or equal to 100" in refusal(stack, capsys, "set", f"{WEIGHT}=400")[0]
    assert "valid number" in refusal(stack, capsys, "set", f"{WEIGHT}=far")[0]
    assert "only be lowered" in refusal(stack, capsys, "set", f"{WEIGHT}=4", f"{SPEED}=0.75")[0]  # the file has 0.8
    assert "navigator does not run" in refusal(stack, capsys, "set", f"{WEIGHT}=4", "navigator.tolerance=0.2")[0]
    assert "no value" in refusal(stack, capsys, "set", WEIGHT)[0]
    assert "twice" in refusal(stack, capsys, "set", f"{WEIGHT}=4", f"{WEIGHT}=5")[0]
    assert value(stack, capsys, WEIGHT) == 5.0
    assert value(stack, capsys, SPEED) == 0.7


def test_where_a_service_fails_amid_a_change_the_others_go_back(stack, monkeypatch):
    running_settings = RunningSettings(stack.client, configured("x80sv", []))
    ask = RunningSettings._ask

    def fails(self, service, values=None, check=False):
        if service == "guard" and values == {SPEED: "0.2"} and not check:
            raise UserError("guard does not answer in time", "is it busy?")
        return ask(self, service, values, check)

    monkeypatch.setattr(RunningSettings, "_ask", fails)
    with pytest.raises(UserError, match="guard"):
        running_settings.change({SPEED: "0.2"})
    for service in ("local_ctrl", "guard"):
        reply = ask(running_settings, service)
        assert dict(zip(reply.names, reply.values, strict=True))[SPEED] == "0.7"


def test_a_page_sees_what_was_set_changes_it_and_goes_back(stack):
    target = PageTarget("x80sv", str(stack.where.domain), (f"{SPEED}=0.7",))

    def done(op: str, **values: str) -> object:
        reply = run(target, op, values)
        assert reply["accepted"], reply
        return reply["data"]

    def row(name: str) -> dict[str, object]:
        return next(row for row in done("settings") if row["name"] == name)

    assert done("setting_set", name=SPEED, value="0.5") == f"{SPEED} = 0.5 (was 0.7)"
    speed = row(SPEED)
    assert (speed["value"], speed["started"], speed["origin"]) == (0.5, 0.7, "set at run time")
    assert (speed["kind"], speed["unit"], speed["is_limit"]) == ("number", "m/s", True)
    assert (speed["low"], speed["high"]) == (0, 10)
    assert row("planner.cost.unknown")["choices"] == ["allowed", "costly", "forbidden"]
    assert row("local_ctrl.costmap.scan")["kind"] == "switch"
    assert "kind" not in row("guard.stops.scan_age"), "it cannot change"
    assert "kind" not in row("navigator.tolerance"), "its service does not run"
    refused = run(target, "setting_set", {"name": SPEED, "value": "0.8"})
    assert "only be lowered" in refused["detail"]
    assert refused["hint"]
    done("setting_set", name=SPEED, value="")
    assert row(SPEED)["origin"] == "--set"


def test_a_service_that_runs_alone_keeps_settings_in_its_memory_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    with free_stack() as claim:
        number = str(claim.where.domain)
        order = [sys.executable, "-m", "zenav", "run", "guard", "--memory", "memory", "--stack", number]

        def started() -> "subprocess.Popen[bytes]":
            process = subprocess.Popen(order, env=dict(os.environ, PYTHONPATH=str(ROOT)))  # noqa: TID251
            with Client("x80", claim.where) as client:
                assert client.answers(requests.SET, 60.0, "guard")
            return process

        process = started()
        try:
            assert _status(["config", "set", f"{SPEED}=0.3", "--stack", number]) == 2, "local_ctrl does not run"
            with Client("x80", claim.where) as client:
                request = SetSettings(client.now(), (SPEED,), ("0.3",), False)
                assert client.ask(requests.SET, request, service="guard").accepted
            limit = time.monotonic() + 10
            while not any(tmp_path.glob("memory/guard-settings-*.msgpack")):  # written right after the reply
                assert time.monotonic() < limit
                wait(0.01)
            process.kill()
            process.wait()
            process = started()
            capsys.readouterr()
            assert _status(["config", "get", SPEED, "--stack", number]) == 0
            assert json.loads(capsys.readouterr().out) == 0.3
        finally:
            process.kill()
            process.wait()
