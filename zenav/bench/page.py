# SPDX-License-Identifier: Apache-2.0
"""`zenav bench page`: hostile clients attack the page's server while the robot drives; what that costs the robot.

Attacks and quiet times follow each other in one run, so that what else the machine does is in both.
"""

import json
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from shared.config import UserError
from shared.runners.client import Client
from shared.types import Bools
from zenav.console.json_report import check_writable, write_report
from zenav.console.run_folder import new_run_folder
from zenav.console.shutdown import stop_on_signal
from zenav.console.table import show_table
from zenav.metrics.latency import LatencyChain, latency_chain
from zenav.scenario.live_run import ProcessStats, RunView, run_live
from zenav.scenario.mission import LegState, Mission
from zenav.scenario.scenario import Scenario, load_scenario
from zenav.stack.launch import Launcher
from zenav.stack.page import SERVICE

QUIET = "quiet"
ATTACKS = ("frames", "oversized", "connections", "slowloris")
PHASE_S = 8.0
START_S = 25.0  # that starting may take, and the first motion
MAX_RATIO = 1.1  # of the 99th percentile in an attack, to that in quiet times
COLUMNS = "phase", "scans", "p50, ms", "p99, ms", "p99 to quiet", "page's CPU, %", "what happened"


@dataclass(slots=True)
class Phase:
    """One attack, or quiet time. begin, end: ns on the stack's clock, the wall's. cpu_s: of the page's server."""

    name: str
    begin: int
    end: int = 0
    cpu_s: float = 0.0
    counts: dict[str, int] = field(default_factory=dict)


class AttackedRun(RunView):
    """Begins with the first motion; a thread of its own attacks."""

    def __init__(self, port: int, rounds: int) -> None:
        self.phases: list[Phase] = []
        self._port, self._rounds = port, rounds
        self._processes: ProcessStats | None = None
        self._thread: threading.Thread | None = None
        self._ended = threading.Event()

    def start(self, scenario: Scenario, launcher: Launcher, processes: ProcessStats) -> None:
        self._processes = processes

    def look(self, client: Client, mission: Mission, seconds: float) -> None:
        if self._thread is None and mission.leg is not None and mission.leg.state is LegState.UNDER_WAY:
            self._thread = threading.Thread(target=self._attack, daemon=True)
            self._thread.start()

    def end(self) -> None:
        self._ended.set()
        if self._thread is not None:
            self._thread.join()

    def _attack(self) -> None:
        assert self._processes is not None
        server = psutil.Process(self._processes.latest[SERVICE].pid)
        command = [sys.executable, "-m", "zenav.bench.hostile_clients", str(self._port)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as clients:
            assert clients.stdin is not None
            assert clients.stdout is not None
            for attack in ATTACKS * self._rounds:
                for name in (QUIET, attack):
                    if self._ended.is_set():
                        break
                    phase, before = Phase(name, time.time_ns()), server.cpu_times()
                    if name == QUIET:
                        self._ended.wait(PHASE_S)
                    else:
                        clients.stdin.write(f"{name} {PHASE_S}\n")
                        clients.stdin.flush()
                        phase.counts = json.loads(clients.stdout.readline())
                    after = server.cpu_times()
                    phase.cpu_s = after.user + after.system - before.user - before.system
                    phase.end = time.time_ns()
                    self.phases.append(phase)
            clients.kill()


def page(robot: str, world: str, rounds: int, out: Path | None, settings: list[str]) -> int:
    """Drives while clients attack, shows and writes the figures; 0 when the latency is kept and nothing was touched."""
    check_writable(out)
    folder = new_run_folder("page")
    recording = folder / "run.mcap"
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    chosen = load_scenario(robot, world, 0, [*settings, f"dashboard.port.device=web://127.0.0.1:{port}"])
    chosen.names.append(SERVICE)
    view = AttackedRun(port, rounds)
    with stop_on_signal() as stop:
        seconds = START_S + 2 * len(ATTACKS) * rounds * (PHASE_S + 1)
        outcome = run_live(chosen, seconds, folder, recording, stop, view)
        if stop.is_set():
            return 130
    if len(view.phases) < 2 * len(ATTACKS):
        raise UserError("the run ended before the attacks", f"see the logs in {folder}")
    report = figures(latency_chain(recording), view.phases)
    report["summary"]["contacts"] = outcome.track.truth.n_contacts if outcome.track.truth is not None else 0
    report |= {"restarts": outcome.restarts, "recording": str(recording)}
    show(report)
    write_report(out, report)
    s = report["summary"]
    return 0 if s["kept"] and not s["contacts"] and not outcome.restarts else 1


def figures(chain: LatencyChain, phases: list[Phase]) -> dict[str, Any]:
    """Latency by attack and in quiet times, the server's CPU, and what happened to the clients."""
    rows: dict[str, Any] = {}
    for name in (QUIET, *ATTACKS):
        mine = [phase for phase in phases if phase.name == name]
        within: Bools = np.zeros(len(chain.sent), bool)
        for phase in mine:
            within |= (chain.sent >= phase.begin) & (chain.sent < phase.end)
        latency = chain.latency[within] * 1e3
        p50, p99 = np.percentile(latency, (50, 99)) if len(latency) else (np.nan, np.nan)
        seconds = sum(phase.end - phase.begin for phase in mine) * 1e-9
        counts = sum((Counter(phase.counts) for phase in mine), Counter[str]())
        rows[name] = {
            "n_scans": len(latency),
            "p50_ms": float(p50),
            "p99_ms": float(p99),
            "cpu": sum(phase.cpu_s for phase in mine) / max(seconds, 1e-9),
            "counts": dict(counts),
        }
    ratios = {name: rows[name]["p99_ms"] / rows[QUIET]["p99_ms"] for name in ATTACKS}
    return {"rows": rows, "summary": {"ratios": ratios, "kept": all(r <= MAX_RATIO for r in ratios.values())}}


def show(report: dict[str, Any]) -> None:
    """The figures as a table."""
    ratios = report["summary"]["ratios"]
    lines = [
        (
            name,
            str(row["n_scans"]),
            f"{row['p50_ms']:.1f}",
            f"{row['p99_ms']:.1f}",
            f"{ratios[name]:.2f}" if name in ratios else "",
            f"{row['cpu'] * 100:.0f}",
            ", ".join(f"{n} {what}" for what, n in row["counts"].items()),
        )
        for name, row in report["rows"].items()
    ]
    show_table(f"scan to cmd/vel without the wait, while clients attack the page; limit {MAX_RATIO}", COLUMNS, lines)
