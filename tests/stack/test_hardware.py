# SPDX-License-Identifier: Apache-2.0
"""The stack as people start it, on emulated hardware: drivers as processes, real pseudo-terminals, real faults."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from services.base_driver.drrobot import disable_motor
from services.sim.hardware.drrobot import GainsCommand, VelocityCommand, decode_command
from shared import reasons, requests, topics
from shared.drrobot import BOARD, Deframer
from shared.geometry import Pose2
from shared.messages import BaseStatus, Health, SerialData, Truth
from shared.requests import Navigate
from tests.stack.processes import ROBOT
from zenav.__main__ import _status
from zenav.client import Client
from zenav.stack.launch import ROOT, free_stack

START, SOON = 180.0, 60.0  # s that a busy machine may take; nothing here is expected to
THERE, BACK = (0.8, 0.0), (0.0, 0.0)


class Up:
    """A running `zenav up --hardware emulated`, and all that was heard of it."""

    def __init__(self, process: "subprocess.Popen[str]", client: Client, stack: int) -> None:
        self.process, self.client, self.stack = process, client, stack
        self.lines: list[str] = []
        self.statuses: list[BaseStatus] = []
        self.truths: list[Truth] = []
        self.pids: dict[str, int] = {}
        self.received: list[SerialData] = []  # by the emulated board

    def listen(self) -> None:
        client = self.client
        client.follow(topics.NAV_STATUS, topics.POSE, topics.MAP, topics.BASE_STATUS, topics.TRUTH)
        client.listen(topics.BASE_STATUS, lambda status, _: self.statuses.append(status))
        client.listen(topics.TRUTH, lambda truth, _: self.truths.append(truth))
        client.listen(topics.HEALTH, lambda health, _: self._hear(health))
        client.listen(topics.RX, lambda data, envelope: self._read(data, envelope.publisher))

    def _hear(self, health: Health) -> None:
        self.pids[health.name] = health.pid

    def _read(self, data: SerialData, reader: str) -> None:
        if (reader, data.port) == ("sim", "board"):
            self.received.append(data)

    def at_the_board(self, since: int = 0) -> bytes:
        """What the board received after a moment, ns."""
        return b"".join(data.data for data in self.received.copy() if data.stamp > since)

    def until(self, holds: Callable[[], object], seconds: float = SOON) -> None:
        """Waits for the condition; fails with what the services wrote."""
        limit = time.monotonic() + seconds
        while not holds():
            assert time.monotonic() < limit, "".join(self.lines)
            assert self.process.poll() is None, "".join(self.lines)
            threading.Event().wait(0.05)

    def zenav(self, *arguments: str) -> int:
        return _status([*arguments, "--stack", str(self.stack)])

    def moves(self) -> bool:
        truth = self.client.latest(topics.TRUTH)
        return truth is not None and truth.v > 0.1

    def in_order(self) -> bool:
        status = self.client.latest(topics.BASE_STATUS)
        return status is not None and status.link and not status.fault

    def farther(self) -> tuple[float, float]:
        """Whichever end is further away."""
        pose = self.client.latest(topics.POSE)
        assert pose is not None
        return max(THERE, BACK, key=lambda place: abs(place[0] - pose.map_from_base.x))

    def drive_off(self) -> None:
        """Sends it to the further end, and waits until it moves."""
        x, y = self.farther()

        def accepted() -> bool:
            goal = Navigate(self.client.now(), (Pose2(x, y, 0.0),), 0.0, 1, True)
            return self.client.ask(requests.NAVIGATE, goal).accepted

        self.until(accepted)
        self.until(self.moves)

    def arrives(self, x: float, y: float) -> bool:
        """Whether `zenav goto` gets it there, in truth too."""
        if self.zenav("goto", str(x), str(y)) != 0:
            return False
        truth = self.truths[-1]
        return (truth.start.inverse() @ truth.world_from_base).distance(Pose2(x, y, 0.0)) < 0.4


@contextmanager
def running(folder: Path) -> Iterator[Up]:
    with free_stack() as claim:
        where = claim.where
    command = [sys.executable, "-m", "zenav", "up", "--world", "room", "--hardware", "emulated"]
    environment = dict(os.environ, PYTHONPATH=str(ROOT))  # noqa: TID251
    process = subprocess.Popen(
        [*command, "--stack", str(where.domain)], cwd=folder, stderr=subprocess.PIPE, text=True, env=environment
    )
    assert process.stderr is not None
    with process, Client(ROBOT.name, where) as client:
        up = Up(process, client, where.domain)
        reader = threading.Thread(target=up.lines.extend, args=(process.stderr,), daemon=True)
        reader.start()
        try:
            up.listen()
            up.until(lambda: any("every service runs" in line for line in up.lines), START)
            up.until(lambda: all(client.latest(t) is not None for t in (topics.NAV_STATUS, topics.POSE, topics.MAP)))
            up.until(up.in_order)
            yield up
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
            reader.join(5)


@pytest.fixture(scope="module")
def up(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Up]:
    with running(tmp_path_factory.mktemp("hardware")) as up:
        yield up


def test_a_goal_is_reached_through_the_ports(up):
    assert up.arrives(*THERE)
    assert up.at_the_board()
    assert up.truths[-1].n_contacts == 0


def test_an_unplugged_board_stands_is_named_and_comes_back(up, capsys):
    up.drive_off()
    n_statuses, n_truths = len(up.statuses), len(up.truths)
    assert up.zenav("fault", "unplugged", "--seconds", "2") == 0
    assert "pulled out" in capsys.readouterr().out

    def named() -> list[BaseStatus]:  # on a busy machine the wheels may fall behind their commands before
        return [status for status in up.statuses[n_statuses:] if status.fault == reasons.PORT_CLOSED.code]

    up.until(named)
    unplugged = named()[0]
    assert "/board " in unplugged.detail
    up.until(lambda: any(truth.v == pytest.approx(0, abs=0.005) for truth in up.truths[n_truths:]))
    up.until(up.in_order)
    assert up.arrives(*up.farther())
    packets = Deframer(BOARD).packets(up.at_the_board(unplugged.stamp))
    orders = [order for packet in packets if (order := decode_command(packet))]
    assert [type(order) for order in orders[:3]] == [GainsCommand, GainsCommand, VelocityCommand]
    speeds = [
        tuple(order.channels[wheel] for wheel in (0, 1)) for order in orders if isinstance(order, VelocityCommand)
    ]
    assert speeds[0] == (0, 0), "the first command after the reconnection is zero"
    assert any(speed != (0, 0) for speed in speeds)


def test_a_fault_that_is_none_is_one_line_and_a_hint(up, capsys):
    assert up.zenav("fault", "unpluged") == 2
    out, err = capsys.readouterr()
    assert out == ""
    what, hint = err.splitlines()
    assert "unpluged" in what
    assert hint.startswith("hint: ")
    assert "unplugged" in hint


def test_a_killed_driver_comes_back_and_drives_on(up):
    up.drive_off()
    before = up.pids["base_driver"]
    os.kill(before, signal.SIGKILL)
    up.until(lambda: up.pids["base_driver"] != before and up.in_order())
    assert any("base_driver" in line and "killed by SIGKILL" in line for line in up.lines)
    assert up.arrives(*BACK)


def test_a_driver_that_is_asked_to_end_takes_the_power_off_the_motors(up):
    up.drive_off()
    before, begin = up.pids["base_driver"], up.client.now()
    os.kill(before, signal.SIGTERM)
    up.until(lambda: disable_motor(0) + disable_motor(1) in up.at_the_board(begin))
    up.until(lambda: up.pids["base_driver"] != before and up.in_order())
