# SPDX-License-Identifier: Apache-2.0
"""`zenav bench quota`: the live scenario with all services in a share of one core, as on a small computer.

The kernel limits a control group (man 7 cgroups), version 1 or 2. It does not limit real-time threads, so these become
ordinary ones. The simulator and this program are outside of the group. The simulator acts as the hardware, which
never waits for a CPU, so it becomes a real-time process.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np

from shared.config import UserError
from zenav.client import Client
from zenav.console.json_report import check_writable, write_report
from zenav.console.run_folder import new_run_folder
from zenav.console.shutdown import stop_on_signal
from zenav.console.table import show_table
from zenav.metrics.latency import latency_chain
from zenav.scenario.live_run import ProcessStats, RunView, run_live
from zenav.scenario.mission import Mission
from zenav.scenario.scenario import Scenario, load_scenario
from zenav.stack.launch import Launcher

PERIOD_US = 20_000  # of the quota: a group that has used it waits for the rest; the kernel's default is 100 ms
OUTSIDE = ("sim",)
HARDWARE_PRIORITY = 10  # over that of the velocity path
ROOT_V1, ROOT_V2 = Path("/sys/fs/cgroup/cpu"), Path("/sys/fs/cgroup")


class CpuGroup:
    """A control group with a share of one core."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._pids: set[int] = set()

    def add(self, pid: int) -> None:
        """Takes a process with all its threads, once."""
        if pid in self._pids:
            return
        schedule(pid, os.SCHED_OTHER, 0)
        with suppress(ProcessLookupError):
            (self.folder / "cgroup.procs").write_text(str(pid))
            self._pids.add(pid)

    def throttled_share(self) -> float:
        """Share of the periods in which the group had to wait."""
        rows = dict(line.split() for line in (self.folder / "cpu.stat").read_text().splitlines())
        return int(rows["nr_throttled"]) / max(int(rows["nr_periods"]), 1)


def schedule(pid: int, policy: int, priority: int) -> None:
    """Sets the policy of all threads of a process (man 7 sched)."""
    with suppress(ProcessLookupError, FileNotFoundError):
        for thread in Path(f"/proc/{pid}/task").iterdir():
            with suppress(ProcessLookupError):
                os.sched_setscheduler(int(thread.name), policy, os.sched_param(priority))


@contextmanager
def cpu_group(cores: float) -> Iterator[CpuGroup]:
    """A group for this block. Raises UserError where this account may not make one."""
    is_v1 = (ROOT_V1 / "cpu.cfs_quota_us").exists()
    folder = (ROOT_V1 if is_v1 else ROOT_V2) / f"zenav-{os.getpid()}"
    limits = (
        {"cpu.cfs_period_us": PERIOD_US, "cpu.cfs_quota_us": round(cores * PERIOD_US)}
        if is_v1
        else {"cpu.max": f"{round(cores * PERIOD_US)} {PERIOD_US}"}
    )
    try:
        folder.mkdir()
        for name, value in limits.items():
            (folder / name).write_text(str(value))
    except OSError as error:
        with suppress(OSError):
            folder.rmdir()
        raise UserError(f"cannot limit the CPU by {folder}: {error.strerror}", "run it as root") from None
    try:
        yield CpuGroup(folder)
    finally:
        with suppress(OSError):  # a process of it may still be ending
            folder.rmdir()


class QuotaView(RunView):
    """Puts each service's process into the group, restarted ones too."""

    def __init__(self, group: CpuGroup) -> None:
        self._group = group
        self._launcher: Launcher | None = None

    def start(self, scenario: Scenario, launcher: Launcher, processes: ProcessStats) -> None:
        self._launcher = launcher

    def look(self, client: Client, mission: Mission, seconds: float) -> None:
        for name, child in self._launcher.children.items() if self._launcher is not None else ():
            if child.process is None or not child.running:
                continue
            if name in OUTSIDE:
                schedule(child.process.pid, os.SCHED_RR, HARDWARE_PRIORITY)
            else:
                self._group.add(child.process.pid)


def quota(
    robot: str, world: str, cores: float, seconds: float, seed: int, out: Path | None, settings: list[str]
) -> int:
    """Explores and drives to the world's goals within the quota; 0 where all were reached without contact."""
    check_writable(out)
    folder = new_run_folder("quota")
    recording = folder / "run.mcap"
    with cpu_group(cores) as group, stop_on_signal() as stop:
        outcome = run_live(
            load_scenario(robot, world, seed, settings), seconds, folder, recording, stop, QuotaView(group)
        )
        throttled = group.throttled_share()
        if stop.is_set():
            return 130
    report: dict[str, Any] = outcome.report()
    chain = latency_chain(recording, outcome.track.first_motion or 0)
    used = sum(row["cpu"] for name, row in outcome.processes.items() if name not in (*OUTSIDE, "zenav"))
    report["summary"] |= {
        "quota": cores,
        "cpu_used": round(used, 3),
        "throttled_share": round(throttled, 3),
        "latency_p99_ms": round(float(np.percentile(chain.latency, 99)) * 1e3, 1) if len(chain.latency) else None,
    }
    report |= {"settings": settings, "load": os.getloadavg()[0]}
    show_table(
        "CPU of the services, % of a core",
        ("", "mean", "largest in a second"),
        [(name, f"{row['cpu'] * 100:.1f}", f"{row['cpu_max'] * 100:.1f}") for name, row in outcome.processes.items()],
    )
    show_table("summary", ("", ""), [(name.replace("_", " "), str(value)) for name, value in report["summary"].items()])
    write_report(out, report)
    sys.stdout.write(f"recording: {recording}\n")
    return 0 if outcome.good else 1
