# SPDX-License-Identifier: Apache-2.0
"""The command line: a wrong argument gives one line and a hint; help is quick because it imports little."""

import ast
import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer

from zenav import __main__ as command_line
from zenav.__main__ import _status
from zenav.cli.commands import GROUPS, all_commands, commands_for
from zenav.stack.launch import ROOT

COMMANDS = [
    "places list", "places save", "places remove",
    "demo", "up", "run", "goto", "route", "explore", "cancel", "teleop", "estop", "topic list", "topic echo",
    "topic hz", "map save", "map load", "map new", "map mode", "map show", "calibrate odometry",
    "calibrate laser", "calibrate motors", "config show", "config check", "config set", "config get", "config reset",
    "config list", "config save", "doctor", "slam", "replay",
    "recording info", "recording cat", "recording repair", "recording trim", "recording merge", "recording latency",
    "recording plot", "recording mark", "recording stability", "bench recording",
    "bench office", "bench sim", "bench stack", "bench serial", "bench slam", "bench plan", "bench barn",
    "bench odometry", "bench gyro", "bench figures",
]  # fmt: skip


def complaint(capsys, *arguments: str) -> tuple[str, str]:
    """(what, hint) of a command that is refused: two lines on stderr, nothing on stdout, status 2."""
    assert _status(list(arguments)) == 2
    out, err = capsys.readouterr()
    lines = err.splitlines()
    assert out == ""
    assert len(lines) == 2, err
    assert lines[1].startswith("hint: ")
    return lines[0], lines[1].removeprefix("hint: ")


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command, capsys):
    assert _status([*command.split(), "--help"]) == 0
    shown = " ".join(capsys.readouterr().out.split())
    assert f"Usage: zenav {command}" in shown
    assert f"Example: zenav {command}" in shown


@pytest.mark.parametrize("command", COMMANDS)
def test_an_example_in_the_help_can_be_copied(command, capsys):
    assert _status([*command.split(), "--help"]) == 0
    example = next(line for line in capsys.readouterr().out.splitlines() if "Example: " in line)
    arguments = shlex.split(example.partition("Example: zenav ")[2])
    parsed = typer.main.get_command(all_commands())
    context = None
    while hasattr(parsed, "resolve_command"):
        context = parsed.make_context(parsed.name, list(arguments), parent=context)
        _, parsed, arguments = parsed.resolve_command(context, list(arguments))
    parsed.make_context(parsed.name, list(arguments), parent=context)


@pytest.mark.parametrize(
    ("words", "robot"),
    [("replay run.mcap", ""), ("batch replay run.mcap --through guard --out there", ""), ("goto 1 2", "red@x80sv")],
)
def test_a_replay_is_of_the_recorded_robot_and_all_else_of_the_named_one(words, robot, monkeypatch):
    monkeypatch.setenv("ZENAV_NAME", "red")
    monkeypatch.delenv("ZENAV_ROBOT", raising=False)
    command, arguments, context = typer.main.get_command(all_commands()), shlex.split(words), None
    while hasattr(command, "resolve_command"):
        context = command.make_context(command.name, list(arguments), parent=context)
        _, command, arguments = command.resolve_command(context, list(arguments))
    assert command.make_context(command.name, list(arguments), parent=context).params["robot"] == robot


def hints() -> Iterator[tuple[str, str]]:
    """(place, command) of each `zenav ...` in the hint of an error, of a reason, or of what doctor finds."""
    for path in (path for folder in ("zenav", "shared", "services") for path in (ROOT / folder).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Call) or getattr(node.func, "id", "") not in HINTING:
                continue
            for argument in node.args[1:]:
                parts = argument.values if isinstance(argument, ast.JoinedStr) else [argument]
                text = "".join(str(p.value) if isinstance(p, ast.Constant) else "X" for p in parts)
                for found in re.finditer(r"\bzenav (?!wrote|is )([^;,()`?]+)", text):
                    yield f"{path.relative_to(ROOT)}:{node.lineno}", found[1]


HINTING = {"UserError", "Reason", "DoctorFinding", "complain"}


def test_every_command_in_a_hint_exists_with_its_options():
    found = list(hints())
    assert len(found) > 60
    for place, text in found:
        words, command = text.split(), typer.main.get_command(all_commands())
        while hasattr(command, "resolve_command"):
            word = words.pop(0).strip(".:") if words else ""
            assert word in command.commands, f"{place}: zenav {text}"
            command = command.commands[word]
        options = {option for param in command.params for option in (*param.opts, "--help")}
        asked = {word.split("=")[0].strip(".:") for word in words if word.startswith("--")}
        assert asked <= options, f"{place}: zenav {text}"


def test_help_imports_nothing_heavy():
    code = (
        "import sys; from zenav.__main__ import _status; _status(['--help']);"
        "sys.exit(','.join({'numpy', 'zenoh', 'numba', 'pydantic', 'psutil', 'PIL'} & set(sys.modules)) or 0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


def test_a_group_alone_is_that_of_all_commands():
    whole = typer.main.get_command(all_commands())
    for name in GROUPS:
        alone = typer.main.get_command(commands_for(name))
        assert list(alone.commands) == [name]
        assert list(alone.commands[name].commands) == list(whole.commands[name].commands)


def test_a_group_imports_no_other_one():
    code = (
        "import sys; from zenav.__main__ import _status; _status(['topic', 'list']);"
        "sys.exit(','.join(m for m in sys.modules if m.startswith('zenav.cli.')))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    loaded = {name.rpartition(".")[2] for name in done.stderr.strip().split(",")}
    assert loaded == {"commands", "looking", "parts", "topic_list"}


@pytest.mark.parametrize(
    ("typed", "meant"),
    [("gto", "goto"), ("topc", "topic"), ("explor", "explore"), ("topic ech", "echo"), ("map lod", "load")],
)
def test_a_mistyped_command_is_guessed(typed, meant, capsys):
    what, hint = complaint(capsys, *typed.split(), "1", "2")
    assert typed.split()[-1] in what
    assert hint == f"did you mean `{meant}`?"


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ("goto 1", "'y'"),
        ("goto 1 x", "'y'"),
        ("goto 1 2 --robt x80sv", "--robt"),
        ("demo --seconds -5", "--seconds"),
        ("route 1,2 x", "'x' is no pose"),
        ("route 1,2,3,4", "no pose"),
        ("route 1,nan", "no pose"),
        ("route", "no poses"),
        ("route 1,2 3,4,5", "heading"),
        ("goto 1e9 2", "farther"),
        ("goto 1 2 3 4", "'yaw'"),
        ("goto kitchen", "'kitchen' is no pose and no place"),
        ("goto kitchen --map nowhere", "nowhere"),
        ("route 1,2@ 3,4", "no time"),
        ("route 1,2@-5", "no time"),
        ("places save 3rd 1 2", "no name for a place"),
        ("places save here 1", "two coordinates"),
        ("places save here 1 nan", "no place on a map"),
        ("places remove here", "'here'"),
        ("cancel --robot missing", "missing"),
        ("cancel --stack seven", "'seven'"),
        ("cancel --stack 9999", "'9999'"),
        ("up --only simm", "simm"),
        ("up --world nowhere", "nowhere"),
        ("up --only sim --speed 3", "--speed"),
        ("run mapr", "mapr"),
        ("topic echo scn", "scn"),
        ("topic hz health/mappr", "health/mappr"),
        ("config check --set guard.field.stop_margn=1", "stop_margn"),
        ("config check --set robot.drive.wheel_radius=-1", "wheel_radius"),
        ("config check --set sim", "sets nothing"),
        ("config show gaurd", "gaurd"),
        ("map show nowhere", "nowhere"),
        ("map load nowhere", "nowhere"),
        ("map load nowhere --at 1 x 2", "--at"),
        ("map load nowhere --mode fly", "fly"),
        ("map mode continue", "continue"),
        ("up --world room --map nowhere", "nowhere"),
        ("slam nowhere.log --out /tmp/x", "nowhere.log"),
        ("replay nowhere.mcap --through mapper --out /tmp/x.mcap", "nowhere.mcap"),
        ("bench office --seeds 3-1", "3-1"),
        ("bench office --seeds a", "'a'"),
        ("bench office --out /dev/null/a.json", "/dev/null/a.json"),
        ("bench sim --out /dev/null/a.json", "/dev/null/a.json"),
        ("bench stack --out /dev/null/a.json", "/dev/null/a.json"),
        ("bench serial --out /dev/null/a.json", "/dev/null/a.json"),
        ("bench slam nowhere", "nowhere"),
        ("bench plan nowhere", "nowhere"),
        ("bench odometry nowhere", "nowhere"),
        ("bench gyro nowhere", "nowhere"),
        ("bench figures --only ofice", "'ofice'"),
        ("bench slam .", "no log with a reference"),
        ("demo --lockstep --world nowhere", "nowhere"),
        ("demo --record notes.txt", "notes.txt"),
        ("demo --record /dev/null/run.mcap", "/dev/null/run.mcap"),
        ("demo --lockstep --set sim.start={x: 0, y: 0}", "does not fit"),
        ("teleop", "terminal"),
    ],
)
def test_bad_input_is_one_line_and_a_hint(arguments, told, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    parts = arguments.split(" ") if "{" not in arguments else arguments.split(" ", 3)
    what, hint = complaint(capsys, *parts)
    assert told in what
    assert hint


@pytest.mark.parametrize(
    ("typed", "completed"),
    [
        ("zenav go", "goto"),
        ("zenav topic echo cmd/", "cmd/vel"),
        ("zenav topic hz health/ma", "health/mapper"),
        ("zenav up --robot jac", "jackal"),
        ("zenav demo --world off", "office"),
        ("zenav run nav", "navigator"),
    ],
)
def test_the_shell_completes(typed, completed, monkeypatch, capsys):
    monkeypatch.setenv("_ZENAV_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", typed)
    monkeypatch.setenv("COMP_CWORD", str(len(typed.split()) - 1))
    assert _status([]) == 0
    assert completed in capsys.readouterr().out.split()


def test_nobody_answers_is_told_with_the_hint(capsys):
    from zenav.stack.launch import free_stack

    with free_stack() as claim:
        stack = str(claim.where.domain)
        what, hint = complaint(capsys, "cancel", "--stack", stack)
        assert "navigator" in what
        assert "zenav up" in hint
        what, hint = complaint(capsys, "topic", "hz", "scan", "--seconds", "0.1", "--stack", stack)
        assert "0 messages on scan" in what


def test_negative_numbers_are_arguments(monkeypatch):
    import zenav.client.navigation_client

    driven = []
    monkeypatch.setattr(zenav.client.navigation_client, "drive_route", lambda *given: driven.append(given[2]) or 0)
    assert _status(["goto", "-1", "-.5", "-90"]) == 0
    assert _status(["goto", "-1.5e-1", "2"]) == 0
    assert _status(["route", "-1,-2", "3,-4"]) == 0
    assert driven == [[(-1.0, -0.5, -90.0)], [(-0.15, 2.0, None)], [(-1.0, -2.0, None), (3.0, -4.0, None)]]


@pytest.mark.parametrize("word", ["goto", "goal"])
def test_a_robot_of_a_fleet_is_sent_by_both_words(word, monkeypatch):
    sent = []
    monkeypatch.setattr("zenav.fleet.commands.send_robot", lambda *arguments: sent.append(arguments) or 0)
    assert _status(["fleet", word, "red", "kitchen", "--map", "hall"]) == 0
    assert sent == [([], "red", ["kitchen"], "hall")]


def test_a_bug_is_a_traceback_and_status_1(monkeypatch, capsys):
    import zenav.cli.topic_list

    def broken(as_json: bool) -> None:
        raise KeyError("broken")

    ended = []
    monkeypatch.setattr(zenav.cli.topic_list, "list_topics", broken)
    monkeypatch.setattr(command_line.os, "_exit", ended.append)
    command_line.main(["topic", "list"])
    assert ended == [1]
    assert "KeyError" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["topic list", "config show"])
def test_a_reader_that_has_gone_is_no_error(command):
    reading, writing = os.pipe()
    os.close(reading)
    environment = dict(os.environ, PYTHONPATH=str(ROOT))  # noqa: TID251
    done = subprocess.run(
        [sys.executable, "-m", "zenav", *command.split()],
        stdout=writing,
        stderr=subprocess.PIPE,
        text=True,
        timeout=60,
        env=environment,
    )
    os.close(writing)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("command", ["--help", "robots", "schema --json"])
def test_a_full_disk_is_one_line_and_a_hint(command):
    environment = dict(os.environ, PYTHONPATH=str(ROOT))  # noqa: TID251
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "zenav", *command.split()],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
            timeout=60,
        )
    assert done.returncode == 2
    assert done.stderr == "no space is left on the disk\nhint: make room: see df -h\n"


def test_the_topics_are_data_on_stdout(capsys):
    import json

    assert _status(["topic", "list", "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert {"scan", "cmd/vel", "health/SERVICE"} <= {row["key"] for row in rows}


def test_the_configuration_in_force_is_yaml_that_can_be_read_again(capsys):
    from ruamel.yaml import YAML

    assert _status(["config", "show", "--set", "guard.field.stop_margin=0.07"]) == 0
    tree = YAML(typ="safe").load(capsys.readouterr().out)
    assert tree["guard"]["field"]["stop_margin"] == 0.07
    assert tree["robot"]["name"] == "x80"


def test_each_value_has_its_origin(capsys):
    assert _status(["config", "show", "--origin", "--set", "guard.field.stop_margin=0.07"]) == 0
    rows = dict(line.split("#") for line in capsys.readouterr().out.splitlines())
    origins = {text.partition(":")[0]: place.strip() for text, place in rows.items()}
    assert origins["guard.field.stop_margin"] == "--set"
    assert origins["guard.field.reaction"] == "default"
    file, _, line = origins["robot.drive.wheel_radius"].rpartition(":")
    assert file.endswith("x80sv.yaml")
    assert "wheel_radius:" in Path(file).read_text(encoding="utf-8").splitlines()[int(line) - 1]
