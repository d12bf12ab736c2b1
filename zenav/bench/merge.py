# SPDX-License-Identifier: Apache-2.0
"""`zenav bench merge`: maps of two parts of a building are joined, and maps of two buildings or floors are refused.

Each pair is mapped in two runs from different starts, with other people, noise and loose things. Errors are those
against the simulator's truth, after the rigid fit of the first map's keyframes to their true poses.
"""

import statistics
import sys
from dataclasses import asdict, dataclass
from functools import partial
from itertools import product
from pathlib import Path
from time import process_time
from typing import TYPE_CHECKING, Any

import numpy as np

from shared.config import UserError, configured
from shared.geometry import Pose2
from shared.types import Float64s
from zenav.bench.process_pool import pool_results
from zenav.bench.seeds import seeds_from
from zenav.console.json_report import check_writable, write_report
from zenav.console.run_folder import new_run_folder
from zenav.console.table import show_table

if TYPE_CHECKING:
    from services.mapper.maps.map_file import SavedMap
    from services.sim.world import World
    from zenav.bench.building_parts import MappedPart

MAX_JOINT_M = 0.1  # mean error of the second map's keyframes in the first one's frame: more is wrongly joined
COMMON_M = 1.0  # between a keyframe of the second map and one of the first, that are of common ground
COLUMNS = (
    "maps", "rooms in both, %", "common, %", "outcome", "places", "closures", "joint, cm", "max",
    "walls in 5 cm, %: first", "second", "merged", "CPU, s",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class MergeCase:
    """Two worlds, `building:N` or a floor of it; shares of rooms in both parts, where they are one building."""

    first: str
    second: str
    rooms_in_both: float

    @property
    def same(self) -> bool:
        """Whether the maps are of one building."""
        return self.first == self.second


@dataclass(slots=True)
class MergeTrial:
    """What became of a case.

    common: share of the second map's keyframes on ground that the first has.  refused: the reason, empty if joined.
    joint_*: m, errors of the second map's keyframes.  walls_*: shares of occupied cells within 5 cm of a true surface.
    """

    first: str
    second: str
    rooms_in_both: float
    common: float = 0.0
    refused: str = ""
    places: str = ""
    closures: int = 0
    joint_mean_m: float | None = None
    joint_max_m: float | None = None
    walls_first: float | None = None
    walls_second: float | None = None
    walls_merged: float | None = None
    cpu_s: float = 0.0

    @property
    def wrongly_joined(self) -> bool:
        """Whether maps of different buildings are joined, or those of one building at a wrong place."""
        if self.refused:
            return False
        return self.first != self.second or self.joint_mean_m is None or self.joint_mean_m > MAX_JOINT_M


def merge(
    robot: str,
    numbers: str,
    overlaps: str,
    strangers: int,
    jobs: int,
    maps: Path | None,
    out: Path | None,
    settings: list[str],
) -> int:
    """Joins the parts of every building; 0 when nothing was wrongly joined, and all parts of one building were joined.

    overlaps: percent of the rooms that are in both parts, separated by commas.  strangers: other buildings that each
    one is tried against; beside them is another floor of itself.  maps: folder of an earlier run.
    """
    chosen = seeds_from(numbers, "buildings")
    cases = cases_of(chosen, seeds_from(overlaps, "percentages"), strangers)
    check_writable(out)
    folder = new_run_folder("bench-merge") if maps is None else maps
    trials: list[MergeTrial] = []
    for trial in pool_results(partial(run_case, robot, folder, settings), cases, jobs):
        trials.append(trial)
        sys.stderr.write(f"{trial.first} and {trial.second}: {trial.refused or 'joined'}\n")
    trials.sort(key=lambda trial: (trial.first != trial.second, trial.first, trial.second, -trial.rooms_in_both))
    show_table(f"maps in {folder}", COLUMNS, [table_row(trial) for trial in trials])
    figures = summary(trials)
    sys.stdout.write(
        f"joined {figures['joined']} of {figures['pairs']} pairs of one building, wrongly joined "
        f"{figures['wrongly_joined']} of all {len(trials)}\n"
    )
    write_report(out, {"summary": figures, "trials": [asdict(trial) for trial in trials]})
    return 0 if not figures["wrongly_joined"] and figures["joined"] == figures["pairs"] else 1


def cases_of(buildings: list[int], percentages: list[int], strangers: int) -> list[MergeCase]:
    """Returns all cases: each building with itself by each overlap, with another floor, and with other buildings."""
    cases = [MergeCase(f"building:{n}", f"building:{n}", p / 100) for n, p in product(buildings, percentages)]
    if strangers:
        cases += [MergeCase(f"building:{n}", f"building:{n}/1", percentages[0] / 100) for n in buildings]
    for i, n in enumerate(buildings):
        for k in range(1, min(strangers, len(buildings) - 1) + 1):
            other = buildings[(i + k) % len(buildings)]
            cases.append(MergeCase(f"building:{n}", f"building:{other}", percentages[0] / 100))
    return cases


def summary(trials: list[MergeTrial]) -> dict[str, Any]:
    """Counts over all cases, and means over those of one building that were joined."""
    pairs = [trial for trial in trials if trial.first == trial.second]
    joined = [trial for trial in pairs if not trial.refused]

    def mean(name: str) -> float | None:
        values = [getattr(trial, name) for trial in joined if getattr(trial, name) is not None]
        return round(statistics.fmean(values), 4) if values else None

    return {
        "pairs": len(pairs),
        "joined": len(joined),
        "strangers": len(trials) - len(pairs),
        "wrongly_joined": sum(trial.wrongly_joined for trial in trials),
        **{name: mean(name) for name in ("joint_mean_m", "walls_first", "walls_second", "walls_merged", "cpu_s")},
    }


def table_row(trial: MergeTrial) -> tuple[str, ...]:
    """A trial's line of the table."""

    def number(value: float | None, scale: float, digits: int) -> str:
        return "-" if value is None else f"{value * scale:.{digits}f}"

    names = trial.first if trial.first == trial.second else f"{trial.first}, {trial.second}"
    outcome = "WRONGLY JOINED" if trial.wrongly_joined else trial.refused or "joined"
    return (
        names, f"{trial.rooms_in_both:.0%}".rstrip("%"), number(trial.common, 100, 0), outcome, trial.places,
        str(trial.closures), number(trial.joint_mean_m, 100, 1), number(trial.joint_max_m, 100, 1),
        number(trial.walls_first, 100, 1), number(trial.walls_second, 100, 1), number(trial.walls_merged, 100, 1),
        f"{trial.cpu_s:.0f}",
    )  # fmt: skip


def run_case(robot: str, folder: Path, settings: list[str], case: MergeCase) -> MergeTrial:
    """Maps both parts, unless the folder has them, and joins them."""
    import shared.repeatable  # noqa: F401  # a spawned process begins here
    from services.mapper.config import MapperConfig
    from services.mapper.maps.map_merging import merge_maps
    from zenav.bench.building_parts import BuildingPart, mapped_part
    from zenav.maps.saved_map import write_saved_map

    half, number = case.rooms_in_both / 2, int(case.first.partition(":")[2])
    first = mapped_part(robot, BuildingPart(case.first, 0.0, 0.5 + half, 100 + number), folder, settings)
    other = int(case.second.partition(":")[2].partition("/")[0])
    second = mapped_part(robot, BuildingPart(case.second, 0.5 - half, 1.0, 200 + other), folder, settings)
    trial = MergeTrial(case.first, case.second, case.rooms_in_both)
    if case.same:
        trial.common = round(common_share(first.truth, second.truth), 3)
    file = configured(robot, settings)
    range_max = max(laser.range_max for laser in file.robot.mapping_lasers)
    begun = process_time()
    try:
        result = merge_maps(first.saved, second.saved, file.section("mapper", MapperConfig), range_max)
    except UserError as error:
        trial.refused, trial.cpu_s = error.what, round(process_time() - begun, 1)
        return trial
    trial.cpu_s = round(process_time() - begun, 1)
    overlap = result.overlap
    trial.places, trial.closures = f"{len(overlap.matching)} of {len(overlap.judged)}", result.n_closures
    if case.same:
        _score(trial, first, second, result.saved)
    name = f"merged-{case.first}-{case.second}-{round(100 * case.rooms_in_both)}"
    write_saved_map(folder / name.replace(":", "-").replace("/", "-floor-"), result.saved)
    return trial


def _score(trial: MergeTrial, first: "MappedPart", second: "MappedPart", merged: "SavedMap") -> None:
    """Fills in the errors against the truth."""
    n = len(first.truth)
    world_from_merged = fitted(merged.graph.poses[:n], first.truth)
    apart = world_from_merged @ merged.graph.poses[n:, :2] - second.truth[:, :2]
    errors = np.hypot(apart[:, 0], apart[:, 1])
    trial.joint_mean_m, trial.joint_max_m = round(float(errors.mean()), 4), round(float(errors.max()), 4)
    for name, saved, truth, worlds, world_from_map in (
        ("walls_first", first.saved, first.truth, [first.world], None),
        ("walls_second", second.saved, second.truth, [second.world], None),
        ("walls_merged", merged, first.truth, [first.world, second.world], world_from_merged),
    ):
        pose = fitted(saved.graph.poses[: len(truth)], truth) if world_from_map is None else world_from_map
        setattr(trial, name, round(wall_share(saved, worlds, pose), 4))


def fitted(poses: Float64s, truth: Float64s) -> Pose2:
    """Returns the rigid world_from_map that brings poses (n, 3) onto the truth (n, 3), by their positions.

    Least squares in closed form: Umeyama, PAMI 1991, without scale.
    """
    a, b = poses[:, :2] - poses[:, :2].mean(axis=0), truth[:, :2] - truth[:, :2].mean(axis=0)
    yaw = float(np.arctan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum()))
    x, y = (truth[:, :2] - Pose2(0.0, 0.0, yaw) @ poses[:, :2]).mean(axis=0).tolist()
    return Pose2(x, y, yaw)


def wall_share(saved: "SavedMap", worlds: list["World"], world_from_map: Pose2) -> float:
    """Returns the share of a map's occupied cells within 5 cm of a true surface of one of the worlds."""
    from zenav.maps.map_files import grid_from_update
    from zenav.metrics.evaluation import MAX_WALL_ERROR_M, map_errors

    grid = grid_from_update(saved.tiles)
    errors = np.min([map_errors(grid, world, world_from_map) for world in worlds], axis=0)
    return float((errors <= MAX_WALL_ERROR_M).mean()) if len(errors) else 0.0


def common_share(first: Float64s, second: Float64s) -> float:
    """Returns the share of the second map's keyframes within COMMON_M of one of the first.  (n, 3) m, m, rad each."""
    apart = np.hypot(*np.moveaxis(second[:, None, :2] - first[None, :, :2], -1, 0)).min(axis=1)
    return float((apart <= COMMON_M).mean())
