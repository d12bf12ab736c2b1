# SPDX-License-Identifier: Apache-2.0
"""`zenav bench batch`: what the engine costs beside bare processes, what a second job gains, and runs that are killed.

The same made-up logs go through the mapper in bare processes and through `zenav batch slam`, in turn. Then many files
that are no logs are worked on (batch_kill.py).
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from shared.config import UserError
from zenav.batch.work import SlamWork, run_slam
from zenav.console.json_report import check_writable, write_report
from zenav.console.table import show_table

MAX_OVERHEAD, MIN_SPEEDUP = 0.05, 1.9
"""CPU time more than bare processes, as a share; and how many times faster two jobs are than one."""
MIN_GAIN_OF_BARE = 0.95  # of what two bare processes gain: a shared computer has no two whole cores
ROOM = np.array([4.0, 3.0])  # m, half of its length and width


@dataclass(frozen=True, slots=True)
class Used:
    """What a command used with all its processes: s on the wall, s of CPU, and the largest one's resident MB."""

    wall: float
    cpu: float
    peak_mb: float


def batch(out: Path | None, recordings: int, scans: int, rounds: int, tiny: int) -> int:
    """`zenav bench batch`; 0 when the limits are kept.

    recordings: made-up logs of `scans` scans each.  rounds: of bare processes and batch in turn.  tiny: files of the
    runs that are killed. Raises UserError where a command fails.
    """
    check_writable(out)
    with tempfile.TemporaryDirectory(prefix="zenav-") as folder:
        report: dict[str, Any] = {"kept": True}
        if rounds:
            report |= _in_turn(Path(folder), recordings, scans, rounds)
            show(report)
        if tiny:
            from zenav.bench.batch_kill import killed_run, killed_scheduler

            for name, run in (("killed", killed_run), ("killed_scheduler", killed_scheduler)):
                killed = report[name] = run(Path(folder), tiny)
                report["kept"] &= killed["again"] <= killed["in_flight"]
                report["kept"] &= killed["rows"] == tiny
                show({name: killed})
    write_report(out, report)
    return 0 if report["kept"] else 1


def _in_turn(folder: Path, recordings: int, scans: int, rounds: int) -> dict[str, Any]:
    logs = made_up_logs(folder / "logs", recordings, scans)
    bare(logs[:1])  # kernels are compiled and read before anything is measured
    numbers, runs = count(), dict[str, list[Used]]()
    for _ in range(rounds):
        for jobs in (1, 2):
            runs.setdefault(f"bare {jobs}", []).append(_bare_processes(logs, jobs))
            place = folder / f"out{next(numbers)}"
            runs.setdefault(f"batch {jobs}", []).append(ended(started(batch_command(logs[0].parent, place, jobs))))
    return figures(runs) | {"recordings": recordings, "scans": scans, "rounds": rounds}


def made_up_logs(folder: Path, n: int, scans: int) -> list[Path]:
    """CARMEN logs of a robot that circles in an empty room, each with noise of its own (sigma 1 cm)."""
    folder.mkdir()
    paths = [folder / f"{number:05}.log" for number in range(n)]
    for number, path in enumerate(paths):
        path.write_text("".join(_log_lines(scans, np.random.default_rng(number))))
    return paths


def _log_lines(scans: int, noise: np.random.Generator) -> Iterator[str]:
    bearings = np.radians(np.arange(-90, 90))
    for k in range(scans):
        yaw = 0.03 * k
        x, y = 1.5 * np.sin(yaw), -1.5 * np.cos(yaw)
        directions = np.stack([np.cos(yaw + bearings), np.sin(yaw + bearings)], axis=1)
        to_walls = (np.copysign(ROOM, directions) - (x, y)) / np.where(directions == 0.0, 1e-12, directions)
        ranges = to_walls.min(axis=1) + noise.normal(0.0, 0.01, len(bearings))
        pose = " ".join(f"{value:.6f}" for value in (x, y, yaw))
        beams = " ".join(f"{r:.2f}" for r in ranges)
        yield f"ODOM {pose} 0 0 0 {100 + 0.1 * k:.6f} host 0\n"
        yield f"FLASER 180 {beams} {pose} {pose} {100 + 0.1 * k:.6f} host 0\n"


def bare(logs: list[Path]) -> None:
    """The mapper over each log, one after the other, in this process."""
    for log in logs:
        run_slam(SlamWork(), log)


def _bare_processes(logs: list[Path], jobs: int) -> Used:
    code = "import sys; from pathlib import Path; from zenav.bench.batch import bare; bare([*map(Path, sys.argv[1:])])"
    used = [started([sys.executable, "-c", code, *map(str, logs[share::jobs])]) for share in range(jobs)]
    rows = [ended(process) for process in used]
    return Used(max(row.wall for row in rows), sum(row.cpu for row in rows), max(row.peak_mb for row in rows))


def batch_command(logs: Path, place: Path, jobs: int) -> list[str]:
    """`zenav batch slam` over a folder."""
    pattern = str(logs / "*.log")
    return [sys.executable, "-m", "zenav", "batch", "slam", pattern, "--out", str(place), "--jobs", str(jobs)]


@dataclass(frozen=True, slots=True)
class Started:
    """A command that runs, and when it began (monotonic, s)."""

    process: subprocess.Popen[bytes]
    begun: float


def started(command: list[str]) -> Started:
    """Starts a command without its output."""
    null = subprocess.DEVNULL
    return Started(subprocess.Popen(command, stdout=null, stderr=null), time.monotonic())


def ended(run: Started, statuses: tuple[int, ...] = (0,)) -> Used:
    """Waits for a command. Raises UserError where it ends with another status."""
    _, status, usage = os.wait4(run.process.pid, 0)
    run.process.returncode = os.waitstatus_to_exitcode(status)
    if run.process.returncode not in statuses:
        what = f"a command of the benchmark ends with status {run.process.returncode}"
        raise UserError(what, "run it by hand: zenav batch slam LOGS --out PLACE")
    return Used(time.monotonic() - run.begun, usage.ru_utime + usage.ru_stime, usage.ru_maxrss / 1e3)


def figures(runs: dict[str, list[Used]]) -> dict[str, Any]:
    """Medians, and whether the limits are kept; runs: by `bare 1`, `bare 2`, `batch 1`, `batch 2`."""
    cpu = {name: median(run.cpu for run in of) for name, of in runs.items()}
    wall = {name: median(run.wall for run in of) for name, of in runs.items()}
    overhead = cpu["batch 1"] / cpu["bare 1"] - 1.0
    speedup, bare_speedup = (wall[f"{name} 1"] / wall[f"{name} 2"] for name in ("batch", "bare"))
    is_fast = speedup >= min(MIN_SPEEDUP, MIN_GAIN_OF_BARE * bare_speedup)
    return {
        "cpu_s": cpu,
        "wall_s": wall,
        "peak_mb": {name: max(run.peak_mb for run in of) for name, of in runs.items()},
        "overhead": overhead,
        "overhead_s": cpu["batch 1"] - cpu["bare 1"],
        "speedup": speedup,
        "bare_speedup": bare_speedup,
        "kept": overhead <= MAX_OVERHEAD and is_fast,
    }


def show(report: dict[str, Any]) -> None:
    """Prints the tables of what was measured, which may be a part."""
    if "cpu_s" in report:
        rows = [
            (name, f"{report['wall_s'][name]:.1f}", f"{cpu:.1f}", f"{report['peak_mb'][name]:.0f}")
            for name, cpu in report["cpu_s"].items()
        ]
        title = f"{report['recordings']} logs of {report['scans']} scans, medians of {report['rounds']}"
        show_table(title, ("processes", "wall, s", "CPU, s", "largest, MB"), rows)
        beyond, each = report["overhead"], report["overhead_s"]
        sys.stdout.write(f"CPU beyond bare processes: {beyond:.1%}, {each:.2f} s a run; limit {MAX_OVERHEAD:.0%}\n")
        sys.stdout.write(f"two jobs: {report['speedup']:.2f} times as fast; bare: {report['bare_speedup']:.2f}\n")
    for name in ("killed", "killed_scheduler"):
        if name in report:
            one, memory = report[name], ", ".join(f"{who} {mb:.0f}" for who, mb in report[name]["peak_mb"].items())
            sys.stdout.write(
                f"{name}: {one['rows']} files, killed with {one['done_at_kill']} done; {one['again']} of them computed "
                f"again; {one['ms_each']:.1f} ms of CPU each; MB at most: {memory}\n"
            )
    sys.stdout.flush()
