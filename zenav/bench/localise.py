# SPDX-License-Identifier: Apache-2.0
"""`zenav bench localise`: global localisation and the kidnapped robot on saved maps of generated buildings.

The building is the map's, except for loose objects and walking people. The robot starts at a random pose and drives
from one random place to the next. A pose is "right" where it is within RIGHT of the truth and stays within it.
"""

import statistics
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import partial
from math import degrees, hypot, inf
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Any

import numpy as np

from shared.geometry import Pose2, wrapped
from shared.messages import Localization, PoseEstimate
from zenav.bench.process_pool import pool_results
from zenav.bench.seeds import seeds_from
from zenav.console.json_report import check_writable, write_report
from zenav.console.run_folder import new_run_folder
from zenav.console.table import show_table

if TYPE_CHECKING:
    from services.mapper.maps.map_file import SavedMap
    from zenav.bench.sim_slam_harness import SimSlamHarness

RIGHT, RIGHT_DEG = 0.3, 5.0  # m, degrees
FOUND_WITHIN, FOUND_SHARE = 10.0, 0.95  # m of driving; of the poses
NOTICED_WITHIN = 3.0  # s
GIVES_UP = 25.0  # m of driving
AFTERWARDS = 3.0  # m that are driven on, found, to see whether it stays right
STANDS = 1.0  # s before and after being carried
AWAY = 3.0  # m that it is carried at least
COLUMNS = (
    "building", "poses", "found in 10 m", "median, m", "p95", "wrongly sure", "carried", "noticed in 3 s", "median, s",
    "back in 10 m", "median, m", "CPU, s",
)  # fmt: skip


@dataclass
class LocalizationTrial:
    """One random pose. Metres of driving until found and right, s until noticed; None: never.

    wrong_s: s for which it called a wrong pose good, but for those until it noticed that it was carried.
    """

    building: int = 0
    trial: int = 0
    found_m: float | None = None
    found_error_m: float | None = None
    wrong_s: float = 0.0
    noticed_s: float | None = None
    back_m: float | None = None
    carried: bool = False
    cpu_s: float = 0.0


def localise(
    robot: str,
    numbers: str,
    poses: int,
    jobs: int,
    maps: Path | None,
    out: Path | None,
    settings: list[str],
    cell: float = 0.0,
) -> int:
    """Runs `poses` trials, shared among the buildings; 0 when every promise was kept.

    maps: the folder of an earlier `zenav bench buildings` or `localise`; without it, every building is toured first.
    cell: m; the maps are first written for ROS map_server, with cells so large, and read from that alone. 0: they are
    the stack's own.
    """
    chosen = seeds_from(numbers)
    check_writable(out)
    folder = new_run_folder("bench-localise") if maps is None else maps
    shares = {number: poses // len(chosen) + (i < poses % len(chosen)) for i, number in enumerate(chosen)}
    trials: list[LocalizationTrial] = []
    for building_trials in pool_results(
        partial(_building_trials, robot, folder, shares, settings, cell), [n for n in chosen if shares[n]], jobs
    ):
        trials += building_trials
        sys.stderr.write(
            f"building {building_trials[0].building}: {sum(t.found_m is not None for t in building_trials)} found\n"
        )
    trials.sort(key=lambda trial: (trial.building, trial.trial))
    rows = [_row(str(n), [t for t in trials if t.building == n]) for n in chosen if shares[n]]
    kind = f", as pgm and yaml of {cell:g} m a cell" if cell else ""
    show_table(f"global localisation, maps in {folder}{kind}", COLUMNS, [*rows, _row("all", trials)])
    figures = summary(trials)
    write_report(out, {"summary": figures, "trials": [asdict(trial) for trial in trials]})
    return 0 if reaches_targets(figures) else 1


def reaches_targets(figures: dict[str, Any]) -> bool:
    """Whether the summary keeps every promise."""
    return bool(
        figures["found_share"] >= FOUND_SHARE
        and not figures["wrongly_sure"]
        and figures["noticed"] == figures["back"] == figures["carried"]
    )


def summary(trials: list[LocalizationTrial]) -> dict[str, Any]:
    """Shares, medians and counts over all trials."""
    found_m = [t.found_m for t in trials if t.found_m is not None]
    carried = [t for t in trials if t.carried]
    noticed = [t.noticed_s for t in carried if t.noticed_s is not None]
    back = [t.back_m for t in carried if t.back_m is not None]
    return {
        "poses": len(trials),
        "found_share": round(sum(m <= FOUND_WITHIN for m in found_m) / max(len(trials), 1), 4),
        "found_m_median": _median(found_m),
        "found_m_p95": round(float(np.percentile(found_m, 95)), 2) if found_m else None,
        "wrongly_sure": sum(t.wrong_s > 0 for t in trials),
        "carried": len(carried),
        "noticed": sum(s <= NOTICED_WITHIN for s in noticed),
        "noticed_s_median": _median(noticed),
        "back": sum(m <= FOUND_WITHIN for m in back),
        "back_m_median": _median(back),
        "cpu_s": round(sum(t.cpu_s for t in trials), 1),
    }


def _median(values: list[float]) -> float | None:
    return round(statistics.median(values), 2) if values else None


def _row(name: str, trials: list[LocalizationTrial]) -> tuple[str, ...]:
    s = summary(trials)

    def number(key: str) -> str:
        return "-" if s[key] is None else f"{s[key]:.1f}"

    return (
        name, str(s["poses"]), f"{s['found_share']:.0%}", number("found_m_median"), number("found_m_p95"),
        str(s["wrongly_sure"]), str(s["carried"]), str(s["noticed"]), number("noticed_s_median"), str(s["back"]),
        number("back_m_median"), number("cpu_s"),
    )  # fmt: skip


def _building_trials(
    robot: str, folder: Path, shares: dict[int, int], settings: list[str], cell: float, number: int
) -> list[LocalizationTrial]:
    """All trials of one building."""
    import shared.repeatable  # noqa: F401  # a spawned process begins here
    from zenav.bench.buildings import tour_building
    from zenav.maps.saved_map import GRAPH, read_saved_map

    place = folder / f"building-{number}"
    if not (place / GRAPH).exists():
        tour_building(robot, folder, settings, number)
    saved = read_saved_map(place)
    if cell:
        saved = ros_copy_of(saved, cell, folder / f"building-{number}-ros-{round(100 * cell)}cm")
    return [
        replace(
            run_trial(robot, f"building:{number}", 1000 * (i + 1) + number, saved, settings), building=number, trial=i
        )
        for i in range(shares[number])
    ]


def ros_copy_of(saved: "SavedMap", cell: float, folder: Path) -> "SavedMap":
    """A map as another program's: written for ROS map_server with cells of `cell` m into a folder, and read from there.

    A larger cell is as occupied as the most occupied in it.
    """
    from shared.ros_map import write_ros_map
    from zenav.maps.foreign_map import read_map
    from zenav.maps.map_files import coarse_cells, grid_from_update

    grid = grid_from_update(saved.tiles)
    step = round(cell / grid.resolution)
    write_ros_map(folder, coarse_cells(grid.cells, step), step * grid.resolution, grid.x0, grid.y0)
    return read_map(folder, grid.resolution)


def run_trial(robot: str, world_name: str, seed: int, saved: "SavedMap", settings: list[str]) -> LocalizationTrial:
    """Found from nowhere in a world with a saved map, then carried elsewhere and found again; all by the seed."""
    from zenav.bench.sim_slam_harness import SimSlamHarness, harness_robot_file
    from zenav.scenario.path_finder import PathFinder
    from zenav.stack.hardware import simulated_world

    begun, trial = process_time(), LocalizationTrial()
    file = harness_robot_file(robot, world_name, seed, None, settings)
    world, rng = simulated_world(file), np.random.default_rng(seed)
    paths = PathFinder(world, file.robot)
    harness = SimSlamHarness(
        harness_robot_file(robot, world_name, seed, paths.random_pose(rng), settings), paths, saved
    )
    watch = PoseMonitor(harness, world.start)
    trial.found_m = watch.driven_until_right(rng)
    if trial.found_m is not None:
        trial.found_error_m = round(watch.error[0], 3)
        trial.carried = True
        trial.noticed_s, trial.back_m = _kidnap(harness, watch, rng)
    trial.wrong_s = round(watch.wrong_s, 2)
    trial.cpu_s = round(process_time() - begun, 1)
    return trial


def _kidnap(
    harness: "SimSlamHarness", watch: "PoseMonitor", rng: np.random.Generator
) -> tuple[float | None, float | None]:
    """Sets the robot down elsewhere: s until it noticed, m until it was right again."""
    harness.stand(STANDS)
    here = harness.truth.world_from_base
    while (there := harness.paths.random_pose(rng)).distance(here) < AWAY or not harness.free_of_people(there, 1.0):
        pass
    harness.carry(there)
    watch.on_kidnapped()
    harness.stand(STANDS)
    back = watch.driven_until_right(rng)
    return watch.noticed_s, back


class PoseMonitor:
    """Compares each of the mapper's poses with the truth. error: m and degrees, of the last one."""

    def __init__(self, harness: "SimSlamHarness", world_from_map: Pose2) -> None:
        self.harness, self.world_from_map = harness, world_from_map
        self.error = inf, inf
        self.sure = False  # it calls its pose good
        self.wrong_s = 0.0
        self.noticed_s: float | None = None
        self._carried: int | None = None  # ns, when it was; until that was noticed
        self.last = 0
        harness.watch(self.add)

    @property
    def right(self) -> bool:
        """Whether the last pose was called good, and is."""
        return self.sure and self._carried is None and self.error[0] <= RIGHT and self.error[1] <= RIGHT_DEG

    def on_kidnapped(self) -> None:
        """The robot stands elsewhere from now on."""
        self._carried, self.noticed_s = self.harness.lockstep.now, None

    def driven_until_right(self, rng: np.random.Generator) -> float | None:
        """Drives from one random place to the next until the pose is right, and then a little further; m until then.

        None where it never was.
        """
        begun = self.harness.truth.distance

        def driven() -> float:
            return self.harness.truth.distance - begun

        self._drive(rng, lambda: self.right or driven() > GIVES_UP)
        if not self.right:
            return None
        driven_m, error = driven(), self.error
        self._drive(rng, lambda: driven() > driven_m + AFTERWARDS)
        self.error = error
        return round(driven_m, 2)

    def _drive(self, rng: np.random.Generator, until: Callable[[], bool]) -> None:
        from zenav.bench.sim_slam_harness import DriveResult

        while not until():
            if self.harness.drive(self.harness.paths.random_pose(rng), until) is DriveResult.NO_PATH:
                self.harness.stand(1.0)  # somebody is all around

    def add(self, estimate: PoseEstimate) -> None:
        """One of the mapper's poses."""
        truths = self.harness.track.truths[-100:]
        at = np.array([row[0] - estimate.stamp for row in truths], float)
        x, y, yaw = np.array([row[1:] for row in truths]).T
        true = Pose2(*(float(np.interp(0.0, at, column)) for column in (x, y, np.unwrap(yaw))))
        left = true.inverse() @ self.world_from_map @ estimate.map_from_base
        self.error = hypot(left.x, left.y), abs(degrees(wrapped(left.yaw)))
        self.sure = estimate.state is Localization.GOOD
        if self._carried is not None:
            if estimate.state in (Localization.LOST, Localization.STARTING):
                self.noticed_s, self._carried = round((self.harness.lockstep.now - self._carried) * 1e-9, 2), None
        elif self.sure and not self.right and self.last:
            self.wrong_s += (estimate.stamp - self.last) * 1e-9
        self.last = estimate.stamp
