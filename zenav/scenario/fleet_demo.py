# SPDX-License-Identifier: Apache-2.0
"""`zenav demo --robots N`: several robots in one world drive to random goals, each with a stack of its own.

They have the true map. In lockstep all stacks run in this process. Live they run as processes at one router. Then this
process shows each simulator where the others are.
"""

import json
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from shared import requests, topics
from shared.config import UserError, configured
from shared.messages import Health, NavStatus, PoseEstimate, Truth
from shared.robot_files import own_name_and_kind
from shared.runners.transport import StackAddress
from zenav.client import Client
from zenav.console.json_report import write_report
from zenav.console.run_folder import new_run_folder
from zenav.console.shutdown import StopFlag, stop_on_signal
from zenav.scenario.path_finder import PathFinder
from zenav.scenario.random_goals import LOOK_S, RandomGoals, place
from zenav.scenario.robot_group import RobotGroup
from zenav.scenario.scenario import Scenario, load_scenario
from zenav.scenario.shared_world import SharedWorld, start_poses
from zenav.stack.hardware import simulated_world
from zenav.stack.launch import START_LIMIT, Launcher, service_command
from zenav.stack.page import SERVICE, PageOpener, page_url
from zenav.stack.warm import warm_first

COLOURS = "red", "blue", "green", "yellow", "white", "black", "orange", "violet"
MAX_LIVE = 4  # robots: each is ten processes
EXCHANGE_S = 0.05  # s between two looks of the simulators at each other
LINE_S = 10.0  # s between two lines
PAGE_PORT = 8600


def robot_names(n: int) -> list[str]:
    """red, blue, ..., then robot_9 and so on."""
    return [COLOURS[i] if i < len(COLOURS) else f"robot_{i + 1}" for i in range(n)]


def fleet_demo(
    robot: str,
    world: str,
    n: int,
    seed: int,
    seconds: float,
    lockstep: bool,
    settings: list[str],
    out: Path | None,
    page: bool,
    browser: bool,
) -> int:
    """Runs the robots. 0 when nothing was touched, and every robot reached a goal."""
    if not lockstep and n > MAX_LIVE:
        raise UserError(f"{n} robots are {10 * n} processes", f"at most {MAX_LIVE} live; more: --lockstep")
    folder, names = new_run_folder("demo"), robot_names(n)
    with stop_on_signal() as stop:
        if lockstep:
            drivers = _run_lockstep(robot, world, names, seed, seconds, settings, folder, stop)
        else:
            fleet = LiveFleet(
                robot=robot, world=world, names=names, seed=seed, settings=settings, folder=folder, page=page
            )
            drivers = fleet.run(seconds, stop, browser)
        if stop.is_set():
            sys.stderr.write("interrupted\n")
            return 130
    records = [driver.record for driver in drivers]
    for record in records:
        sys.stdout.write(
            f"{record.name:<10} {record.n_reached:3} goals, {record.n_failed} given up, {record.n_contacts} contacts, "
            f"{record.distance:.0f} m, longest stand {record.longest_standstill:.1f} s\n"
        )
    sys.stdout.write(f"run             {folder}\n")
    write_report(out, {"world": world, "seed": seed, "robots": [asdict(record) for record in records]})
    return 0 if all(record.n_reached and not record.n_contacts for record in records) else 1


def _run_lockstep(
    robot: str,
    world: str,
    names: Sequence[str],
    seed: int,
    seconds: float,
    settings: list[str],
    folder: Path,
    stop: StopFlag,
) -> list[RandomGoals]:
    with RobotGroup(robot, world, names, seed, settings, folder=folder) as group:
        paths = PathFinder(group.world, group.members[0].scenario.file.robot)
        drivers = [RandomGoals(m, paths, np.random.default_rng([seed, i])) for i, m in enumerate(group.members)]
        place(drivers, paths, group.run)
        begin = shown = group.now
        while group.now < begin + seconds and not stop.is_set():
            group.run(LOOK_S)
            for driver in drivers:
                driver.step()
            if group.now - shown >= LINE_S:
                shown = group.now
                _show(drivers, group.now - begin)
    return drivers


def _show(drivers: Sequence[RandomGoals], seconds: float) -> None:
    states = []
    for driver in drivers:
        nav = driver.robot.nav
        waits = f" ({nav.detail})" if nav is not None and nav.reason in ("right_of_way", "giving_way") else ""
        states.append(f"{driver.robot.name} {driver.record.n_reached}{waits}")
    sys.stderr.write(f"{seconds:7.1f} s  goals: {', '.join(states)}\n")


class LiveRobot:
    """One robot that runs as processes."""

    def __init__(self, name: str, scenario: Scenario, client: Client) -> None:
        self.name, self.world_name, self.start = name, scenario.world.name, scenario.world.start
        self.client = client
        self.ready: set[str] = set()
        client.follow(topics.NAV_STATUS, topics.TRUTH, topics.POSE)

    @property
    def nav(self) -> NavStatus | None:
        return self.client.latest(topics.NAV_STATUS)

    @property
    def truth(self) -> Truth | None:
        return self.client.latest(topics.TRUTH)

    @property
    def pose(self) -> PoseEstimate | None:
        return self.client.latest(topics.POSE)

    def now(self) -> int:
        """ns."""
        return self.client.now()

    def ask(self, request: requests.Request[Any, Any], message: Any) -> Any:
        """The reply to a request."""
        return self.client.ask(request, message, timeout=10.0)


class LiveFleet:
    """The robots as processes at one router of this computer."""

    def __init__(
        self, robot: str, world: str, names: Sequence[str], seed: int, settings: list[str], folder: Path, page: bool
    ) -> None:
        plain = configured(robot, [f"sim.world={world}", f"sim.seed={seed}", *settings])
        self.world, self.seed, self.folder, self.page = simulated_world(plain), seed, folder, page
        starts = start_poses(self.world, len(names), plain.robot.circumscribed_radius)
        self._shared = SharedWorld(dict.fromkeys(names, plain.robot))
        self._paths = PathFinder(self.world, plain.robot)
        self._scenarios = {}
        kind = own_name_and_kind(robot)[1]
        for name, start in zip(names, starts, strict=True):
            own = [f"sim.start={{x: {start.x!r}, y: {start.y!r}, yaw: {start.yaw!r}}}"]
            own.append(f"sim.other_discs={self._shared.n_discs(name)}")
            self._scenarios[name] = load_scenario(f"{name}@{kind}", world, seed, [*settings, *own], meets_robots=True)
        self._robots: list[LiveRobot] = []
        self._launchers: list[Launcher] = []

    def run(self, seconds: float, stop: StopFlag, browser: bool) -> list[RandomGoals]:
        """Lets the robots drive for so long, or until `stop`."""
        first = next(iter(self._scenarios.values()))
        warm_first(first.robot, first.settings, first.names)
        with ExitStack() as open_things:
            endpoint = open_things.enter_context(_router())
            for name, scenario in self._scenarios.items():
                self._start(open_things, endpoint, name, scenario, browser and scenario is first)
            for launcher, robot in zip(self._launchers, self._robots, strict=True):
                launcher.start_all(lambda name, ready=robot.ready: name in ready, stop.is_set)  # type: ignore[misc]  # a name of the loop
            for robot in self._robots:
                robot.client.answers(requests.GIVE_MAP, START_LIMIT)
            drivers = [
                RandomGoals(r, self._paths, np.random.default_rng([self.seed, i])) for i, r in enumerate(self._robots)
            ]
            place(drivers, self._paths, self._wait)
            begin = shown = time.monotonic()
            while time.monotonic() < begin + seconds and not stop.is_set():
                self._wait(LOOK_S)
                for driver in drivers:
                    driver.step()
                if time.monotonic() - shown >= LINE_S:
                    shown = time.monotonic()
                    _show(drivers, shown - begin)
        return drivers

    def _start(self, open_things: ExitStack, endpoint: str, name: str, scenario: Scenario, browser: bool) -> None:
        """Prepares the processes of one robot; the first one has a page."""
        has_page = self.page and not self._robots
        services, where = [*scenario.names, *([SERVICE] if has_page else [])], StackAddress(router=endpoint)
        folder = self.folder / name
        settings = [*scenario.settings, f"recorder.file={json.dumps(str((self.folder / f'{name}.mcap').resolve()))}"]
        commands = {
            service: service_command(service, scenario.robot, endpoint, settings, memory=folder / "memory")
            for service in services
        }
        launcher = open_things.enter_context(Launcher(commands, folder, partial(_show_line, name)))
        client = open_things.enter_context(Client(name, where))
        robot = LiveRobot(name, scenario, client)
        opener = PageOpener(page_url(scenario.file, where) if has_page else "", browser and has_page)
        if has_page:
            sys.stderr.write(f"zenav        the page of {name} is at {page_url(scenario.file, where)}\n")

        def hear(health: Health) -> None:
            robot.ready.add(health.name)
            launcher.hear(health)
            opener.hear(health)

        client.listen(topics.HEALTH, lambda health, _: hear(health))
        self._robots.append(robot)
        self._launchers.append(launcher)

    def _wait(self, seconds: float) -> None:
        """Supervises the processes, and shows each simulator the others, for so long."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            for robot in self._robots:
                if robot.truth is not None:
                    self._shared.move(robot.name, robot.truth)
            for robot in self._robots:
                robot.client.publish(topics.OTHERS(self._shared.others(robot.name, robot.now())))
            for launcher in self._launchers:
                launcher.step()
            self._launchers[0].pause(min(EXCHANGE_S, left))


def _show_line(robot: str, service: str, line: str) -> None:
    """A line of a service's log, where it is more than information."""
    if not (" INFO " in line or " DEBUG " in line):
        sys.stderr.write(f"{robot:<10} {service}: {line}\n")


@contextmanager
def _router() -> Iterator[str]:
    """A router of this computer on a free port; its endpoint."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        endpoint = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
    with subprocess.Popen(
        [sys.executable, "-m", "zenav.stack.router", endpoint], stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stderr is not None
        if "listening" not in process.stderr.readline():
            raise UserError(f"no router could listen on {endpoint}", "try again: its port was taken meanwhile")
        try:
            yield endpoint
        finally:
            process.terminate()
