# SPDX-License-Identifier: Apache-2.0
"""The launcher's promises, with processes that do nothing, die, hang, or refuse to end."""

import errno
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from types import SimpleNamespace

import psutil
import pytest

from shared.config import UserError
from shared.messages import Health
from zenav.stack import launch
from zenav.stack.launch import BACK_OFF, Launcher, claim_stack, free_stack

IDLE = "import signal; print('up', flush=True); signal.pause()"
STUBBORN = (
    "import signal, subprocess, sys; signal.signal(signal.SIGTERM, signal.SIG_IGN);"
    "child = subprocess.Popen([sys.executable, '-c', 'import signal; signal.pause()']);"
    "print(child.pid, flush=True); signal.pause()"
)


def code(text: str) -> list[str]:
    return [sys.executable, "-c", text]


def until(holds: Callable[[], object], step: Callable[[], None] = lambda: None, seconds: float = 20.0) -> None:
    """Steps until the condition holds."""
    limit = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < limit
        step()
        threading.Event().wait(0.01)


def alive(pid: int) -> bool:
    return psutil.pid_exists(pid) and psutil.Process(pid).status() != psutil.STATUS_ZOMBIE


def health(name: str, pid: int) -> Health:
    return Health(0, name, pid, "", 0, 0, 0, 0, "", 0.0, 0.0, 0.0, ())


def test_a_killed_service_is_started_again(tmp_path):
    told: list[tuple[str, str]] = []
    with Launcher({"sim": code(IDLE)}, tmp_path, lambda *line: told.append(line)) as launcher:
        launcher.start_all()
        child = launcher.children["sim"]
        first = child.process.pid
        os.kill(first, signal.SIGKILL)
        until(lambda: child.n_restarts == 1 and child.running, launcher.step)
        assert child.process.pid != first
    assert any("killed by SIGKILL" in line for _, line in told)


def test_a_service_that_falls_silent_is_killed_and_started_again(tmp_path, monkeypatch):
    monkeypatch.setattr(launch, "MAX_SILENCE_S", 0.2)
    told: list[tuple[str, str]] = []
    with Launcher({"sim": code(IDLE)}, tmp_path, lambda *line: told.append(line)) as launcher:
        launcher.start_all()
        child = launcher.children["sim"]
        first = child.process.pid
        os.kill(first, signal.SIGSTOP)
        launcher.hear(health("sim", first))
        until(lambda: child.n_restarts == 1, launcher.step)
        assert not alive(first)
    assert any("hung" in line for _, line in told)


def test_a_service_whose_log_s_folder_was_removed_is_started_again(tmp_path):
    told: list[tuple[str, str]] = []
    logs = tmp_path / "out" / "up"
    with Launcher({"sim": code(IDLE)}, logs, lambda *line: told.append(line)) as launcher:
        launcher.start_all()
        child = launcher.children["sim"]
        until(lambda: ("sim", "up") in told, launcher.step)
        shutil.rmtree(tmp_path / "out")
        os.kill(child.process.pid, signal.SIGKILL)
        until(lambda: told.count(("sim", "up")) == 2, launcher.step)  # its words are shown again, too
        assert child.running


def test_a_service_that_cannot_be_started_for_the_moment_is_tried_again(tmp_path, monkeypatch):
    told: list[str] = []
    with Launcher({"sim": code(IDLE)}, tmp_path, lambda name, line: told.append(line)) as launcher:
        launcher.start_all()
        child = launcher.children["sim"]
        with monkeypatch.context() as full:
            full.setattr(launch.subprocess, "Popen", no_memory)
            os.kill(child.process.pid, signal.SIGKILL)
            until(lambda: any("cannot be started" in line for line in told), launcher.step)
        until(lambda: child.running, launcher.step)


def no_memory(*_: object, **__: object) -> None:
    raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))


def test_a_hung_service_that_takes_long_to_end_is_told_once(tmp_path, monkeypatch):
    monkeypatch.setattr(launch, "MAX_SILENCE_S", -1.0)
    told: list[tuple[str, str]] = []
    with Launcher({"sim": code(IDLE)}, tmp_path, lambda *line: told.append(line)) as launcher:
        launcher.start_all()
        launcher.hear(health("sim", launcher.children["sim"].process.pid))
        monkeypatch.setattr(launcher, "kill", lambda name: None)  # as where it waits for a disk
        for _ in range(5):
            launcher.step()
    assert sum("hung" in line for _, line in told) == 1


def test_silence_while_the_launcher_itself_stood_still_is_no_service_s(tmp_path, monkeypatch):
    now = [time.monotonic()]
    monkeypatch.setattr(launch, "time", SimpleNamespace(monotonic=lambda: now[0]))
    with Launcher({"sim": code(IDLE)}, tmp_path) as launcher:
        launcher.start_all()
        child = launcher.children["sim"]
        launcher.hear(health("sim", child.process.pid))
        launcher.step()
        now[0] += 60.0  # Ctrl-Z, and fg a minute later
        launcher.step()
        assert child.cause == ""
        assert child.running

        def step() -> None:
            now[0] += 0.1
            launcher.step()

        until(lambda: child.n_restarts == 1, step)  # it is silent from then on, too


def test_a_service_that_has_not_spoken_yet_is_given_time_and_a_stranger_s_health_is_not_its_own(tmp_path, monkeypatch):
    monkeypatch.setattr(launch, "MAX_SILENCE_S", 0.0)
    with Launcher({"sim": code(IDLE)}, tmp_path) as launcher:
        launcher.start_all()
        child = launcher.children["sim"]
        launcher.hear(health("sim", child.process.pid + 1))
        launcher.step()
        assert child.heard == 0.0
        assert child.running


def test_restarts_wait_longer_and_longer(tmp_path):
    with Launcher({"sim": code("raise SystemExit(1)")}, tmp_path) as launcher:
        launcher.start_all()
        child, waits = launcher.children["sim"], []
        for n in range(1, 4):
            until(lambda n=n: child.n_deaths == n and child.process is None, launcher.step)
            waits.append(child.due - time.monotonic())
            child.due = time.monotonic()
    assert waits == sorted(waits)
    assert all(wait <= planned for wait, planned in zip(waits, BACK_OFF))
    assert waits[-1] > 0


def test_what_a_service_refuses_at_its_start_ends_the_launch_in_its_own_words(tmp_path):
    refusal = "import sys; sys.stderr.write('sim: the world is flat\\nhint: make it round\\n'); sys.exit(2)"
    with Launcher({"sim": code(refusal)}, tmp_path) as launcher:
        launcher.start_all()
        with pytest.raises(UserError, match="sim: the world is flat") as caught:
            until(lambda: False, launcher.step)
    assert caught.value.hint == "make it round"


def test_nothing_is_left_not_even_what_a_stubborn_service_started(tmp_path):
    told: list[str] = []
    commands = {"sim": code(STUBBORN), "recorder": code(STUBBORN), "guard": code(IDLE)}
    with Launcher(commands, tmp_path, lambda name, line: told.append(line)) as launcher:
        launcher.start_all(lambda name: True)
        until(lambda: len(told) == 3, launcher.step)
        os.kill(launcher.children["guard"].process.pid, signal.SIGSTOP)
        pids = [child.process.pid for child in launcher.children.values()] + [int(t) for t in told if t.isdigit()]
        assert len(pids) == 5
    until(lambda: not any(alive(pid) for pid in pids))


def test_the_recorder_is_up_before_the_others_and_ends_after_them(tmp_path):
    order = tmp_path / "order"
    note = (
        "import signal, sys; from pathlib import Path\n"
        "def note(what):\n    with open({path!r}, 'a') as f: f.write(what + '\\n')\n"
        "signal.signal(signal.SIGTERM, lambda *_: (note('{name} ends'), sys.exit(0)))\n"
        "note('{name} starts'); signal.pause()"
    )
    commands = {name: code(note.format(path=str(order), name=name)) for name in ("sim", "recorder")}
    with Launcher(commands, tmp_path) as launcher:
        launcher.start_all(lambda name: order.exists())
        until(lambda: len(order.read_text().splitlines()) == 2)
    assert order.read_text().splitlines() == ["recorder starts", "sim starts", "sim ends", "recorder ends"]


def test_who_gives_up_during_the_start_does_not_wait_for_the_recorder(tmp_path):
    with Launcher({"sim": code(IDLE), "recorder": code(IDLE)}, tmp_path) as launcher:
        asked: list[bool] = []

        def given_up() -> bool:
            asked.append(True)
            return len(asked) > 2

        launcher.start_all(lambda name: False, given_up)
        assert launcher.children["recorder"].process is not None
        assert launcher.children["sim"].process is None


def test_services_die_with_a_launcher_that_is_killed(tmp_path):
    script = (
        "import os, sys; from pathlib import Path; from zenav.stack.launch import Launcher\n"
        "command = [sys.executable, '-P', '-m', 'zenav.stack.process_guard', str(os.getpid()), 'http.server', '0']\n"
        f"with Launcher({{'sim': command + ['--bind', '127.0.0.1']}}, Path({str(tmp_path)!r})) as launcher:\n"
        "    launcher.start_all(); print(launcher.children['sim'].process.pid, flush=True); sys.stdin.read()"
    )
    environment = dict(os.environ, PYTHONPATH=str(launch.ROOT), PYTHONUNBUFFERED="1")  # noqa: TID251
    with subprocess.Popen(
        code(script), stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as launcher:
        pid = int(launcher.stdout.readline())
        until(lambda: "Serving" in (tmp_path / "sim.log").read_text())
        launcher.kill()
    until(lambda: not alive(pid))


def test_a_stack_number_belongs_to_one_launcher():
    with free_stack() as mine:
        with pytest.raises(UserError, match=f"stack {mine.where.domain} is taken by .*pid {os.getpid()}"):
            claim_stack(mine.where.domain)
        with free_stack() as other:
            assert other.where != mine.where
    with claim_stack(mine.where.domain):
        pass


def test_a_taken_port_is_told_with_its_holder():
    with free_stack() as claim:
        domain, port = claim.where.domain, claim.where.port("mapper")
    with socket.socket() as holder:
        holder.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # what an earlier stack left in TIME_WAIT is free
        holder.bind(("127.0.0.1", port))
        holder.listen()
        with pytest.raises(UserError, match=f"port {port} .*pid {os.getpid()}"):
            claim_stack(domain)
