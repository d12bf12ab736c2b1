# SPDX-License-Identifier: Apache-2.0
"""`zenav bench office`: explore and drive to goals, once a seed, on the virtual clock or live over Zenoh."""

import statistics
import sys
from functools import partial
from pathlib import Path
from typing import Any

from zenav.bench.process_pool import pool_results
from zenav.bench.seeds import seeds_from
from zenav.console.json_report import check_writable, write_report
from zenav.console.shutdown import stop_on_signal
from zenav.console.table import show_table
from zenav.metrics.stability import FIGURES, figure_rows
from zenav.scenario.scenario import load_scenario

POSE_M, POSE_DEG, EXPLORED = 0.05, 1.0, 0.98
"""What each run must keep: mean pose error in m and degrees; share of the reachable floor that is explored."""


def office(
    robot: str, world: str, seeds: str, jobs: int, out: Path | None, live: bool, seconds: float, settings: list[str]
) -> int:
    """Runs every seed, shows the table, writes the JSON; 0 when every run kept every promise."""
    numbers = seeds_from(seeds)
    check_writable(out)
    run_one = partial(_live if live else _lockstep, robot, world, seconds=seconds, settings=settings)
    runs: list[dict[str, Any]] = []
    for report in pool_results(run_one, numbers, 1 if live else jobs):
        runs.append(report)
        s = report["summary"]
        verdict = "good" if reaches_targets(report) else f"not good {report['trouble']}"
        sys.stderr.write(
            f"seed {report['seed']}: {verdict}, {s['seconds']:.0f} s driven in {s['wall_seconds']:.0f} s\n"
        )
    runs.sort(key=lambda report: int(report["seed"]))
    show_table(f"{world}, {'live' if live else 'lockstep'}", COLUMNS, [_row(report) for report in runs])
    show_table("while a task was under way", ("seed", *FIGURES.values()), [_steady_row(report) for report in runs])
    write_report(out, {"summary": summary(runs), "live": live, "runs": runs})
    return 0 if len(runs) == len(numbers) and all(reaches_targets(report) for report in runs) else 1


def reaches_targets(report: dict[str, Any]) -> bool:
    """Whether a run kept every promise."""
    s = report["summary"]
    return bool(
        s["good"]
        and s["explored_share"] >= EXPLORED
        and s["pose_error_mean_m"] is not None
        and s["pose_error_mean_m"] < POSE_M
        and s["pose_error_mean_deg"] < POSE_DEG
    )


def summary(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures over all runs: the worst of what is promised, the mean of the rest."""
    summaries = [report["summary"] for report in runs]

    def of(key: str) -> list[float]:
        return [row[key] for row in summaries if row[key] is not None]

    return {
        "runs": len(runs),
        "good": sum(reaches_targets(report) for report in runs),
        "collisions": sum(of("collisions")),
        "goals_reached": sum(of("goals_reached")),
        "goals": sum(of("goals")),
        "explored_share_min": min(of("explored_share"), default=None),
        "pose_error_mean_m_worst": max(of("pose_error_mean_m"), default=None),
        "pose_error_mean_deg_worst": max(of("pose_error_mean_deg"), default=None),
        "pose_error_max_m_worst": max(of("pose_error_max_m"), default=None),
        "map_within_5_cm_min": min(of("map_within_5_cm"), default=None),
        "map_completeness_min": min(of("map_completeness"), default=None),
        "seconds_mean": round(statistics.fmean(of("seconds")), 1) if summaries else None,
        "distance_m_mean": round(statistics.fmean(of("distance_m")), 1) if summaries else None,
        **{f"{key}_mean": _mean(of(key)) for key in FIGURES},
        "wall_seconds_mean": round(statistics.fmean(of("wall_seconds")), 1) if summaries else None,
    }


COLUMNS = (
    "seed", "goals", "contacts", "explored, %", "pose, cm", "max", "pose, deg", "max", "map in 5 cm, %", "complete, %",
    "driven, m", "time, s", "wall, s", "recoveries", "",
)  # fmt: skip


def _steady_row(report: dict[str, Any]) -> tuple[str, ...]:
    return str(report["seed"]), *(value for _, value in figure_rows(report["summary"]))


def _mean(values: list[float]) -> float | None:
    return round(statistics.fmean(values), 4) if values else None


def _row(report: dict[str, Any]) -> tuple[str, ...]:
    s = report["summary"]

    def number(key: str, scale: float, digits: int) -> str:
        return "-" if s[key] is None else f"{s[key] * scale:.{digits}f}"

    return (
        str(report["seed"]), f"{s['goals_reached']}/{s['goals']}", str(s["collisions"]),
        number("explored_share", 100, 1), number("pose_error_mean_m", 100, 1), number("pose_error_max_m", 100, 1),
        number("pose_error_mean_deg", 1, 2), number("pose_error_max_deg", 1, 2), number("map_within_5_cm", 100, 1),
        number("map_completeness", 100, 1), number("distance_m", 1, 0), number("seconds", 1, 0),
        number("wall_seconds", 1, 0), str(sum(leg["recoveries"] for leg in report["legs"])),
        "good" if reaches_targets(report) else report["trouble"] or "not good",
    )  # fmt: skip


def _lockstep(robot: str, world: str, seed: int, seconds: float, settings: list[str]) -> dict[str, Any]:
    import shared.repeatable  # noqa: F401  # a spawned process begins here
    from zenav.scenario.lockstep_run import run_lockstep

    return run_lockstep(load_scenario(robot, world, seed, settings), seconds, None).report()


def _live(robot: str, world: str, seed: int, seconds: float, settings: list[str]) -> dict[str, Any]:
    from zenav.console.run_folder import new_run_folder
    from zenav.scenario.demo import write_results
    from zenav.scenario.live_run import RunView, run_live

    folder = new_run_folder(f"office-{seed}")
    with stop_on_signal() as stop:
        outcome = run_live(
            load_scenario(robot, world, seed, settings), seconds, folder, folder / "run.mcap", stop, RunView()
        )
        if stop.is_set():
            raise KeyboardInterrupt
    return write_results(outcome, folder, folder / "run.mcap")
