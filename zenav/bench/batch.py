# SPDX-License-Identifier: Apache-2.0
"""`zenav bench batch`: what the engine costs beside bare processes, what a second job gains, and a run that is killed.

The same made-up logs go through the mapper in bare processes and through `zenav batch slam`, in turn. Then many files
that are no logs are scheduled. The command is killed at half of them, and a second run does the rest.
"""

import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from shared.config import UserError
from zenav.batch.storage import Folder
from zenav.batch.table import last_table
from zenav.batch.work import SlamWork, run_slam
from zenav.console.json_report import check_writable, write_report
from zenav.console.table import show_table

MAX_OVERHEAD, MIN_SPEEDUP = 0.05, 1.9
"""CPU time more than bare processes, as a share; and how many times faster two jobs are than one."""
MIN_GAIN_OF_BARE = 0.95  # of what two bare processes gain: a shared computer has no two whole cores
ROOM = np.array([4.0, 3.0])  # m, half of its length and width
LOOK_S = 0.05  # between two looks at how many results there are


@dataclass(frozen=True, slots=True)
class Used:
    """What a command used with all its processes: s on the wall, s of CPU, and the largest one's resident MB."""

    wall: float
    cpu: float
    peak_mb: float


def batch(out: Path | None, recordings: int, scans: int, rounds: int, files: int) -> int:
    """`zenav bench batch`; 0 when the limits are kept.

    recordings: made-up logs of `scans` scans each.  rounds: of bare processes and batch in turn.  files: of the run
    that is killed. Raises UserError where a command fails.
    """
    check_writable(out)
    with tempfile.TemporaryDirectory(prefix="zenav-") as folder:
        logs = made_up_logs(Path(folder) / "logs", recordings, scans)
        bare(logs[:1])  # kernels are compiled and read before anything is measured
        numbers, runs = count(), dict[str, list[Used]]()
        for _ in range(rounds):
            for jobs in (1, 2):
                runs.setdefault(f"bare {jobs}", []).append(_bare_processes(logs, jobs))
                place = Path(folder) / f"out{next(numbers)}"
                runs.setdefault(f"batch {jobs}", []).append(ended(started(batch_command(logs[0].parent, place, jobs))))
        report = figures(runs) | {"recordings": recordings, "scans": scans, "rounds": rounds}
        report |= {"killed": killed_run(Path(folder), files)}
    report["kept"] = report["kept"] and report["killed"]["again"] <= report["killed"]["in_flight"]
    show(report)
    write_report(out, report)
    return 0 if report["kept"] else 1


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
        "speedup": speedup,
        "bare_speedup": bare_speedup,
        "kept": overhead <= MAX_OVERHEAD and is_fast,
    }


def killed_run(folder: Path, n: int) -> dict[str, Any]:
    """Files that are no logs: the command is killed at half of them, and a second one does the rest.

    again: files that were computed twice, at most those in work at the kill (`in_flight`).
    """
    files, place = folder / "files", folder / "killed"
    files.mkdir()
    for number in range(n):
        (files / f"{number:05}.log").write_text(f"no log, number {number}\n")
    first = started(batch_command(files, place, jobs=2))
    while _n_results(place) < n // 2:
        if first.process.poll() is not None:
            raise UserError(
                "zenav batch ends before its files are done", "run it by hand: zenav batch slam LOGS --out PLACE"
            )
        threading.Event().wait(LOOK_S)
    first.process.send_signal(signal.SIGKILL)
    killed = ended(first, (-signal.SIGKILL,))
    n_before = _n_results(place)
    resumed = ended(started(batch_command(files, place, jobs=2)), (1,))  # 1: no file is a log
    rows = last_table(Folder(str(place)))
    n_cached = sum(bool(row["cached"]) for row in rows)
    return {
        "files": n,
        "rows": len(rows),
        "done_at_kill": n_before,
        "again": max(n_before - n_cached, 0),
        "in_flight": 2,
        "seconds": [killed.wall, resumed.wall],
        "ms_each": 1e3 * resumed.cpu / n,
        "peak_mb": max(killed.peak_mb, resumed.peak_mb),
    }


def _n_results(place: Path) -> int:
    return sum(1 for _ in place.glob("results/*/row.json"))


def show(report: dict[str, Any]) -> None:
    """Prints the tables."""
    rows = [
        (name, f"{report['wall_s'][name]:.1f}", f"{cpu:.1f}", f"{report['peak_mb'][name]:.0f}")
        for name, cpu in report["cpu_s"].items()
    ]
    title = f"{report['recordings']} logs of {report['scans']} scans, medians of {report['rounds']}"
    show_table(title, ("processes", "wall, s", "CPU, s", "largest, MB"), rows)
    sys.stdout.write(f"CPU beyond bare processes: {report['overhead']:.1%}; limit {MAX_OVERHEAD:.0%}\n")
    sys.stdout.write(f"two jobs: {report['speedup']:.2f} times as fast; bare: {report['bare_speedup']:.2f}\n")
    one = report["killed"]
    sys.stdout.write(
        f"{one['files']} files: killed with {one['done_at_kill']} done after {one['seconds'][0]:.1f} s; the next run "
        f"computed {one['again']} of them again, {one['seconds'][1]:.1f} s; largest process {one['peak_mb']:.0f} MB\n"
    )
