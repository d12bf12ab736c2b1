# SPDX-License-Identifier: Apache-2.0
"""`zenav bench stack`: the live stack drives; how fast a scan becomes a velocity, and what each process costs."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared.config import UserError
from zenav.bench.chain import Chain, chain
from zenav.bench.table import table, writable, write
from zenav.scene import scene
from zenav.stopping import stopping
from zenav.up import run_folder

Float64s = NDArray[np.float64]

START = 20.0  # s that starting may take on top of the measured driving
AIM_P99, AIM_RATIO = 0.030, 1.5  # s; times the sum of the handlers


def stack(robot: str, world: str, seconds: float, out: Path | None, settings: list[str]) -> int:
    """Drives for `seconds`, shows and writes the figures; 0 when nothing was touched and the aims are met."""
    from zenav.live_run import View, run

    writable(out)
    folder = run_folder("stack")
    recording = folder / "run.mcap"
    with stopping() as stop:
        outcome = run(scene(robot, world, 0, settings), seconds + START, folder, recording, stop, View())
        if stop.is_set():
            return 130
    if outcome.track.first_motion is None:
        raise UserError(f"the robot did not move: {outcome.trouble}", f"see the logs in {folder}")
    found = chain(recording, outcome.track.first_motion)
    if not len(found.latency):
        raise UserError("no scan led to a command", f"see the logs in {folder}")
    report = figures(found)
    report["summary"] |= {
        "first_motion_s": round(outcome.first_motion or 0.0, 2),
        "cpu_total": round(sum(row["cpu"] for row in outcome.processes.values()), 3),
        "memory_total_mb": round(sum(row["memory_mb"] for row in outcome.processes.values()), 1),
        "contacts": outcome.track.truth.n_contacts if outcome.track.truth is not None else 0,
    }
    report |= {"processes": outcome.processes, "restarts": outcome.restarts, "recording": str(recording)}
    show(report)
    write(out, report)
    s = report["summary"]
    return 0 if s["latency_p99_ms"] < AIM_P99 * 1e3 and s["ratio_to_handlers"] < AIM_RATIO and not s["contacts"] else 1


def figures(found: Chain) -> dict[str, Any]:
    """Percentiles of the chain and its parts, ms. The handlers' sum: each one's slowest of a second, the median."""
    parts = {
        "scan to cmd/vel": found.latency, "with the wait for the control tick": found.total,
        "scan to local_ctrl": found.to_control, "wait for the control tick": found.wait,
        "tick to guard": found.control, "guard to base_driver": found.guard,
    }  # fmt: skip
    rows = {name: {f"p{p}": round(_ms(values, p), 2) for p in (50, 95, 99, 100)} for name, values in parts.items()}
    handlers = {name: round(_ms(values, 50), 2) for name, values in found.handlers.items() if len(values)}
    total = sum(handlers.values())
    return {
        "summary": {
            "n_scans": len(found.latency),
            "latency_p50_ms": rows["scan to cmd/vel"]["p50"],
            "latency_p99_ms": rows["scan to cmd/vel"]["p99"],
            "handlers_ms": round(total, 2),
            "ratio_to_handlers": round(rows["scan to cmd/vel"]["p99"] / max(total, 1e-9), 2),
        },
        "parts": rows,
        "handlers": handlers,
    }


def _ms(values: Float64s, percentile: float) -> float:
    return float(np.percentile(values, percentile)) * 1e3 if len(values) else 0.0


def show(report: dict[str, Any]) -> None:
    """The figures as tables."""
    s = report["summary"]
    rows = [(name, *(f"{row[p]:.1f}" for p in ("p50", "p95", "p99", "p100"))) for name, row in report["parts"].items()]
    table(f"{s['n_scans']} scans", ("ms", "p50", "p95", "p99", "max"), rows)
    processes = [
        (name, f"{row['cpu'] * 100:.1f}", f"{row['cpu_max'] * 100:.1f}", f"{row['memory_mb']:.0f}")
        for name, row in report["processes"].items()
    ]
    table("processes", ("", "CPU, % of a core", "busiest second", "MB"), processes)
    sys.stdout.write(
        f"p99 is {s['ratio_to_handlers']:.2f} times the handlers' {s['handlers_ms']:.1f} ms; "
        f"first motion after {s['first_motion_s']:.1f} s\n"
    )
