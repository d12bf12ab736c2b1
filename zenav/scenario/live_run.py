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
from zenav.console.shutdown import StopFlag
from zenav.metrics.evaluation import TRACK_TOPICS, RunTrack
from zenav.scenario.mission import Mission
from zenav.scenario.scenario import Scenario, ScenarioResult
from zenav.stack.hardware import settings_for
from zenav.stack.launch import Launcher, free_stack, service_command
from zenav.stack.page import SERVICE, PageOpener, page_url

REQUIRED_TOPICS: tuple[Topic[Any], ...] = (topics.NAV_STATUS, topics.POSE, topics.MAP)
"""What must have come before the mission asks for anything."""
PERIOD_S = 0.1  # s between two looks of the mission
MAX_START_S = 120.0  # s for the first word of every service: a first start may compile kernels


class ProcessStats:
    """CPU and memory of each process, from its health messages."""

    def __init__(self) -> None:
        self.latest: dict[str, Health] = {}
        self.received_at: dict[str, float] = {}  # s, monotonic
        self._cpu: dict[str, list[float]] = {}
        self._memory: dict[str, float] = {}

    def hear(self, health: Health) -> None:
        self.latest[health.name] = health
        self.received_at[health.name] = time.monotonic()
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


class RunView:
    """The display's side of a run: `show_line` receives log lines, `look` is called ten times a second."""

    def start(self, scenario: Scenario, launcher: Launcher, processes: ProcessStats) -> None:
        """The run begins."""

    def show_line(self, name: str, line: str) -> None:
        """A line of a service's log, or of the launcher's."""

    def look(self, client: Client, mission: Mission, seconds: float) -> None:
        """The run goes on."""

    def end(self) -> None:
        """The run is over."""


def run_live(
    scenario: Scenario,
    seconds: float,
    folder: Path,
    record: Path,
    stop: StopFlag,
    view: RunView,
    explores: bool = True,
    browser: bool = False,
) -> ScenarioResult:
    """Runs the scenario for at most `seconds`, or until `stop`; logs go into `folder`. No process outlives it.

    browser: whether a browser shows the page in a desktop session, where the scenario has the page's server.
    """
    begun = time.monotonic()
    given = psutil.Process().create_time()
    track, processes, lock = RunTrack(), ProcessStats(), threading.Lock()
    tracked: tuple[Topic[Any], ...] = tuple(topics.BY_KEY[key] for key in TRACK_TOPICS)
    ports = settings_for(scenario.hardware, scenario.file, folder)
    settings = [*scenario.settings, *ports, f"recorder.file={json.dumps(str(record.resolve()))}"]
    mission = Mission(
        scenario.goals, lambda request, message: client.ask(request, message, timeout=2.0), explores, seconds
    )

    def add_to_track(message: Message, sent: int) -> None:
        with lock:
            track.add(message, sent)

    with free_stack() as claim:
        commands = {
            name: service_command(name, scenario.robot, str(claim.where.domain), settings, memory=folder / "memory")
            for name in scenario.names
        }
        url = page_url(scenario.file, claim.where) if SERVICE in scenario.names else ""
        opener = PageOpener(url, browser)
        launcher = Launcher(commands, folder, view.show_line)
        with launcher, Client(scenario.file.robot.name, claim.where) as client:
            client.follow(topics.GUARD, *REQUIRED_TOPICS)
            for topic in tracked:
                client.listen(topic, lambda message, envelope: add_to_track(message, envelope.sent))

            def hear(health: Health) -> None:
                processes.hear(health)
                launcher.hear(health)
                opener.hear(health)

            client.listen(topics.HEALTH, lambda health, _: hear(health))
            if url:
                view.show_line("zenav", f"the page is at {url}")
            view.start(scenario, launcher, processes)
            try:
                launcher.start_all(lambda name: name in processes.latest, stop.is_set)
                trouble = _steer(client, launcher, processes, mission, stop, begun + seconds, view)
            finally:
                view.end()
    with lock:
        outcome = ScenarioResult(scenario, track, mission, time.monotonic() - begun, trouble=trouble)
    outcome.processes = processes.summary()
    outcome.restarts = {name: child.n_restarts for name, child in launcher.children.items() if child.n_restarts}
    if track.first_motion is not None:
        outcome.first_motion = track.first_motion / 1e9 - given
    return outcome


def _steer(
    client: Client,
    launcher: Launcher,
    processes: ProcessStats,
    mission: Mission,
    stop: StopFlag,
    limit: float,
    view: RunView,
) -> str:
    """Steps launcher, mission and view until the mission is done; returns why it ended before, or nothing."""
    begun, ready = time.monotonic(), False
    while mission.leg is not None:
        launcher.pause(PERIOD_S)
        if stop.is_set():
            return "interrupted"
        now = time.monotonic()
        if now > limit:
            return "out of time"
        launcher.step()
        if not ready:
            missing = [name for name in launcher.children if name not in processes.latest]
            missing += [topic.key for topic in REQUIRED_TOPICS if client.latest(topic) is None]
            ready = not missing
            if missing and now - begun > MAX_START_S:
                return f"after {MAX_START_S:g} s still nothing from {', '.join(missing)}"
        if ready:
            mission.step(client.now() / 1e9, client.latest(topics.NAV_STATUS))
        view.look(client, mission, now - begun)
    return ""
