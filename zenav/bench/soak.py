# SPDX-License-Identifier: Apache-2.0
"""`zenav bench soak`: the live stack drives for a long time, also while its services are killed and frozen.

Memory, file handles and threads of each process must not grow. The latency from scan to cmd/vel must not drift.
It comes from the recording. What a fault does is measured from the simulator's truth and the motor commands.
"""

import statistics
import sys
import threading
from dataclasses import asdict, dataclass, replace
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from zenav.bench.service_faults import FaultReport, Faults
from zenav.client import Client
from zenav.console.json_report import check_writable, write_report
from zenav.console.run_folder import new_run_folder
from zenav.console.shutdown import stop_on_signal
from zenav.console.table import show_table
from zenav.metrics.latency import latency_chain
from zenav.scenario.live_run import ProcessStats, RunView, run_live
from zenav.scenario.mission import Mission
from zenav.scenario.scenario import Scenario, ScenarioResult, load_scenario
from zenav.stack.launch import Launcher

SAMPLE_EVERY = 5.0  # s
WARM_UP = 600.0  # s: what grows is measured from then on; in shorter runs from a third of the time
WINDOW = 600.0  # s at begin and end whose latencies are compared; in shorter runs a third of the time
MAX_GROWTH = 0.05  # of a process's memory after WARM_UP
MAX_DRIFT = 1.5  # times: p99 of scan to cmd/vel at the end to that at the begin
MAX_ZERO_S = 0.25  # from a fault in the velocity path to the last motor command that moves
MAX_RESUME_S = 12.0  # from a fault's end to motion


@dataclass(frozen=True, slots=True)
class ProcessSample:
    """One process at one time. at: s since the start; pss: MB, its share of the memory that it uses."""

    at: float
    pid: int
    pss: float
    n_files: int
    n_threads: int


@dataclass(frozen=True, slots=True)
class Growth:
    """One process from WARM_UP to the end."""

    name: str
    pss_from: float
    pss_to: float
    files: int  # more at the end
    threads: int  # more at the end

    @property
    def holds(self) -> bool:
        return self.pss_to <= (1 + MAX_GROWTH) * self.pss_from and self.files <= 0 and self.threads <= 0


class SoakView(RunView):
    """Samples the processes, and lets faults happen; called ten times a second by the run."""

    def __init__(self, faults: Faults | None) -> None:
        self.samples: dict[str, list[ProcessSample]] = {}
        self.faults = faults
        self._launcher: Launcher | None = None
        self._sampled = -inf
        self._lock = threading.Lock()

    def start(self, scenario: Scenario, launcher: Launcher, processes: ProcessStats) -> None:
        self._launcher = launcher

    def look(self, client: Client, mission: Mission, seconds: float) -> None:
        if self._launcher is None:
            return
        if self.faults is not None:
            self.faults.step(client, self._launcher, seconds, is_driving=bool(mission.legs[0].seconds))
        if seconds - self._sampled >= SAMPLE_EVERY:
            self._sampled = seconds
            for name, child in self._launcher.children.items():
                if child.running and child.process is not None:
                    newest = sample(child.process.pid, seconds)
                    if newest is not None:
                        self.samples.setdefault(name, []).append(newest)

    def end(self) -> None:
        if self.faults is not None:
            self.faults.end()


def sample(pid: int, at: float) -> ProcessSample | None:
    """A process's sample; None where it has ended."""
    process = Path(f"/proc/{pid}")
    try:
        lines = (process / "smaps_rollup").read_text().splitlines()
        pss = next(int(line.split()[1]) for line in lines if line.startswith("Pss:"))
        n_files, n_threads = (sum(1 for _ in (process / part).iterdir()) for part in ("fd", "task"))
    except (OSError, StopIteration):
        return None
    return ProcessSample(at, pid, pss / 1024, n_files, n_threads)


def growths(samples: dict[str, list[ProcessSample]], since: float) -> list[Growth]:
    """What the last life of each process gained after `since` (s).

    Medians of the first and of the last fifth of its samples; processes with under ten of them are left out.
    """
    growing = []
    for name, rows in samples.items():
        life = [row for row in rows if row.pid == rows[-1].pid and row.at >= since]
        n = len(life) // 5
        if n < 2:
            continue
        first, last = _medians(life[:n]), _medians(life[-n:])
        files, threads = round(last[1] - first[1]), round(last[2] - first[2])
        growing.append(Growth(name, round(first[0], 1), round(last[0], 1), files, threads))
    return growing


def _medians(rows: list[ProcessSample]) -> tuple[float, float, float]:
    """PSS, file handles, threads."""
    columns = zip(*((row.pss, float(row.n_files), float(row.n_threads)) for row in rows), strict=True)
    pss, files, threads = (statistics.median(column) for column in columns)
    return pss, files, threads


def soak(robot: str, world: str, minutes: float, every: float, seed: int, out: Path | None, settings: list[str]) -> int:
    """Runs for `minutes`; a fault `every` s, none where it is 0. 0 when everything held."""
    check_writable(out)
    folder = new_run_folder("soak")
    recording = folder / "run.mcap"
    chosen = load_scenario(robot, world, seed, settings)
    tours = replace(chosen, goals=chosen.goals * max(1, int(minutes)))  # more than it can drive
    view = SoakView(Faults(chosen.names, every, np.random.default_rng(seed)) if every else None)
    with stop_on_signal() as stop:
        outcome = run_live(tours, 60 * minutes, folder, recording, stop, view)
        if stop.is_set():
            return 130
    report = report_of(outcome, view, recording, minutes)
    show_figures(report)
    write_report(out, report)
    sys.stdout.write(f"recording: {recording}\n")
    return 0 if not report["broken"] else 1


def report_of(outcome: ScenarioResult, view: SoakView, recording: Path, minutes: float) -> dict[str, Any]:
    """The figures, and under `broken` each promise that did not hold."""
    since, window = min(WARM_UP, 20 * minutes), min(WINDOW, 20 * minutes)
    growth = growths(view.samples, since)
    p99 = latency_drift(recording, outcome, window)
    faults = view.faults.reports if view.faults is not None else []
    contacts = outcome.track.truth.n_contacts if outcome.track.truth is not None else 0
    slow = [row for row in faults if row.in_velocity_path and row.zero_s > MAX_ZERO_S]
    stood = [row for row in faults if row.resumed_s > MAX_RESUME_S]
    broken = [
        *([f"{contacts} contacts"] if contacts else []),
        *([] if view.faults else [f"{row.name} grows" for row in growth if not row.holds]),
        *([f"latency p99 went from {p99[0]:.1f} to {p99[1]:.1f} ms"] if p99[1] > MAX_DRIFT * p99[0] > 0 else []),
        *(f"{row.description} after {row.at:.0f} s: zero command after {row.zero_s:.2f} s" for row in slow),
        *(f"{row.description} after {row.at:.0f} s: the robot stood for {row.resumed_s:.1f} s" for row in stood),
        *([f"the run ended: {outcome.trouble}"] if outcome.trouble not in ("", "out of time") else []),
    ]
    figures = outcome.report()
    return {
        "summary": {
            "minutes": minutes,
            "goals_reached": outcome.mission.n_reached,
            "goals_failed": sum(str(leg.state) == "failed" for leg in outcome.mission.legs),
            "faults": len(faults),
            "contacts": contacts,
            "max_zero_s": max((row.zero_s for row in faults if row.in_velocity_path), default=None),
            "max_resume_s": max((row.resumed_s for row in faults if row.resumed_s < inf), default=None),
            "not_resumed": len(stood),
            "latency_p99_ms_first": round(p99[0], 2),
            "latency_p99_ms_last": round(p99[1], 2),
            "map_error_mean_m": figures["summary"]["map_error_mean_m"],
            "map_within_5_cm": figures["summary"]["map_within_5_cm"],
            "pose_error_mean_m": figures["summary"]["pose_error_mean_m"],
        },
        "growth": [asdict(row) for row in growth],
        "faults": [row.as_json() for row in faults],
        "legs": figures["legs"],
        "restarts": outcome.restarts,
        "broken": broken,
    }


def latency_drift(recording: Path, outcome: ScenarioResult, window: float) -> tuple[float, float]:
    """p99 of scan to cmd/vel, ms, over the first and the last `window` s of driving; zeros where there is none."""
    first = outcome.track.first_motion
    if first is None:
        return 0.0, 0.0
    chain = latency_chain(recording, first)
    if not len(chain.latency):
        return 0.0, 0.0
    n = max(1, round(len(chain.latency) * min(0.5, window / max(outcome.wall_seconds, 1.0))))
    first_ms, last_ms = (float(np.percentile(part, 99)) * 1e3 for part in (chain.latency[:n], chain.latency[-n:]))
    return first_ms, last_ms


def show_figures(report: dict[str, Any]) -> None:
    """The figures as tables."""
    rows = [
        (g["name"], f"{g['pss_from']:.0f}", f"{g['pss_to']:.0f}", f"{g['files']:+d}", f"{g['threads']:+d}")
        for g in report["growth"]
    ]
    show_table("processes after the warm-up", ("", "PSS, MB", "at the end", "file handles", "threads"), rows)
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
