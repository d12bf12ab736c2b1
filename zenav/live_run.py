# SPDX-License-Identifier: Apache-2.0
"""The scenario as processes over Zenoh, in real time, on a stack number of its own."""

import json
import threading
import time
from pathlib import Path
from typing import Any

import psutil

from shared import topics
from shared.messages import Health, Message
from shared.topics import Topic
from zenav.client import Client
from zenav.hardware import settings_for
from zenav.launch import Launcher, free_stack, service_command
from zenav.pilot import Pilot
from zenav.scene import Outcome, Scene
from zenav.score import KEYS, Track
from zenav.stopping import Stop

NEEDED: tuple[Topic[Any], ...] = (topics.NAV, topics.POSE, topics.MAP)
"""What must have come before the pilot asks for anything."""
PERIOD = 0.1  # s between two looks of the pilot
START_LIMIT = 120.0  # s for the first word of every service: a first start may compile kernels


class Processes:
    """CPU and memory of each process, from its health messages."""

    def __init__(self) -> None:
        self.latest: dict[str, Health] = {}
        self.heard: dict[str, float] = {}  # s, monotonic
        self._cpu: dict[str, list[float]] = {}
        self._memory: dict[str, float] = {}

    def hear(self, health: Health) -> None:
        self.latest[health.name] = health
        self.heard[health.name] = time.monotonic()
        self._cpu.setdefault(health.name, []).append(health.cpu)
        self._memory[health.name] = max(self._memory.get(health.name, 0.0), health.memory)

    def summary(self) -> dict[str, dict[str, float]]:
        """Mean CPU (share of a core), largest CPU in a second, largest memory (MB), and this process's own."""
        rows = {
            name: {
                "cpu": round(sum(shares) / len(shares), 3),
                "cpu_max": round(max(shares), 3),
                "memory_mb": round(self._memory[name], 1),
            }
            for name, shares in sorted(self._cpu.items())
        }
        process = psutil.Process()
        lived = max(time.time_ns() / 1e9 - process.create_time(), 1e-3)
        own = round(time.process_time() / lived, 3)
        rows["zenav"] = {"cpu": own, "cpu_max": own, "memory_mb": round(process.memory_info().rss / 1e6, 1)}
        return rows


class View:
    """The display's side of a run: `show_line` receives log lines, `look` is called ten times a second."""

    def start(self, scene: Scene, launcher: Launcher, processes: Processes) -> None:
        """The run begins."""

    def show_line(self, name: str, line: str) -> None:
        """A line of a service's log, or of the launcher's."""

    def look(self, client: Client, pilot: Pilot, seconds: float) -> None:
        """The run goes on."""

    def end(self) -> None:
        """The run is over."""


def run(
    scene: Scene, seconds: float, folder: Path, record: Path, stop: Stop, view: View, explores: bool = True
) -> Outcome:
    """Runs the scenario for at most `seconds`, or until `stop`; logs go into `folder`. No process outlives it."""
    begun = time.monotonic()
    given = psutil.Process().create_time()
    track, processes, lock = Track(), Processes(), threading.Lock()
    tracked: tuple[Topic[Any], ...] = tuple(topics.BY_KEY[key] for key in KEYS)
    ports = settings_for(scene.hardware, scene.file, folder)
    settings = [*scene.settings, *ports, f"recorder.file={json.dumps(str(record.resolve()))}"]
    pilot = Pilot(scene.goals, lambda request, message: client.ask(request, message, timeout=2.0), explores, seconds)

    def take(message: Message, sent: int) -> None:
        with lock:
            track.take(message, sent)

    with free_stack() as claim:
        commands = {
            name: service_command(name, scene.robot, str(claim.where.domain), settings, memory=folder / "memory")
            for name in scene.names
        }
        launcher = Launcher(commands, folder, view.show_line)
        with launcher, Client(scene.file.robot.name, claim.where) as client:
            client.follow(topics.GUARD, *NEEDED)
            for topic in tracked:
                client.listen(topic, lambda message, envelope: take(message, envelope.sent))

            def hear(health: Health) -> None:
                processes.hear(health)
                launcher.hear(health)

            client.listen(topics.HEALTH, lambda health, _: hear(health))
            view.start(scene, launcher, processes)
            try:
                launcher.start_all(lambda name: name in processes.latest, stop.is_set)
                trouble = _steer(client, launcher, processes, pilot, stop, begun + seconds, view)
            finally:
                view.end()
    with lock:
        outcome = Outcome(scene, track, pilot, time.monotonic() - begun, trouble=trouble)
    outcome.processes = processes.summary()
    outcome.restarts = {name: child.n_restarts for name, child in launcher.children.items() if child.n_restarts}
    if track.first_motion is not None:
        outcome.first_motion = track.first_motion / 1e9 - given
    return outcome


def _steer(
    client: Client,
    launcher: Launcher,
    heard: Processes,
    pilot: Pilot,
    stop: Stop,
    limit: float,
    view: View,
) -> str:
    """Steps launcher, pilot and view until the pilot is done; returns why it ended before, or nothing."""
    begun, ready = time.monotonic(), False
    while pilot.leg is not None:
        if stop.wait(PERIOD):
            return "interrupted"
        now = time.monotonic()
        if now > limit:
            return "out of time"
        launcher.step()
        if not ready:
            missing = [name for name in launcher.children if name not in heard.latest]
            missing += [topic.key for topic in NEEDED if client.latest(topic) is None]
            ready = not missing
            if missing and now - begun > START_LIMIT:
                return f"after {START_LIMIT:g} s still nothing from {', '.join(missing)}"
        if ready:
            pilot.step(client.now() / 1e9, client.latest(topics.NAV))
        view.look(client, pilot, now - begun)
    return ""
