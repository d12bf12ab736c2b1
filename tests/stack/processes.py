# SPDX-License-Identifier: Apache-2.0
"""A real stack for a test: its own processes on its own ports, and a tool's session on it."""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from shared import requests, topics
from shared.config import load_robot
from shared.geometry import Pose2
from shared.messages import Health, NavState
from shared.recording import Recording
from shared.requests import Navigate
from shared.runners.transport import StackAddress
from zenav.client import Client
from zenav.recording.opening import recorded_robot_file
from zenav.replay.report import service_builder
from zenav.replay.reprocess import replay_file
from zenav.stack.launch import Launcher, free_stack, service_command

ROBOT = load_robot("x80sv").robot
ALL = ("sim", "base_driver", "odometry", "mapper", "planner", "local_ctrl", "guard", "navigator")
AHEAD = Pose2(0.5, 0.0, 0.0)


class StackProcesses:
    """The running stack of a test. Every wait has a deadline, and steps the launcher meanwhile."""

    def __init__(self, launcher: Launcher, client: Client, where: StackAddress, told: list[tuple[str, str]]) -> None:
        self.launcher, self.client, self.where, self.told = launcher, client, where, told
        self.healths: dict[str, Health] = {}

    def hear(self, health: Health) -> None:
        self.launcher.hear(health)
        self.healths[health.name] = health

    def until(self, holds: Callable[[], object], seconds: float = 30.0) -> None:
        """Waits for the condition; fails with what the services wrote."""
        limit = time.monotonic() + seconds
        while not holds():
            assert time.monotonic() < limit, self.told
            self.launcher.step()
            with self.client.changed:
                self.client.changed.wait(0.05)

    def pid(self, name: str) -> int:
        process = self.launcher.children[name].process
        assert process is not None
        return process.pid

    def up(self) -> bool:
        """Every service has sent its health, and the navigator has all that it needs."""
        current = [n for n, child in self.launcher.children.items() if child.process and child.heard]
        needed = (topics.NAV_STATUS, topics.POSE, topics.MAP) if "navigator" in self.launcher.children else ()
        return len(current) == len(self.launcher.children) and all(self.client.latest(t) is not None for t in needed)

    def go(self, pose: Pose2 = AHEAD) -> int:
        """Sends the robot to a pose in `map`; returns the task's number."""
        accepted: list[int] = []

        def asked() -> bool:
            reply = self.client.ask(requests.NAVIGATE, Navigate(self.client.now(), (pose,), 0.0, 1, True))
            accepted.extend([reply.task_id] if reply.accepted else [])
            return reply.accepted

        self.until(asked)
        return accepted[0]

    def reached(self, task: int) -> Callable[[], bool]:
        def holds() -> bool:
            nav = self.client.latest(topics.NAV_STATUS)
            return nav is not None and nav.task_id == task and nav.state is NavState.REACHED

        return holds


@contextmanager
def running(
    folder: Path, names: tuple[str, ...] = ALL, world: str = "room", order: int = 0, settings: tuple[str, ...] = ()
) -> Iterator[StackProcesses]:
    """Starts the services in an order drawn from the seed `order`, and waits until they are up."""
    told: list[tuple[str, str]] = []
    with free_stack() as claim:
        commands = {
            name: service_command(
                name, "x80sv", str(claim.where.domain), [f"sim.world={world}", *settings], memory=folder / "memory"
            )
            for name in np.random.default_rng(order).permutation(names).tolist()
        }
        launcher = Launcher(commands, folder, lambda name, line: told.append((name, line)))
        with launcher, Client(ROBOT.name, claim.where) as client:
            stack = StackProcesses(launcher, client, claim.where, told)
            client.listen(topics.HEALTH, lambda health, _: stack.hear(health))
            client.follow(topics.NAV_STATUS, topics.POSE, topics.MAP, topics.GUARD, topics.TRUTH)
            launcher.start_all(lambda name: name in stack.healths)
            stack.until(stack.up, 90)
            yield stack


def once(holds: Callable[[], object], action: Callable[[], object], seconds: float = 60.0) -> threading.Thread:
    """A thread, which runs, that does something once the condition holds, or after so many seconds in any case."""

    def work() -> None:
        limit = time.monotonic() + seconds
        while not holds() and time.monotonic() < limit:
            wait(0.02)
        action()

    thread = threading.Thread(target=work)
    thread.start()
    return thread


def wait(seconds: float) -> None:
    """Lets the stack run for a while, where what must not happen could happen."""
    threading.Event().wait(seconds)


def assert_replays(path: Path, service: str, keys: tuple[str, ...]) -> None:
    """A service replays to the byte from a recording, with messages of these keys."""
    file = recorded_robot_file(Recording(path))
    assert file is not None
    report = replay_file(path, [service], None, service_builder(file), lambda done, of: None)
    assert report.notes == []
    assert report.equal, report
    counts = {topic.key: topic.n_equal for topic in report.topics}
    assert min(counts[key] for key in keys) >= 1
