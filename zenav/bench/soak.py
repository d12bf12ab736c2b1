# SPDX-License-Identifier: Apache-2.0
"""`zenav bench soak`: the stack drives for a long time, also while its services are killed and frozen.

Live, as processes: memory, file handles and threads of each must not grow, nor the age of its messages, and no queue
may overflow. In lockstep an hour takes minutes: the size of each service's state must not grow, nor the number of
events that wait. What a fault does is measured from the simulator's truth and the motor commands.
"""

import json
import sys
from dataclasses import asdict, dataclass, replace
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from services.recorder.recording_store import RecorderConfig
from shared.config import UserError
from shared.types import Float64s
from zenav.bench.service_faults import FaultReport, Faults
from zenav.bench.soak_runs import SoakRun, run_processes, run_virtual
from zenav.bench.soak_samples import growths
from zenav.console.json_report import check_writable, write_report
from zenav.console.run_folder import new_run_folder
from zenav.console.shutdown import stop_on_signal
from zenav.console.table import show_table
from zenav.metrics.evaluation import RunTrack
from zenav.scenario.scenario import load_scenario

WARM_UP = 600.0  # s: what grows is measured from then on; in shorter runs from a third of the time
WINDOW = 600.0  # s at begin and end whose latencies are compared; in shorter runs a third of the time
MAX_DRIFT = 1.5  # times: p99 of scan to cmd/vel at the end to that at the begin; in lockstep CPU by stack second
MAX_ZERO_S = 0.25  # from a fault in the velocity path to the last motor command that moves
MAX_RESUME_S = 12.0  # from a fault's end to motion
MAX_WAITING = 1.5  # times: events that wait in lockstep at the end to those at the begin
MAX_MAP_RATIO = 1.10  # mean wall error to that of the run to compare with
STANDS_M = 0.05  # m: within this distance, and STANDS_RAD, the robot stands
STANDS_RAD = 0.1


@dataclass(frozen=True, slots=True)
class SoakPlan:
    """What the user asked for. every: s between two faults, 0: none.  against: report of a run to compare with."""

    minutes: float
    every: float
    seed: int
    lockstep: bool = False
    against: Path | None = None


def soak(robot: str, world: str, plan: SoakPlan, out: Path | None, settings: list[str]) -> int:
    """Runs for so long; 0 when everything held. Raises UserError where the report to compare with is none."""
    check_writable(out)
    reference = map_error_of(plan.against) if plan.against is not None else None
    folder = new_run_folder("soak")
    recording = folder / "run.mcap"
    chosen = load_scenario(robot, world, plan.seed, settings)
    tours = replace(chosen, goals=chosen.goals * max(1, int(plan.minutes)))  # more than it can drive
    faults = Faults(chosen.names, plan.every, np.random.default_rng(plan.seed)) if plan.every else None
    run_tours = run_virtual if plan.lockstep else run_processes
    with stop_on_signal() as stop:
        run = run_tours(tours, 60 * plan.minutes, recording, stop, faults)
        if stop.is_set():
            return 130
    report = report_of(run, recording, plan, reference)
    show_figures(report)
    write_report(out, report)
    sys.stdout.write(f"recording: {recording}\n")
    return 0 if not report["broken"] else 1


def map_error_of(path: Path) -> float:
    """The mean wall error, m, of an earlier report. Raises UserError where the file has none."""
    try:
        return float(json.loads(path.read_text())["summary"]["map_error_mean_m"])
    except (OSError, ValueError, KeyError, TypeError):
        raise UserError(f"{path} is no report of zenav bench soak", "make one: zenav bench soak --out FILE") from None


def report_of(run: SoakRun, recording: Path, plan: SoakPlan, reference: float | None) -> dict[str, Any]:
    """The figures, and under `broken` each promise that did not hold."""
    outcome = run.outcome
    since, window = min(WARM_UP, 20 * plan.minutes), min(WINDOW, 20 * plan.minutes)
    growth = growths(run.samples, since)
    first, last = run.drift(recording, window)
    contacts = outcome.track.truth.n_contacts if outcome.track.truth is not None else 0
    figures = outcome.report()
    budget = outcome.scenario.file.section("recorder", RecorderConfig).budget
    recorded = sum(path.stat().st_size for path in recording.parent.glob(f"{recording.stem}*.mcap")) / 1e6
    error = figures["summary"]["map_error_mean_m"]
    ratio = error / reference if error is not None and reference else None
    slow = [row for row in run.faults if row.in_velocity_path and row.zero_s - row.blur_s > MAX_ZERO_S]
    stood = [row for row in run.faults if row.resumed_s > MAX_RESUME_S]
    broken = [
        *([f"{contacts} contacts"] if contacts else []),
        *([] if run.faults else [f"{row.name} grows: {', '.join(row.faults)}" for row in growth if row.faults]),
        *(
            [f"{run.drifting.replace('_', ' ')} went from {first:.1f} to {last:.1f}"]
            if last > MAX_DRIFT * first > 0
            else []
        ),
        *(f"{row.description} after {row.at:.0f} s: zero command after {row.zero_s:.2f} s" for row in slow),
        *(f"{row.description} after {row.at:.0f} s: the robot stood for {row.resumed_s:.1f} s" for row in stood),
        *(f"{leg['name']} failed: {leg['reason']}" for leg in figures["legs"] if leg["state"] == "failed"),
        *([f"recordings have {recorded:.0f} MB, their budget is {budget:g}"] if recorded > budget else []),
        *([f"mean wall error is {ratio:.2f} times that without faults"] if ratio and ratio > MAX_MAP_RATIO else []),
        *waiting_grows(run.waiting, since),
        *([f"the run ended: {run.trouble}"] if run.trouble else []),
    ]
    return {
        "summary": {
            "minutes": plan.minutes,
            "lockstep": plan.lockstep,
            "goals_reached": outcome.mission.n_reached,
            "goals_failed": sum(str(leg.state) == "failed" for leg in outcome.mission.legs),
            "faults": len(run.faults),
            "contacts": contacts,
            "max_zero_s": max(
                (round(row.zero_s - row.blur_s, 3) for row in run.faults if row.in_velocity_path), default=None
            ),
            "max_resume_s": max((row.resumed_s for row in run.faults if row.resumed_s < inf), default=None),
            "not_resumed": len(stood),
            "longest_standing_s": round(longest_standing(outcome.track), 1),
            f"{run.drifting}_first": round(first, 2),
            f"{run.drifting}_last": round(last, 2),
            "map_error_mean_m": error,
            "map_error_ratio": None if ratio is None else round(ratio, 3),
            "map_within_5_cm": figures["summary"]["map_within_5_cm"],
            "map_completeness": figures["summary"]["map_completeness"],
            "pose_error_mean_m": figures["summary"]["pose_error_mean_m"],
            "recordings_mb": round(recorded, 1),
        },
        "growth": [asdict(row) | {"faults": row.faults} for row in growth],
        "faults": [row.as_json() for row in run.faults],
        "legs": [leg for leg in figures["legs"] if leg["state"] != "waiting"],
        "restarts": outcome.restarts,
        "broken": broken,
    }


def waiting_grows(waiting: list[tuple[float, int]], since: float) -> list[str]:
    """Words where more events wait at the end than after the warm-up. waiting: (s, events)."""
    counts = [n for at, n in waiting if at >= since]
    n = len(counts) // 5
    if n < 2:
        return []
    first, last = float(np.median(counts[:n])), float(np.median(counts[-n:]))
    return [f"events that wait went from {first:.0f} to {last:.0f}"] if last > MAX_WAITING * first else []


def longest_standing(track: RunTrack) -> float:
    """s, the longest time after the first motion in which the robot stayed at one place."""
    rows: Float64s = np.array([row for row in track.truths[::5] if row[0] >= (track.first_motion or inf)])
    longest, since = 0.0, 0
    for i in range(1, len(rows)):
        moved = np.hypot(*(rows[i, 1:3] - rows[since, 1:3])) > STANDS_M
        if moved or abs(np.angle(np.exp(1j * (rows[i, 3] - rows[since, 3])))) > STANDS_RAD:
            since = i
        longest = max(longest, (rows[i, 0] - rows[since, 0]) / 1e9)
    return float(longest)


def show_figures(report: dict[str, Any]) -> None:
    """The figures as tables."""
    rows = [
        (
            g["name"], f"{g['memory_from']:.1f}", f"{g['memory_to']:.1f}", f"{g['files']:+d}", f"{g['threads']:+d}",
            f"{g['age_from'] * 1e3:.0f}", f"{g['age_to'] * 1e3:.0f}", str(g["dropped"]), ", ".join(g["faults"]),
        )
        for g in report["growth"]
    ]  # fmt: skip
    columns = ("", "MB", "at the end", "file handles", "threads", "age, ms", "at the end", "dropped", "grows")
    show_table("services after the warm-up", columns, rows)
    show_table("summary", ("", ""), [(name.replace("_", " "), str(value)) for name, value in report["summary"].items()])
    if report["faults"]:
        by_name: dict[str, list[dict[str, Any]]] = {}
        for row in report["faults"]:
            by_name.setdefault(f"{row['kind']} {row['service']}", []).append(row)
        show_table(
            "faults",
            ("", "n", "zero command, s", "standing, s"),
            [
                (name, str(len(part)), FaultReport.longest(part, "zero_s"), FaultReport.longest(part, "resumed_s"))
                for name, part in sorted(by_name.items())
            ],
        )
    for line in report["broken"]:
        sys.stdout.write(f"broken: {line}\n")
