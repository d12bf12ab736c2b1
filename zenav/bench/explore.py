# SPDX-License-Identifier: Apache-2.0
"""`zenav bench explore`: one robot and several explore the same world; times, contacts, and the joined map.

The whole stacks run in lockstep. Robots begin side by side at the world's start, each with a map of its own, and know
where their maps begin in the world. At the end their maps are joined as `zenav map merge` does.
"""

import statistics
import sys
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Any

from shared.config import UserError
from shared.messages import NavState
from shared.task_state import FINAL_STATES
from zenav.bench.process_pool import pool_results
from zenav.bench.seeds import seeds_from
from zenav.console.json_report import check_writable, write_report
from zenav.console.run_folder import new_run_folder
from zenav.console.table import show_table

if TYPE_CHECKING:
    from services.mapper.maps.map_file import SavedMap
    from zenav.scenario.robot_group import RobotGroup

MAX_SHARE = 0.6  # of one robot's time that two may need
MAX_ROBOTS = 20
LOOK_S = 0.5  # s between two looks at the robots
SETTLES_S = 2.0  # s until a stack has its first map and pose
COLUMNS = (
    "robots", "seed", "explored after, s", "of one's time", "ended", "contacts", "driven, m", "floor, %",
    "complete, %", "walls in 5 cm, %", "joined", "CPU, s",
)  # fmt: skip


@dataclass(slots=True)
class ExploreRun:
    """One run.  seconds: until the last robot has ended, or the limit.  states: how each ended.

    floor: share of the reachable floor that the joined map knows.  refused: why the maps were not joined, if so; the
    figures are then the first map's.
    """

    robots: int
    seed: int
    seconds: float
    states: list[str]
    contacts: int
    distance: float
    floor: float
    completeness: float
    within_5_cm: float
    refused: str
    cpu_s: float


def explore(
    robot: str, world: str, robots: str, seeds: str, seconds: float, jobs: int, out: Path | None, settings: list[str]
) -> int:
    """Explores with each number of robots; 0 when all have explored, nothing was touched, and two were fast enough."""
    numbers, chosen = seeds_from(robots, "numbers of robots"), seeds_from(seeds)
    if not all(1 <= number <= MAX_ROBOTS for number in numbers):
        raise UserError(f"--robots {robots}: numbers of robots go from 1 to {MAX_ROBOTS}", "write --robots 1,2")
    check_writable(out)
    folder = new_run_folder("bench-explore")
    runs: list[ExploreRun] = []
    work = partial(run_one, robot, world, seconds, folder, settings)
    for run in pool_results(work, list(product(numbers, chosen)), jobs):
        runs.append(run)
        sys.stderr.write(f"{run.robots} robots, seed {run.seed}: {run.seconds:.0f} s, {', '.join(run.states)}\n")
    runs.sort(key=lambda run: (run.robots, run.seed))
    show_table(f"{world}, maps in {folder}", COLUMNS, [_row(run, share_of_one(run, runs)) for run in runs])
    shares = mean_shares(runs)
    for n, share in shares.items():
        sys.stdout.write(f"{n} robots need {share:.0%} of one's time\n")
    write_report(out, {"world": world, "shares": shares, "runs": [asdict(run) for run in runs]})
    good = all(run.contacts == 0 and set(run.states) == {NavState.REACHED} for run in runs)
    return 0 if good and shares.get(2, 0.0) <= MAX_SHARE else 1


def share_of_one(run: ExploreRun, runs: list[ExploreRun]) -> float | None:
    """Returns the time of a run as a share of that of one robot with the same seed; None without such a run."""
    one = next((other.seconds for other in runs if other.robots == 1 and other.seed == run.seed), None)
    return None if one is None or run.robots == 1 else run.seconds / one


def mean_shares(runs: list[ExploreRun]) -> dict[int, float]:
    """Returns the mean share of one robot's time by the number of robots."""
    shares: dict[int, list[float]] = {}
    for run in runs:
        if (share := share_of_one(run, runs)) is not None:
            shares.setdefault(run.robots, []).append(share)
    return {n: round(statistics.fmean(values), 3) for n, values in shares.items()}


def run_one(
    robot: str, world: str, seconds: float, folder: Path, settings: list[str], case: tuple[int, int]
) -> ExploreRun:
    """Explores with so many robots by a seed."""
    import shared.repeatable  # noqa: F401  # a spawned process begins here
    from shared import requests
    from shared.requests import Explore
    from zenav.scenario.robot_group import RobotGroup

    n, seed = case
    begun = process_time()
    names = [f"robot_{i + 1}" for i in range(n)]
    with RobotGroup(robot, world, names, seed, settings) as group:
        group.run(SETTLES_S)
        for member in group.members:
            others = tuple(name for name in names if name != member.name)
            request = Explore(member.lockstep.now, others, member.scenario.world.start)
            reply = member.lockstep.ask(requests.EXPLORE, request)
            if not reply.accepted:
                raise UserError(f"{member.name} does not explore: {reply.detail}", "see the reason")
        start = group.now
        group.run(LOOK_S)
        while group.now - start < seconds and any(explores(member.nav) for member in group.members):
            group.run(LOOK_S)
        taken = group.now - start
        merged, refused = _joined(group, robot, settings)
        return _scored(group, n, seed, taken, merged, refused, folder, process_time() - begun)


def explores(nav: Any) -> bool:
    """Whether the task goes on, in a recovery too."""
    return nav is not None and nav.state not in FINAL_STATES


def _joined(group: "RobotGroup", robot: str, settings: list[str]) -> tuple["SavedMap", str]:
    """Returns the map of all robots, or that of the first one and why the others were not joined to it."""
    from services.mapper.config import MapperConfig
    from services.mapper.maps.map_merging import merge_maps
    from services.mapper.service import MapperService
    from shared.config import configured

    maps = []
    for member in group.members:
        mapper = member.lockstep.service("mapper")
        assert isinstance(mapper, MapperService)
        maps.append(mapper.slam.snapshot())
    file = configured(robot, settings)
    range_max = max(laser.range_max for laser in file.robot.mapping_lasers)
    merged = maps[0]
    for saved in maps[1:]:
        try:
            merged = merge_maps(merged, saved, file.section("mapper", MapperConfig), range_max).saved
        except UserError as error:
            return merged, error.what
    return merged, ""


def _scored(
    group: "RobotGroup", n: int, seed: int, taken: float, merged: "SavedMap", refused: str, folder: Path, cpu: float
) -> ExploreRun:
    """Returns the figures of a run, and writes its map."""
    import numpy as np

    from zenav.maps.map_files import grid_from_update
    from zenav.maps.saved_map import write_saved_map
    from zenav.metrics.evaluation import MAX_WALL_ERROR_M, completeness, explored_share, map_errors

    write_saved_map(folder / f"robots-{n}-seed-{seed}", merged)
    first = group.members[0].scenario
    grid, world, start = grid_from_update(merged.tiles), first.world, first.world.start
    errors = map_errors(grid, world, start)
    truths = [member.truth for member in group.members if member.truth is not None]
    return ExploreRun(
        robots=n,
        seed=seed,
        seconds=round(taken, 1),
        states=[str(member.nav.state) if member.nav is not None else "silent" for member in group.members],
        contacts=sum(truth.n_contacts for truth in truths),
        distance=round(sum(truth.distance for truth in truths), 1),
        floor=round(explored_share(grid, world, start, first.radius), 4),
        completeness=round(completeness(grid, world, start, first.radius, first.file.robot.laser.range_max), 4),
        within_5_cm=round(float(np.mean(errors <= MAX_WALL_ERROR_M)), 4),
        refused=refused,
        cpu_s=round(cpu, 1),
    )


def _row(run: ExploreRun, share: float | None) -> tuple[str, ...]:
    joined = "-" if run.robots == 1 else run.refused or "yes"
    return (
        str(run.robots), str(run.seed), f"{run.seconds:.0f}", "-" if share is None else f"{share:.0%}",
        ", ".join(run.states), str(run.contacts), f"{run.distance:.0f}", f"{100 * run.floor:.1f}",
        f"{100 * run.completeness:.1f}", f"{100 * run.within_5_cm:.1f}", joined, f"{run.cpu_s:.0f}",
    )  # fmt: skip
