# SPDX-License-Identifier: Apache-2.0
"""`zenav bench barn`: the whole stack through the BARN challenge's cluttered worlds, by the challenge's rule."""

import csv
import statistics
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shared.config import UserError
from zenav.bench.process_pool import pool_results
from zenav.bench.seeds import seeds_from
from zenav.console.json_report import check_writable, write_report
from zenav.console.run_folder import new_run_folder
from zenav.console.table import show_table

if TYPE_CHECKING:
    from zenav.bench.barn_run import BarnFile
    from zenav.metrics.barn import BarnCourse

SUCCESS, COLLISIONS, SCORE = 0.995, 0.003, 0.4975
"""What all runs together must reach: shares of success, at least, and of collisions, at most; mean score, at least."""

FILE = "barn_worlds.json.gz"
TRAJECTORY = "t", "x", "y", "heading", "v", "w"
MAX_ROWS = 40  # of the table: runs that failed, else those that came nearest to something
COLUMNS = "world, seed", "", "time, s", "score", "clearance, m", "recoveries", "what was said at the end"

NOISE = (
    "sim.laser.sigma=0.02",
    "sim.laser.dropout=0.01",
    "sim.drive.size_error=0.05",
    "sim.drive.distance_error=0.05",
    "sim.drive.turn_slip=0.4728",
    "sim.drive.slip=0.05",
)
"""Settings of `--noise`, which the challenge does not have: see docs/benchmarks.md.

Skid steering acts as if its wheels were farther apart. Clearpath gives a Jackal's controller 1.5 times their distance
(jackal_control, `wheel_separation_multiplier`), and so does the robot `jackal`. That is a calibration on one floor.
distance_error: a Pioneer 3-AT had factors of 1.31 to 1.44 on six pairs of tyre and floor, 5 % about their middle
(Mandow et al. 2007).
turn_slip: the dependence of this factor on the path, as Wang et al. measured it (2015).
slip: the random rest of each wheel, 3.5 % of the speed, and 0.25 rad/s of turn rate at 2 m/s. A Jackal's motion on
grass differed from a calibrated model by 6 % of its speed and 19 % of its turn rate (Trivedi et al. 2024, table I).
"""
NOISE_DELAY = 0.05  # s
CROWDS = "0-49"
CROWDS_FITTED, CROWDS_UNSEEN = "0-99", "1000-1099"
"""Local control and mapper were changed by runs of 0 to 49; 50 to 99 were looked at. Unseen: for figures alone."""
CROWD_SUCCESS = 0.9  # share of the runs through crowds, at least


@dataclass(frozen=True, slots=True)
class BarnOptions:
    """What the command was asked for, as the processes that run it need it."""

    path: Path | None  # of the worlds; without it, crowds
    robot: str
    settings: tuple[str, ...]
    delay: float
    trajectories: Path | None
    failures: Path


def barn(
    worlds: Path | None, robot: str, runs: int, jobs: int, chosen: str, out: Path | None, trajectories: Path | None,
    noise: bool, crowd: bool, settings: list[str], cluster: str = "",
) -> int:  # fmt: skip
    """Runs every world `runs` times, shows the table, writes the JSON; 0 when all together reach what is asked.

    cluster: address of a Dask scheduler whose workers see the same folders; empty: `jobs` processes here.
    """
    from zenav.bench.barn_run import BarnTrial, barn_robot_file
    from zenav.console.progress import progress_bar

    path = barn_file_of(worlds, crowd)
    if path is None:
        names = [str(number) for number in seeds_from(chosen or CROWDS, "crowds")]
    else:
        names = worlds_from(chosen, tuple(worlds_of(path).worlds))
    check_writable(out)
    if trajectories is not None:
        create_folder(trajectories)
    changed = (*(NOISE if noise else ()), *settings)
    barn_robot_file(BarnTrial(course_at(path, names[0]), 0, robot, changed))  # a wrong setting is an error here
    options = BarnOptions(
        path=path.absolute() if path else None,
        robot=robot,
        settings=changed,
        delay=NOISE_DELAY if noise else 0.0,
        trajectories=trajectories.absolute() if trajectories else None,
        failures=new_run_folder("bench-barn").absolute(),
    )
    items = [(name, seed) for seed in range(runs) for name in names]
    results: list[dict[str, Any]] = []
    with progress_bar(f"{len(names)} worlds, {runs} runs each") as progress:
        for run in pool_results(partial(run_row, options), items, jobs, cluster):
            results.append(run)
            progress(len(results) / len(items))
            if run["status"] != "success" or not sys.stderr.isatty():  # where there is no bar
                left = run["picture"] or f"{run['time']:.1f} s, {run['clearance']:.3f} m"
                sys.stderr.write(f"world {run['world']}, seed {run['seed']}: {run['status']}, {left}\n")
    if not any(options.failures.iterdir()):
        options.failures.rmdir()
    results.sort(key=lambda run: (int(run["world"]), int(run["seed"])))
    figures = summary(results)
    failed = [run for run in results if run["status"] != "success"]
    listed = failed or sorted(results, key=lambda run: float(run["clearance"]))[:5]
    show_table(
        f"{'crowds' if crowd else 'BARN'}, {figures['runs']} runs", COLUMNS, [_row(run) for run in listed[:MAX_ROWS]]
    )
    show_table("all", tuple(figures), [tuple(str(value) for value in figures.values())])
    write_report(
        out, {"summary": figures, "robot": robot, "noise": noise, "crowd": crowd, "settings": settings, "runs": results}
    )
    return 0 if reaches_targets(figures, crowd) else 1


def reaches_targets(figures: dict[str, Any], crowd: bool) -> bool:
    """Whether all runs together reach what is asked."""
    if crowd:
        return bool(figures["success"] >= CROWD_SUCCESS)
    return bool(figures["success"] >= SUCCESS and figures["collision"] <= COLLISIONS and figures["score"] >= SCORE)


def barn_file_of(worlds: Path | None, crowd: bool) -> Path | None:
    """The file of worlds, None where crowds are asked for. Raises UserError where it is neither, or both."""
    if crowd and worlds is not None:
        raise UserError("--crowd makes its own worlds", f"leave {worlds} out, or --crowd")
    if not crowd and worlds is None:
        raise UserError("no worlds are named", f"give {FILE}, the folder that holds it, or --crowd")
    return worlds / FILE if worlds is not None and worlds.is_dir() else worlds


def course_at(path: Path | None, world: str) -> "BarnCourse":
    """The world of the file, or the crowd of this number."""
    from zenav.bench.barn_run import course_of, crowd_course

    return crowd_course(world) if path is None else course_of(path, worlds_of(path), world)


def worlds_of(path: Path) -> "BarnFile":
    """The worlds of a file. Raises UserError where there is none, or it is none of BARN's."""
    from services.sim.world_loader import read_cylinder_file
    from zenav.bench.barn_run import BarnFile

    if not path.is_file():
        raise UserError(f"there is no {path}", f"give {FILE}, or the folder that holds it")
    return read_cylinder_file(path, BarnFile)


def worlds_from(text: str, available: tuple[str, ...]) -> list[str]:
    """The file's worlds among `1-20` or `3,7`; all where nothing is chosen. Raises UserError where none is."""
    if not text:
        return sorted(available, key=int)
    numbers = {str(number) for number in seeds_from(text, "worlds")}
    names = sorted(numbers & set(available), key=int)
    if not names:
        raise UserError(
            f"none of the worlds {text} is in the file", f"it holds {len(available)}: {_examples(available)}"
        )
    return names


def _examples(available: tuple[str, ...]) -> str:
    return ", ".join(available[:8]) + (", ..." if len(available) > 8 else "")


def create_folder(folder: Path) -> None:
    """Makes the folder. Raises UserError where it cannot be written to."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / ".zenav").touch()
        (folder / ".zenav").unlink()
    except OSError as error:
        raise UserError(f"cannot write to {folder}: {error.strerror}", "choose another --trajectories") from None


def run_row(options: BarnOptions, item: tuple[str, int]) -> dict[str, Any]:
    """One run's row of the report; where it failed, again with a recording, and a picture."""
    import shared.repeatable  # noqa: F401  # a spawned process begins here
    from zenav.bench.barn_run import BarnTrial, run_barn
    from zenav.metrics.barn import N_DECIMALS_M
    from zenav.render.barn_picture import failure_picture

    world, seed = item
    trial = BarnTrial(course_at(options.path, world), seed, options.robot, options.settings, options.delay)
    done = run_barn(trial)
    name = f"world-{world}-seed-{seed}"
    row = {
        "world": int(world),
        "seed": seed,
        "status": done.status,
        "time": done.time,
        "score": round(done.score, 5),
        "clearance": round(done.clearance, N_DECIMALS_M),
        "recoveries": done.n_recoveries,
        "length": done.length,
        "said": done.why,
        "stood": done.stood,
        "trajectory": None,
        "picture": None,
        "recording": None,
    }
    if options.trajectories is not None:
        row["trajectory"] = f"{name}.csv"
        write_trajectory(options.trajectories / f"{name}.csv", done.rows.tolist())
    if done.status != "success":
        picture, recording = options.failures / f"{name}.png", options.failures / f"{name}.mcap"
        picture.write_bytes(failure_picture(done))
        run_barn(trial, recording)  # the same seed gives the same run: only failures are worth a file
        row |= {"picture": str(picture), "recording": str(recording)}
    return row


def write_trajectory(path: Path, rows: list[list[float]]) -> None:
    """The true motion as CSV: s, m, rad, m/s, rad/s."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(TRAJECTORY)
        writer.writerows([f"{t:.3f}", *(f"{value:.5f}" for value in rest)] for t, *rest in rows)


def summary(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures over all runs; the score is the mean over worlds of the mean over runs."""
    n = len(runs)
    by_world: dict[int, list[float]] = {}
    for run in runs:
        by_world.setdefault(run["world"], []).append(run["score"])
    times = [run["time"] for run in runs if run["status"] == "success"]
    shares = {
        status: round(sum(run["status"] == status for run in runs) / n, 5)
        for status in ("success", "collision", "timeout")
    }
    return {
        **shares,
        "mean_time": round(statistics.fmean(times), 3) if times else None,
        "score": round(statistics.fmean(statistics.fmean(scores) for scores in by_world.values()), 5),
        "collision_standing": round(sum(run["stood"] for run in runs) / n, 5),
        "runs": n,
        "worlds": len(by_world),
        "clearance_min": min(run["clearance"] for run in runs),
        "recoveries": sum(run["recoveries"] for run in runs),
    }


def _row(run: dict[str, Any]) -> tuple[str, ...]:
    return (
        f"{run['world']}, {run['seed']}", run["status"], f"{run['time']:.1f}", f"{run['score']:.4f}",
        f"{run['clearance']:.3f}", str(run["recoveries"]), run["said"],
    )  # fmt: skip
