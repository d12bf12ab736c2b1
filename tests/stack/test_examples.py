# SPDX-License-Identifier: Apache-2.0
"""The examples, run as their users run them: a simulator, a program that explores, a client in JavaScript."""

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from shared.config import UserError
from zenav.client import connect
from zenav.stack.launch import ROOT, free_stack
from zenav.wire.json_schema import document

EXAMPLES = ROOT / "examples"
START, DRIVE = 180.0, 100.0  # s that a busy machine may take
pytestmark = pytest.mark.timeout(300)


class Program:
    """A program of the test, and the lines that it wrote."""

    def __init__(self, command: list[str], folder: Path, stack: int) -> None:
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "ZENAV_STACK": str(stack), "PYTHONUNBUFFERED": "1"}  # noqa: TID251
        self.process = subprocess.Popen(
            command, cwd=folder, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )
        self.lines: list[str] = []
        self._reader = threading.Thread(target=self.lines.extend, args=(self.process.stdout,))
        self._reader.start()

    def until(self, holds: Callable[[], bool], seconds: float = START) -> None:
        limit = time.monotonic() + seconds
        while not holds():
            assert self.process.poll() is None, "".join(self.lines)
            assert time.monotonic() < limit, "".join(self.lines)
            threading.Event().wait(0.1)

    def said(self, words: str) -> bool:
        return any(words in line for line in self.lines)

    def end(self) -> None:
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._reader.join()
        self.process.stdout.close()


@pytest.fixture(scope="module")
def stack(tmp_path_factory) -> Iterator[tuple[int, Program]]:
    """A stack with the example's simulator: its number, and `zenav up`."""
    folder = tmp_path_factory.mktemp("examples")
    with free_stack() as claim:
        domain = claim.where.domain
    page = f"dashboard.port.device=web://127.0.0.1:{9600 + domain}"
    command = [sys.executable, "-m", "zenav", "up", "--external", "sim", "--no-browser", "--set", page]
    up = Program([*command, "--stack", str(domain)], folder, domain)
    simulator = None
    try:
        up.until(lambda: up.said("nothing usable comes on hardware/board, scan"))
        assert not up.said("every service runs")
        simulator = Program([sys.executable, str(EXAMPLES / "simulator.py")], folder, domain)
        up.until(lambda: up.said("every service runs"), 30)
        yield domain, up
    finally:
        for program in (simulator, up):
            if program is not None:
                program.end()


def test_the_simulator_passes_and_a_program_explores_and_drives(stack, tmp_path):
    domain, up = stack
    assert up.said("hardware/board passes")
    assert up.said("scan passes")
    command = [sys.executable, str(EXAMPLES / "explore_and_visit.py")]
    program = Program(command, tmp_path, domain)
    program.process.wait(2 * DRIVE)
    program.end()
    assert program.process.returncode == 0, "".join([*program.lines, *up.lines])
    assert [": reached" in line for line in program.lines if line.startswith("(")] == [True] * 3, program.lines
    with connect(stack=str(domain)) as robot:
        grid = robot.map()
        known = (grid.cells >= 0).sum() * grid.resolution**2
        assert 18 < known < 30, "m^2 of a room of 6 x 4 m"
        assert robot.pose().state == "good"
        robot.estop()
        with pytest.raises(UserError, match="STOP"):
            robot.goto(0, 0)
        robot.estop(press=False)


def test_a_client_in_javascript_shows_the_pose_and_sends_a_goal(stack, tmp_path):
    modules, node = ROOT / "web" / "node_modules", shutil.which("node")
    if node is None or not (modules / "ws").exists():
        pytest.skip("no Node with @msgpack/msgpack and ws")
    for name in ("client.mjs", "wire.mjs"):
        shutil.copy(EXAMPLES / name, tmp_path)
    (tmp_path / "node_modules").symlink_to(modules)
    (tmp_path / "schema.json").write_text(json.dumps(document()))
    with connect(stack=str(stack[0])) as robot:
        pose = robot.pose()
    x = "0.5" if pose.x > 1.2 else "2.8"
    client = Program([node, "client.mjs", x, "-0.8", f"http://127.0.0.1:{9600 + stack[0]}"], tmp_path, stack[0])
    client.process.wait(DRIVE)
    client.end()
    assert client.process.returncode == 0, client.lines
    assert client.said("connected to x80")
    assert client.said("pose ")
    assert client.said("reached")
