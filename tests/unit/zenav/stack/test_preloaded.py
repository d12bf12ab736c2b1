# SPDX-License-Identifier: Apache-2.0
"""The preloaded parent: what it forks is the launcher's own process, outlives it, and dies with the launcher."""

import json
import os
import signal
import socket
import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from shared.robot_files import ROBOTS_DIR
from shared.runners.service_start import parser_of, service_start
from tests.unit.zenav.stack.test_launch import alive, code, until
from zenav.stack import preloaded
from zenav.stack.launch import ROOT, Launcher, free_stack, service_command
from zenav.stack.preloaded import Adopted, Preloaded, split
from zenav.stack.service_loader import service_class


@contextmanager
def guarded(folder: Path, robot: str = "x80sv"):
    """A launcher whose guard runs as a fork, and its lines."""
    told: list[tuple[str, str]] = []
    with free_stack() as claim:
        command = service_command("guard", robot, str(claim.where.domain), [])
        with Launcher({"guard": command}, folder, lambda *line: told.append(line)) as launcher:
            launcher.start_all()
            until(lambda: any("started" in line for _, line in told), launcher.step, 60)
            yield launcher, told


def ended(folder: Path, arguments: list[str]) -> int:
    """Exit status of a forked guard with these arguments; its log is in `folder`."""
    command = service_command("guard", "x80sv", "0", [])
    parent = Preloaded([command], dict(os.environ, PYTHONPATH=str(ROOT)))  # noqa: TID251
    parent.start()
    try:
        parent.wait_until_ready(lambda: False)
        with (folder / "log").open("ab") as log:
            process = parent.fork([*command, *arguments], log)
        return process.wait(30)
    finally:
        parent.close()


def test_a_forked_service_is_a_child_of_the_launcher_in_a_group_of_its_own_under_its_own_name(tmp_path):
    with guarded(tmp_path) as (launcher, _):
        process = launcher.children["guard"].process
        assert isinstance(process, Adopted)
        found = psutil.Process(process.pid)
        assert found.ppid() == os.getpid()
        assert os.getpgid(process.pid) == os.getsid(process.pid) == process.pid
        assert found.name() == "guard"
        assert found.cmdline()[:3] == ["services.guard", "--robot", "x80sv"]
        assert os.readlink(f"/proc/{process.pid}/fd/1") == os.readlink(f"/proc/{process.pid}/fd/2")
        assert os.readlink(f"/proc/{process.pid}/fd/0") == os.devnull
    assert not alive(process.pid)


def test_the_exit_status_and_the_words_of_a_forked_service_are_its_own(tmp_path):
    assert ended(tmp_path, ["--help"]) == 0
    assert ended(tmp_path, ["--nonsense"]) == 2
    assert ended(tmp_path, ["--set", "guard.nonsense=1"]) == 2
    words = (tmp_path / "log").read_text()
    assert "unrecognized arguments: --nonsense" in words
    assert "guard: --set: guard.nonsense is not a setting" in words


def test_a_killed_fork_is_told_with_its_signal_and_forked_again(tmp_path):
    with guarded(tmp_path) as (launcher, told):
        child = launcher.children["guard"]
        first = child.process.pid
        os.kill(first, signal.SIGKILL)
        until(lambda: child.n_restarts == 1 and child.running, launcher.step)
        assert isinstance(child.process, Adopted)
        assert not psutil.pid_exists(first)
    assert any("killed by SIGKILL" in line for _, line in told)


def test_a_service_that_comes_back_has_the_robot_s_file_of_now(tmp_path):
    robot = tmp_path / "bot.yaml"
    text = (ROBOTS_DIR / "x80sv.yaml").read_text()
    robot.write_text(text)
    with guarded(tmp_path, str(robot)) as (launcher, told):
        robot.write_text(text + "\nguard: {nonsense: 1}\n")
        os.kill(launcher.children["guard"].process.pid, signal.SIGKILL)
        until(lambda: any("guard.nonsense is not a setting" in line for _, line in told), launcher.step)


def test_what_was_preloaded_holds_for_the_same_arguments_and_the_same_file_alone(tmp_path):
    robot = tmp_path / "bot.yaml"
    text = (ROBOTS_DIR / "x80sv.yaml").read_text()
    robot.write_text(text)
    asked = ["--robot", str(robot)]
    start = service_start("guard", service_class("guard"), asked, parser_of("guard").parse_args(asked))
    assert start.is_of(tuple(asked))
    assert not start.is_of((*asked, "--set", "guard.period=0.1"))
    robot.write_text(text + "\n")
    assert not start.is_of(tuple(asked))
    robot.unlink()
    assert not start.is_of(tuple(asked))
    robot.write_text(text)
    assert start.is_of(tuple(asked))


PRELOAD_A_SIMULATOR = """
import sys
from shared.runners.service_start import PRELOADED
from zenav.stack.fork_server import preload

preload({"services.sim": ["--robot", "x80sv", "--set", "sim.world=office"]})
assert PRELOADED["sim"].config.world == "office"
assert "scipy.ndimage" not in sys.modules
"""


def test_the_simulator_is_preloaded_for_its_world_and_without_what_other_worlds_need():
    command = [sys.executable, "-P", "-c", PRELOAD_A_SIMULATOR]
    subprocess.run(command, check=True, env=dict(os.environ, PYTHONPATH=str(ROOT)))  # noqa: TID251  # a child


def test_a_file_that_is_warned_of_is_read_at_each_start(tmp_path):
    robot = tmp_path / "bot.yaml"
    robot.write_text((ROBOTS_DIR / "x80sv.yaml").read_text() + "\nplanner: {upkeep: {}}\n")
    asked = ["--robot", str(robot)]
    start = service_start("planner", service_class("planner"), asked, parser_of("planner").parse_args(asked))
    assert not start.is_of(tuple(asked))


def test_services_outlive_the_preloaded_parent_which_is_replaced(tmp_path, monkeypatch):
    monkeypatch.setattr(preloaded, "AGAIN_S", 0.0)
    with guarded(tmp_path) as (launcher, told):
        child, parent = launcher.children["guard"], launcher.preloaded.pid
        first = child.process.pid
        os.kill(parent, signal.SIGKILL)
        until(lambda: launcher.preloaded.pid not in (parent, None), launcher.step)
        assert child.process.pid == first
        assert child.running
        told.clear()
        os.kill(first, signal.SIGKILL)  # whichever way there is now, it comes back
        until(lambda: any("started" in line and "INFO" in line for _, line in told), launcher.step, 60)
        second = launcher.preloaded.pid
        pids = [second, child.process.pid]
    assert not any(alive(pid) for pid in pids)


def test_a_service_does_not_wait_for_a_preloaded_parent_that_hangs(tmp_path, monkeypatch):
    monkeypatch.setattr(preloaded, "REPLY_LIMIT_S", 0.3)
    with guarded(tmp_path) as (launcher, _):
        child, parent = launcher.children["guard"], launcher.preloaded.pid
        os.kill(parent, signal.SIGSTOP)
        os.kill(child.process.pid, signal.SIGKILL)
        until(lambda: child.n_restarts == 1 and child.running, launcher.step)
        assert isinstance(child.process, subprocess.Popen)
        assert not alive(parent)


def test_a_service_starts_without_a_preloaded_parent_where_that_cannot_be_had(tmp_path, monkeypatch):
    monkeypatch.setattr(Preloaded, "start", lambda self: None)
    with guarded(tmp_path) as (launcher, _):
        assert isinstance(launcher.children["guard"].process, subprocess.Popen)


def test_a_process_that_the_launcher_does_not_know_ends_at_its_gate(tmp_path):
    command = service_command("guard", "x80sv", "0", [])
    parent = Preloaded([command], dict(os.environ, PYTHONPATH=str(ROOT)))  # noqa: TID251
    parent.start()
    try:
        parent.wait_until_ready(lambda: False)
        module, arguments = split(command)
        request = json.dumps({"module": module, "arguments": arguments, "folder": str(tmp_path)}).encode()
        gate, opener = os.pipe()
        with (tmp_path / "log").open("ab") as log, preloaded._subreaper():
            parent._connection.settimeout(20)
            socket.send_fds(parent._connection, [request], [log.fileno(), gate])
            process = Adopted(int(parent._connection.recv(64)))
        assert process.poll() is None
        os.close(opener)
        assert process.wait(10) == 1
        os.close(gate)
        assert (tmp_path / "log").read_text() == ""
    finally:
        parent.close()


def test_a_launcher_with_threads_starts_a_new_program_instead_of_a_copy_of_itself(tmp_path):
    over = threading.Event()
    thread = threading.Thread(target=over.wait)
    thread.start()
    parent = Preloaded([service_command("guard", "x80sv", "0", [])], dict(os.environ, PYTHONPATH=str(ROOT)))  # noqa: TID251
    try:
        parent.start()
        assert isinstance(parent._process, subprocess.Popen)
        parent.wait_until_ready(lambda: False)
        assert parent._ready
    finally:
        over.set()
        thread.join()
        parent.close()


@pytest.mark.parametrize("threads", [0, 1])
def test_forked_services_and_the_parent_die_with_a_launcher_that_is_killed(tmp_path, threads):
    script = (
        "import os, sys, threading; from pathlib import Path\n"
        "from zenav.stack.launch import Launcher, free_stack, service_command\n"
        f"[threading.Thread(target=threading.Event().wait, daemon=True).start() for _ in range({threads})]\n"
        "with free_stack() as claim:\n"
        "    command = service_command('guard', 'x80sv', str(claim.where.domain), [])\n"
        f"    with Launcher({{'guard': command}}, Path({str(tmp_path)!r})) as launcher:\n"
        "        launcher.start_all()\n"
        "        child = launcher.children['guard'].process\n"
        "        print(type(child).__name__, type(launcher.preloaded._process).__name__, flush=True)\n"
        "        print(child.pid, launcher.preloaded.pid, flush=True); sys.stdin.read()"
    )
    environment = dict(os.environ, PYTHONPATH=str(ROOT))  # noqa: TID251
    with subprocess.Popen(
        code(script), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as launcher:
        assert launcher.stdout.readline().split() == ["Adopted", "Popen" if threads else "Adopted"]
        pids = [int(pid) for pid in launcher.stdout.readline().split()]
        until(lambda: "started" in (tmp_path / "guard.log").read_text(), seconds=60)
        assert all(alive(pid) for pid in pids)
        launcher.kill()
    until(lambda: not any(alive(pid) for pid in pids))


def test_the_command_line_of_another_program_is_not_a_service_s():
    assert split([sys.executable, "-c", "pass"]) is None
    assert split(service_command("guard", "x80sv", "7", [])) == ("services.guard", ["--robot", "x80sv", "--stack", "7"])
