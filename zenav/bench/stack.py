# SPDX-License-Identifier: Apache-2.0
"""`zenav bench stack`: the live stack drives; how fast a scan becomes a velocity, and what each process costs."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shared.config import UserError
from zenav.bench.chain import Chain, chain, handler_times
from zenav.bench.table import table, writable, write
from zenav.classes import made
from zenav.scene import scene
from zenav.stopping import stopping
from zenav.up import run_folder

Float64s = NDArray[np.float64]
Bools = NDArray[np.bool_]

START = 20.0  # s that starting may take on top of the measured driving
AIM_P99, AIM_RATIO = 0.030, 1.5  # s, without the wait for the tick; times the handlers of the same scans


def stack(robot: str, world: str, seconds: float, out: Path | None, settings: list[str]) -> int:
    """Drives for `seconds`, shows and writes the figures; 0 when nothing was touched and the aims are met."""
    from zenav.live_run import View, run

    writable(out)
    folder = run_folder("stack")
    recording = folder / "run.mcap"
    chosen = scene(robot, world, 0, settings)
    with stopping() as stop:
        outcome = run(chosen, seconds + START, folder, recording, stop, View())
        if stop.is_set():
            return 130
    if outcome.track.first_motion is None:
        raise UserError(f"the robot did not move: {outcome.trouble}", f"see the logs in {folder}")
    file = chosen.file
    spent = handler_times(recording, lambda name: made(name, file, file.robot))
    found = chain(recording, outcome.track.first_motion, spent)
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
    near = s["ratio_to_handlers"] is not None and s["ratio_to_handlers"] < AIM_RATIO
    return 0 if s["latency_p99_ms"] < AIM_P99 * 1e3 and near and not s["contacts"] else 1


def figures(found: Chain) -> dict[str, Any]:
    """Percentiles of the chain and its parts, ms.

    The ratio compares equal percentiles over the same scans. Its numerator is the time from scan to cmd/vel without the
    wait for the tick. Its denominator is the time of that command's handlers, run alone.
    """
    known = np.isfinite(found.handlers)
    parts = {
        "scan to cmd/vel, with the wait for the control tick": found.total,
        "without that wait": found.latency,
        **({"the handlers on the way, alone": found.handlers[known]} if known.any() else {}),
        "scan to local_ctrl": found.to_control, "wait for the control tick": found.wait,
        "tick to guard": found.control, "guard to base_driver": found.guard,
    }  # fmt: skip
    rows = {name: {f"p{p}": round(_ms(values, p), 2) for p in (50, 95, 99, 100)} for name, values in parts.items()}
    return {
        "summary": {
            "n_scans": found.n_scans,
            "n_scans_without_command": sum(found.lost.values()),
            "with_wait_p50_ms": round(_ms(found.total, 50), 2),
            "with_wait_p99_ms": round(_ms(found.total, 99), 2),
            "latency_p50_ms": round(_ms(found.latency, 50), 2),
            "latency_p99_ms": round(_ms(found.latency, 99), 2),
            "handlers_p50_ms": round(_ms(found.handlers[known], 50), 2),
            "handlers_p99_ms": round(_ms(found.handlers[known], 99), 2),
            "ratio_to_handlers_p50": _ratio(found, known, 50),
            "ratio_to_handlers": _ratio(found, known, 99),
        },
        "parts": rows,
        "scans_without_command": found.lost,
    }


def _ratio(found: Chain, known: Bools, percentile: float) -> float | None:
    """Latency to handlers, of the same scans; None where no handler's time is known."""
    handlers = _ms(found.handlers[known], percentile)
    return round(_ms(found.latency[known], percentile) / handlers, 2) if handlers else None


def _ms(values: Float64s, percentile: float) -> float:
    return float(np.percentile(values, percentile)) * 1e3 if len(values) else 0.0


def show(report: dict[str, Any]) -> None:
    """The figures as tables."""
    s = report["summary"]
    rows = [(name, *(f"{row[p]:.1f}" for p in ("p50", "p95", "p99", "p100"))) for name, row in report["parts"].items()]
    ended = ", ".join(f"{n} {where}" for where, n in report["scans_without_command"].items() if n) or "none"
    table(f"{s['n_scans']} scans; led to no command: {ended}", ("ms", "p50", "p95", "p99", "max"), rows)
    processes = [
        (name, f"{row['cpu'] * 100:.1f}", f"{row['cpu_max'] * 100:.1f}", f"{row['memory_mb']:.0f}")
        for name, row in report["processes"].items()
    ]
    table("processes", ("", "CPU, % of a core", "busiest second", "MB"), processes)
    sys.stdout.write(
        f"without the wait, p50 is {s['ratio_to_handlers_p50']} times the handlers' and p99 "
        f"{s['ratio_to_handlers']} times; first motion after {s['first_motion_s']:.1f} s\n"
    )
