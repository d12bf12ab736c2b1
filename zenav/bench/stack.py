# SPDX-License-Identifier: Apache-2.0
"""`zenav bench stack`: the live stack drives; how fast a scan becomes a velocity, and what each process costs."""

import sys
from contextlib import ExitStack
from math import inf
from pathlib import Path
from typing import Any

from shared.config import UserError
from zenav.console.json_report import check_writable, write_report
from zenav.console.run_folder import new_run_folder
from zenav.console.shutdown import stop_on_signal
from zenav.console.table import show_table
from zenav.metrics.latency import handler_times, latency_chain, latency_figures
from zenav.scenario.scenario import load_scenario
from zenav.stack.gateway import GATEWAY
from zenav.stack.service_loader import build_service

START = 20.0  # s that starting may take on top of the measured driving
AIM_P99, AIM_RATIO = 0.030, 1.5  # s, without the wait for the tick; times the handlers of the same scans


def stack(robot: str, world: str, seconds: float, out: Path | None, settings: list[str], remote: bool) -> int:
    """Drives for `seconds`, shows and writes the figures; 0 when nothing was touched and the aims are met.

    remote: whether the gateway runs too, with a member of `cmd/vel`. A scan must become a velocity at this member at
    most MAX_TLS_MS later than at the base, at p99.
    """
    from zenav.bench.gateway import MAX_TLS_MS
    from zenav.bench.remote_view import remote_member
    from zenav.scenario.live_run import RunView, run_live

    check_writable(out)
    folder = new_run_folder("stack")
    recording = folder / "run.mcap"
    with stop_on_signal() as stop, ExitStack() as open_things:
        member = open_things.enter_context(remote_member(robot)) if remote else None
        chosen = load_scenario(robot, world, 0, [*settings, *(member.settings if member else ())])
        if member:
            chosen.names.append(GATEWAY)
        outcome = run_live(chosen, seconds + START, folder, recording, stop, member or RunView())
        if stop.is_set():
            return 130
    if outcome.track.first_motion is None:
        raise UserError(f"the robot did not move: {outcome.trouble}", f"see the logs in {folder}")
    file = chosen.file
    spent = handler_times(recording, lambda name: build_service(name, file, file.robot))
    chain = latency_chain(recording, outcome.track.first_motion, spent, member.commands if member else {})
    if not len(chain.latency):
        raise UserError("no scan led to a command", f"see the logs in {folder}")
    report = latency_figures(chain)
    report["summary"] |= {
        "first_motion_s": round(outcome.first_motion or 0.0, 2),
        "cpu_total": round(sum(row["cpu"] for row in outcome.processes.values()), 3),
        "memory_total_mb": round(sum(row["memory_mb"] for row in outcome.processes.values()), 1),
        "contacts": outcome.track.truth.n_contacts if outcome.track.truth is not None else 0,
    }
    report |= {"processes": outcome.processes, "restarts": outcome.restarts, "recording": str(recording)}
    show_figures(report)
    write_report(out, report)
    s = report["summary"]
    near = s["ratio_to_handlers"] is not None and s["ratio_to_handlers"] < AIM_RATIO
    remote_kept = not remote or s.get("member_p99_ms", inf) < s["latency_p99_ms"] + MAX_TLS_MS
    return 0 if s["latency_p99_ms"] < AIM_P99 * 1e3 and near and remote_kept and not s["contacts"] else 1


def show_figures(report: dict[str, Any]) -> None:
    """The figures as tables."""
    s = report["summary"]
    rows = [(name, *(f"{row[p]:.1f}" for p in ("p50", "p95", "p99", "p100"))) for name, row in report["parts"].items()]
    ended = ", ".join(f"{n} {where}" for where, n in report["scans_without_command"].items() if n) or "none"
    show_table(f"{s['n_scans']} scans; led to no command: {ended}", ("ms", "p50", "p95", "p99", "max"), rows)
    processes = [
        (name, f"{row['cpu'] * 100:.1f}", f"{row['cpu_max'] * 100:.1f}", f"{row['memory_mb']:.0f}")
        for name, row in report["processes"].items()
    ]
    show_table("processes", ("", "CPU, % of a core", "busiest second", "MB"), processes)
    sys.stdout.write(
        f"without the wait, p50 is {s['ratio_to_handlers_p50']} times the handlers' and p99 "
        f"{s['ratio_to_handlers']} times; first motion after {s['first_motion_s']:.1f} s\n"
    )
