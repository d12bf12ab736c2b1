# SPDX-License-Identifier: Apache-2.0
"""The stacks that `zenav bench faults` breaks: in lockstep, and live over Zenoh."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from services.guard.config import GuardConfig
from shared import topics
from shared.codec import Envelope, encode
from shared.config import RobotFile, UserError, configured
from shared.messages import Health, LaserScan, Velocity
from shared.runners.lockstep import Lockstep
from zenav.bench.fault_trial import KEYS, FaultMeter
from zenav.client import Client
from zenav.scenario.lockstep_run import RECORDER
from zenav.stack.hardware import Hardware, services_for
from zenav.stack.launch import Launcher, free_stack, service_command
from zenav.stack.service_loader import build_service

COMMANDS_EVERY = 0.05  # s between two commands of a hand
SETTLE_S = 2.0  # s until the first command
MAX_START_S = 120.0  # s: a first start may compile kernels

Until = Callable[[], bool] | None


def _names(file: RobotFile) -> list[str]:
    return [name for name in services_for(Hardware.MESSAGES, file) if name != RECORDER]


def _meter(file: RobotFile) -> FaultMeter:
    return FaultMeter(file.section("guard", GuardConfig).field.blind_speed)


class LockstepStack:
    """All services in this process on the virtual clock."""

    def __init__(self, robot: str, settings: list[str]) -> None:
        self.file = configured(robot, settings)
        self.lockstep = Lockstep({name: build_service(name, self.file, self.file.robot) for name in _names(self.file)})
        self.meter = _meter(self.file)
        self.hand: tuple[float, float] | None = None
        self.repeats_sequence = False
        for topic in KEYS:
            self.lockstep.watch(topic.key, partial(self._hear, topic.key))
        self._command()
        self.run(SETTLE_S)

    def _hear(self, key: str, message: Any) -> None:
        self.meter.add(key, message, self.lockstep.now)

    def _command(self) -> None:
        if self.hand is not None:
            self.lockstep.publish(topics.TELEOP(Velocity(self.now, *self.hand, "")))
        self.lockstep.at(COMMANDS_EVERY, self._command)

    @property
    def now(self) -> int:
        return self.lockstep.now

    def run(self, seconds: float, until: Until = None) -> bool:
        """Runs for so long, or until the condition holds; whether it held."""
        return self.lockstep.run(seconds, until or (lambda: False))

    def ask(self, request: Any, message: Any) -> Any:
        return self.lockstep.ask(request, message)

    def kill(self, name: str) -> None:
        self.lockstep.kill(name)

    def is_back(self, name: str) -> bool:
        """Never by itself."""
        return False

    def start(self, name: str) -> None:
        self.lockstep.start(name, build_service(name, self.file, self.file.robot))


class LiveStack:
    """Processes over Zenoh in real time; the launcher starts again what is killed."""

    def __init__(self, file: RobotFile, client: Client, launcher: Launcher) -> None:
        self.file, self.client, self.launcher = file, client, launcher
        self.meter = _meter(file)
        self.hand: tuple[float, float] | None = None
        self.repeats_sequence = False
        self._scan: tuple[LaserScan, Envelope] | None = None
        self._killed = 0  # the process that was killed last
        client.listen(topics.SCAN, self._hear_scan)
        for topic in KEYS:
            client.listen(topic, partial(self._hear, topic.key))

    def _hear(self, key: str, message: Any, envelope: Any) -> None:
        self.meter.add(key, message, envelope.sent)

    def _hear_scan(self, scan: LaserScan, envelope: Envelope) -> None:
        if not self.repeats_sequence:
            self._scan = scan, envelope

    def _repeat(self) -> None:
        """The last scan once more, as if it were new but for its sequence."""
        if self._scan is not None:
            scan, envelope = self._scan
            again = replace(scan, stamp=self.now - round(scan.scan_time * 1e9))
            key = f"{self.client.robot}/{topics.SCAN.key}"
            self.client.session.put(key, encode(again, envelope._replace(sent=self.now)))

    @property
    def now(self) -> int:
        return self.client.now()

    def run(self, seconds: float, until: Until = None) -> bool:
        """Waits for so long, or until the condition holds; whether it held."""
        limit, command, scan = time.monotonic() + seconds, 0.0, 0.0
        while (now := time.monotonic()) < limit:
            self.launcher.step()
            if self.hand is not None and now >= command:
                self.client.publish(topics.TELEOP(Velocity(self.now, *self.hand, "")))
                command = now + COMMANDS_EVERY
            if self.repeats_sequence and now >= scan:
                self._repeat()
                scan = now + 1 / self.file.robot.laser.rate
            if until is not None and until():
                return True
            with self.client.changed:
                self.client.changed.wait(COMMANDS_EVERY / 4)
        return until is not None and until()

    def ask(self, request: Any, message: Any) -> Any:
        return self.client.ask(request, message)

    def kill(self, name: str) -> None:
        process = self.launcher.children[name].process
        if process is not None:
            self._killed = process.pid
            os.kill(process.pid, signal.SIGKILL)

    def is_back(self, name: str) -> bool:
        """Whether the launcher has started it again, and it is heard."""
        child = self.launcher.children[name]
        return child.heard > 0 and child.process is not None and child.process.pid != self._killed

    def start(self, name: str) -> None:
        """Waits until it is back."""
        self.run(MAX_START_S, partial(self.is_back, name))


@contextmanager
def live_stack(robot: str, settings: list[str], folder: Path) -> Iterator[LiveStack]:
    """A stack of its own, up and heard. Raises UserError where it does not start."""
    file, names_seen = configured(robot, settings), set[str]()
    with free_stack() as claim:
        where = str(claim.where.domain)
        commands = {
            name: service_command(name, robot, where, settings, memory=folder / "memory") for name in _names(file)
        }
        launcher = Launcher(commands, folder)
        with launcher, Client(file.robot.name, claim.where) as client:

            def hear(health: Health) -> None:
                launcher.hear(health)
                names_seen.add(health.name)

            client.listen(topics.HEALTH, lambda health, _: hear(health))
            stack = LiveStack(file, client, launcher)
            launcher.start_all(lambda name: name in names_seen)
            if not stack.run(
                MAX_START_S, lambda: len(names_seen) == len(commands) and len(stack.meter.newest) == len(KEYS)
            ):
                missing = sorted({topic.key for topic in KEYS} - set(stack.meter.newest))
                raise UserError(f"the stack does not start; still nothing on {', '.join(missing)}", "zenav doctor")
            stack.run(SETTLE_S)
            yield stack
