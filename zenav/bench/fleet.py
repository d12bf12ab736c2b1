# SPDX-License-Identifier: Apache-2.0
"""`zenav bench fleet`: several robots in one world drive to random goals; contacts, standstills and goals reached.

Each robot has the true map and its pose on it at the start. The same is done by one robot alone: N robots that do not
hinder each other reach N times as many goals.
"""

import json
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from math import hypot
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time
from typing import Any

import numpy as np

from services.mapper.maps.map_file import pack_map
from shared import requests
from shared.geometry import Pose2
from shared.messages import MapMode, NavState
from shared.requests import Navigate
from shared.ros_map import write_ros_map
from zenav.bench.ground_truth_driver import PathFinder
from zenav.client.map_transfer import give_map, start_mode
from zenav.client.navigation_client import FINAL_STATES
from zenav.console.json_report import check_writable, write_report
from zenav.console.table import show_table
from zenav.maps.foreign_map import read_map
from zenav.scenario.robot_group import GroupMember, RobotGroup

LOOK_S = 0.2  # s between two looks at the robots
SETTLES_S = 1.0  # s until a mapper has its map
MIN_WAY_M = 3.0  # m to a new goal
MOVES_MPS, MOVES_RPS = 0.02, 0.05
MAX_STANDSTILL_S = 60.0  # s without motion on the way to a goal: a deadlock
COLUMNS = "robots", "goals", "of N times one", "given up", "contacts", "longest stand, s", "driven, m", "CPU, s"


@dataclass(slots=True)
class RobotRecord:
    """What one robot did. longest_standstill: s without motion on the way."""

    name: str
    n_reached: int = 0
    n_failed: int = 0
    n_contacts: int = 0
    distance: float = 0.0
    longest_standstill: float = 0.0
    reasons: dict[str, int] = field(default_factory=dict)


@dataclass(slots=True)
class FleetRun:
    """All robots of one run. share: of N times the goals of one robot; None of that one robot."""

    robots: list[RobotRecord]
    cpu_s: float
    share: float | None = None

    @property
    def n_reached(self) -> int:
        return sum(robot.n_reached for robot in self.robots)

    @property
    def n_contacts(self) -> int:
        return sum(robot.n_contacts for robot in self.robots)

    @property
    def longest_standstill(self) -> float:
        return max(robot.longest_standstill for robot in self.robots)


def fleet(robot: str, world: str, n: int, seconds: float, seed: int, out: Path | None, settings: list[str]) -> int:
    """Runs one robot, then n. 0 when nothing was touched, and none stood on its way for MAX_STANDSTILL_S."""
    check_writable(out)
    runs: list[FleetRun] = []
    for count in dict.fromkeys((1, n)):
        run = drive(robot, world, count, seconds, seed, settings)
        if runs:
            run.share = run.n_reached / (count * runs[0].n_reached) if runs[0].n_reached else None
        runs.append(run)
    show_table(f"{world}, {seconds:g} s of virtual time, seed {seed}", COLUMNS, [_row(run) for run in runs])
    for name, reasons in ((robot.name, robot.reasons) for run in runs for robot in run.robots if robot.reasons):
        sys.stdout.write(f"{name} gave up: {json.dumps(reasons)}\n")
    write_report(out, {"world": world, "seconds": seconds, "seed": seed, "runs": [asdict(run) for run in runs]})
    return 0 if all(run.n_contacts == 0 and run.longest_standstill <= MAX_STANDSTILL_S for run in runs) else 1


def drive(robot: str, world: str, n: int, seconds: float, seed: int, settings: list[str]) -> FleetRun:
    """n robots drive to random goals for so many seconds of virtual time."""
    begun = process_time()
    names = [f"robot_{i + 1}" for i in range(n)]
    with RobotGroup(robot, world, names, seed, settings) as group:
        paths = PathFinder(group.world, group.members[0].scenario.file.robot)
        content = _packed(paths)
        drivers = [
            FleetDriver(member, paths, np.random.default_rng([seed, i])) for i, member in enumerate(group.members)
        ]
        for driver in drivers:
            driver.give_map(content, group.run)
        end = group.now + seconds
        while group.now < end:
            group.run(LOOK_S)
            for driver in drivers:
                driver.step()
        return FleetRun([driver.record for driver in drivers], round(process_time() - begun, 1))


class FleetDriver:
    """Gives one robot one random goal after the other."""

    def __init__(self, member: GroupMember, paths: PathFinder, rng: np.random.Generator) -> None:
        self._member, self._paths, self._rng = member, paths, rng
        self.record = RobotRecord(member.name)
        self._task_id = -1
        self._standstill = 0.0

    def give_map(self, content: bytes, wait: Callable[[float], None]) -> None:
        """Lets the mapper track the robot on the true map from its true pose."""
        member = self._member
        asker = _Asker(member)
        start_mode(asker, wait, MapMode.LOCALISE, give_map(asker, wait, content), member.scenario.world.start)
        wait(SETTLES_S)

    def step(self) -> None:
        """Looks at the robot after LOOK_S."""
        nav, truth, record = self._member.nav, self._member.truth, self.record
        if nav is None or truth is None:
            return
        record.n_contacts, record.distance = truth.n_contacts, truth.distance
        if nav.task_id == self._task_id and nav.state not in FINAL_STATES:
            moves = abs(truth.v) > MOVES_MPS or abs(truth.w) > MOVES_RPS
            self._standstill = 0.0 if moves else self._standstill + LOOK_S
            record.longest_standstill = round(max(record.longest_standstill, self._standstill), 1)
            return
        if nav.task_id == self._task_id:
            record.n_reached += nav.state is NavState.REACHED
            if nav.state is NavState.FAILED:
                record.n_failed += 1
                record.reasons[nav.reason] = record.reasons.get(nav.reason, 0) + 1
        self._task_id = -1
        self._send(truth.world_from_base)

    def _send(self, here: Pose2) -> None:
        goal = here
        while hypot(goal.x - here.x, goal.y - here.y) < MIN_WAY_M:
            goal = self._paths.random_pose(self._rng)
        lockstep = self._member.lockstep
        reply = lockstep.ask(requests.NAVIGATE, Navigate(lockstep.now, (goal,), 0.0, 1, True))
        if reply.accepted:
            self._task_id, self._standstill = reply.task_id, 0.0


class _Asker:
    """A tool at a robot on the virtual clock."""

    def __init__(self, member: GroupMember) -> None:
        self._lockstep = member.lockstep

    def now(self) -> int:
        return self._lockstep.now

    def ask(self, request: requests.Request[Any, Any], message: Any) -> Any:
        return self._lockstep.ask(request, message)


def _packed(paths: PathFinder) -> bytes:
    """The true map for a mapper, as a map of another program."""
    grid = paths.grid
    with TemporaryDirectory() as folder:
        write_ros_map(Path(folder), grid.cells, grid.resolution, grid.x0, grid.y0)
        return pack_map(read_map(Path(folder), grid.resolution))


def _row(run: FleetRun) -> tuple[str, ...]:
    return (
        str(len(run.robots)),
        str(run.n_reached),
        "-" if run.share is None else f"{run.share:.0%}",
        str(sum(robot.n_failed for robot in run.robots)),
        str(run.n_contacts),
        f"{run.longest_standstill:.1f}",
        f"{sum(robot.distance for robot in run.robots):.0f}",
        f"{run.cpu_s:.0f}",
    )
