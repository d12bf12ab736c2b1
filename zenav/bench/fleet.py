# SPDX-License-Identifier: Apache-2.0
"""`zenav bench fleet`: several robots in one world drive to random goals; contacts, standstills and goals reached.

Each robot has the true map and its pose on it at the start. The same is done by one robot alone: N robots that do not
hinder each other reach N times as many goals. It is also run with robots that do not hear each other, and with faults.
"""

import json
import sys
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from time import process_time

import numpy as np

from services.traffic.service import TrafficService
from shared import topics
from shared.codec import Envelope, encode
from shared.messages import RobotIntent
from zenav.console.json_report import check_writable, write_report
from zenav.console.progress import progress_bar
from zenav.console.table import show_table
from zenav.scenario.path_finder import PathFinder
from zenav.scenario.random_goals import HEARD_S, LOOK_S, MOVES_MPS, RandomGoals, RobotRecord, place
from zenav.scenario.robot_group import GroupMember, RobotGroup

MAX_STANDSTILL_S = 60.0  # s without motion on the way to a goal: a deadlock
DOOR_M = 1.3  # m of passage that count as a door
FAULT_FROM, FAULT_TO = 1 / 3, 2 / 3  # share of the run from which, and to which, a fault lasts
COLUMNS = (
    "robots",
    "coordination",
    "goals",
    "of N times one",
    "given up",
    "contacts",
    "longest stand, s",
    "driven, m",
    "kB/s a robot",
    "CPU, s",
)


class Coordination(StrEnum):
    """Whether the robots hear each other."""

    ON = "on"
    OFF = "off"
    BOTH = "both"  # one run after the other


class FleetFault(StrEnum):
    """What happens during the run."""

    NONE = "none"
    KILL_IN_DOOR = "kill_in_door"  # all services of the first robot that comes into a narrow place end
    PARTITION = "partition"  # one half of the robots does not hear the other for a third of the run


@dataclass(slots=True)
class FleetRun:
    """All robots of one run. share: of N times the goals of one robot; None of that one robot.

    traffic: bytes a second that a robot publishes for the others, mean.
    """

    robots: list[RobotRecord]
    coordinated: bool
    traffic: float
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

    @property
    def is_good(self) -> bool:
        """Goals were reached, nothing was touched, and no robot stood on its way for MAX_STANDSTILL_S."""
        return self.n_reached > 0 and self.n_contacts == 0 and self.longest_standstill <= MAX_STANDSTILL_S


def fleet(
    robot: str,
    world: str,
    n: int,
    seconds: float,
    seed: int,
    out: Path | None,
    settings: list[str],
    coordination: Coordination = Coordination.BOTH,
    fault: FleetFault = FleetFault.NONE,
) -> int:
    """Runs one robot, then n with coordination and without it. 0 where the coordinated runs are good.

    Without a coordinated run all runs must be.
    """
    check_writable(out)
    kinds = [kind for kind in (True, False) if coordination in (Coordination.BOTH, _kind(kind))]
    planned = dict.fromkeys([(1, True, FleetFault.NONE), *((n, kind, fault) for kind in kinds)])
    runs: list[FleetRun] = []
    for count, coordinated, what in planned:
        run = drive(robot, world, count, seconds, seed, settings, coordinated, what)
        if runs and runs[0].n_reached:
            run.share = run.n_reached / (count * runs[0].n_reached)
        runs.append(run)
    title = f"{world}, {seconds:g} s of virtual time, seed {seed}" + (
        f", fault {fault}" if fault is not FleetFault.NONE else ""
    )
    show_table(title, COLUMNS, [_row(run) for run in runs])
    for run in runs:
        for record in run.robots:
            if record.killed_at is not None:
                sys.stdout.write(f"{record.name} was killed after {record.killed_at:.1f} s\n")
            if record.reasons:
                kind = _kind(run.coordinated)
                sys.stdout.write(f"{record.name} gave up (coordination {kind}): {json.dumps(record.reasons)}\n")
    plan = {"world": world, "seconds": seconds, "seed": seed, "fault": fault, "runs": [asdict(run) for run in runs]}
    write_report(out, plan)
    return 0 if all(run.is_good for run in runs if run.coordinated or not any(kinds)) else 1


def drive(
    robot: str,
    world: str,
    n: int,
    seconds: float,
    seed: int,
    settings: list[str],
    coordinated: bool = True,
    fault: FleetFault = FleetFault.NONE,
) -> FleetRun:
    """n robots drive to random goals for so many seconds of virtual time."""
    begun = process_time()
    names = [f"robot_{i + 1}" for i in range(n)]
    what = f"{n} robots" if n > 1 else "one robot"
    with RobotGroup(robot, world, names, seed, settings) as group, progress_bar(what) as progress:
        paths = PathFinder(group.world, group.members[0].scenario.file.robot)
        drivers = [
            FleetDriver(member, paths, np.random.default_rng([seed, i])) for i, member in enumerate(group.members)
        ]
        place(drivers, paths, group.run)  # robots side by side find themselves only where they hear each other
        if not coordinated:
            _deafen(group)
        begin = group.now
        spoken = _Spoken(group)
        while group.now < begin + seconds:
            group.run(LOOK_S)
            for driver in drivers:
                driver.step()
            share = (group.now - begin) / seconds
            _make_fault(fault, group, drivers, share)
            progress(share)
        rate = spoken.n_bytes / seconds / n
        records = [driver.record for driver in drivers]
        return FleetRun(records, coordinated, round(rate, 1), round(process_time() - begun, 1))


def _deafen(group: RobotGroup) -> None:
    """From now on the robots do not hear each other, and know of no other one."""
    group.hears = lambda speaker, listener: False
    for member in group.members:
        member.restart("traffic")
    group.run(HEARD_S)


def _make_fault(fault: FleetFault, group: RobotGroup, drivers: "list[FleetDriver]", share: float) -> None:
    """Lets a fault begin or end. share: of the run that is over."""
    lasts = FAULT_FROM <= share < FAULT_TO
    if fault is FleetFault.PARTITION:
        half = {member.name for member in group.members[::2]}
        group.hears = lambda speaker, listener: not lasts or (speaker in half) == (listener in half)
    elif fault is FleetFault.KILL_IN_DOOR and lasts and all(driver.record.killed_at is None for driver in drivers):
        in_door = next((driver for driver in drivers if driver.is_in_door), None)
        if in_door is not None:
            in_door.kill(group.now)


class _Spoken:
    """Counts the bytes that the robots publish for each other."""

    def __init__(self, group: RobotGroup) -> None:
        self.n_bytes = 0
        for member in group.members:
            member.lockstep.watch(topics.INTENT.key, self._count)

    def _count(self, intent: RobotIntent) -> None:
        self.n_bytes += len(encode(intent, Envelope("traffic", "traffic-1", 0, intent.stamp)))


class FleetDriver(RandomGoals):
    """Gives one robot one random goal after the other, until it is killed."""

    def __init__(self, member: GroupMember, paths: PathFinder, rng: np.random.Generator) -> None:
        super().__init__(member, paths, rng)
        self._member = member

    @property
    def is_in_door(self) -> bool:
        """Whether the robot drives in a narrow place."""
        service = self._member.lockstep.service("traffic")
        assert isinstance(service, TrafficService)
        here = service.reservation.widths[service.reservation.at :][:1]
        truth = self._member.truth
        return truth is not None and abs(truth.v) > MOVES_MPS and bool(((here > 0) & (here < DOOR_M)).any())

    def kill(self, now: float) -> None:
        """Ends all its services. now: s."""
        self._member.die()
        self.record.killed_at = round(now, 1)


def _kind(coordinated: bool) -> Coordination:
    return Coordination.ON if coordinated else Coordination.OFF


def _row(run: FleetRun) -> tuple[str, ...]:
    return (
        str(len(run.robots)),
        "-" if len(run.robots) == 1 else str(_kind(run.coordinated)),
        str(run.n_reached),
        "-" if run.share is None else f"{run.share:.0%}",
        str(sum(robot.n_failed for robot in run.robots)),
        str(run.n_contacts),
        f"{run.longest_standstill:.1f}",
        f"{sum(robot.distance for robot in run.robots):.0f}",
        f"{run.traffic / 1000:.1f}",
        f"{run.cpu_s:.0f}",
    )
