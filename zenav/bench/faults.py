# SPDX-License-Identifier: Apache-2.0
"""`zenav bench faults`: what fails while the robot drives, and how soon, how far and with which words it stands."""

import statistics
import sys
from functools import partial
from math import inf
from pathlib import Path
from typing import Any

from shared.config import UserError, nearest
from zenav.bench.fault_table import FAULT_ROWS, DriveMode, FaultRow
from zenav.bench.fault_trial import SPEEDS, FaultResult, FaultTrial
from zenav.bench.process_pool import pool_results
from zenav.console.json_report import check_writable, write_report
from zenav.console.table import show_table

MODES = tuple(DriveMode)
MAX_WRONG_S = 1.0  # s that a pose over 0.3 m wrong may be good
COLUMNS = (
    "fault", "n", "median, ms to zero", "max", "limit", "most m after it", "contacts", "right reason", "resumed",
    "good but wrong, s", "", "reasons told",
)  # fmt: skip


def faults(robot: str, n: int, seed: int, jobs: int, only: str, out: Path | None, live: bool) -> int:
    """Runs n trials of the matrix, shows a row a fault, writes the JSON; 0 where every target is kept."""
    check_writable(out)
    trials = matrix(n, seed, selected_rows(only, live))
    run_one = partial(_live if live else _lockstep, robot)
    results: list[FaultResult] = []
    for result in pool_results(run_one, trials, 1 if live else jobs):
        results.append(result)
        row = next(row for row in FAULT_ROWS if row.name == result.fault)
        verdict = "; ".join(missed_targets(result, row)) or "good"
        sys.stderr.write(f"{len(results)}/{n} {result.fault}, {result.mode}, {result.speed} m/s: {verdict}\n")
    lines = [table_row(row, results_of(results, row)) for row in _rows(results)]
    show_table(f"faults, {'live' if live else 'lockstep'}", COLUMNS, lines)
    sums = fault_summary(results)
    report = {"summary": sums, "live": live, "seed": seed, "rows": lines, "trials": [r.as_json() for r in results]}
    write_report(out, report)
    return 0 if len(results) == n and sums["good"] == n else 1


def selected_rows(only: str, live: bool) -> list[int]:
    """The rows' places of names separated by commas; all where there are none. Raises UserError on an unknown one."""
    names = [row.name for row in FAULT_ROWS if live or not row.live_only]
    wanted = [name.strip() for name in only.split(",") if name.strip()]
    for name in wanted:
        if name not in names:
            raise UserError(f"no fault {name!r}", nearest(name, tuple(names)))
    return [i for i, row in enumerate(FAULT_ROWS) if row.name in (wanted or names)]


def matrix(n: int, seed: int, rows: list[int]) -> list[FaultTrial]:
    """n trials: each fault equally often, and each in all modes and speeds before one comes again."""
    combinations = [(mode, speed) for speed in reversed(SPEEDS) for mode in MODES]
    trials = []
    for i in range(n):
        place, turn = i % len(rows), i // len(rows)
        mode, speed = combinations[(place + 4 * turn) % len(combinations)]
        trials.append(FaultTrial(rows[place], mode, speed, seed + i))
    return trials


def missed_targets(result: FaultResult, row: FaultRow) -> list[str]:
    """Which targets a trial missed, in words. A fault that ends before the limit need not stop the robot."""
    if result.trouble:
        return [f"no trial: {result.trouble}"]
    missed = []
    time, was_too_short = judged_ms(result, row), result.lasts * 1e3 < row.limit
    if time is not None and time > row.limit and not (time == inf and was_too_short):
        missed.append("never stood" if time == inf else f"{time:.0f} ms")
    if result.contacts:
        missed.append(f"{result.contacts} contacts")
    if result.right is False and (result.mode in row.stops | row.creeps) and not was_too_short:
        missed.append(f"told {', '.join(result.reasons) or 'nothing'}")
    if result.wrong_while_good > MAX_WRONG_S:
        missed.append(f"pose wrong but good for {result.wrong_while_good:.1f} s")
    if row.resumes and not result.resumed:
        missed.append("did not resume")
    return missed


def judged_ms(result: FaultResult, row: FaultRow) -> float | None:
    """ms to the zero command, or to a creep where that will do; None where nothing has to stop."""
    if result.mode in row.stops:
        return result.zero_ms
    return min(result.creep_ms, result.zero_ms) if result.mode in row.creeps else None


def results_of(results: list[FaultResult], row: FaultRow) -> list[FaultResult]:
    return [result for result in results if result.fault == row.name]


def _rows(results: list[FaultResult]) -> list[FaultRow]:
    return [row for row in FAULT_ROWS if results_of(results, row)]


def table_row(row: FaultRow, results: list[FaultResult]) -> tuple[str, ...]:
    """A fault's line of the table."""
    times = [ms for result in results if (ms := judged_ms(result, row)) is not None]
    with_reason = [result for result in results if result.right is not None and result.mode in row.stops | row.creeps]
    reasons = sorted({reason for result in results for reason in result.reasons})
    bad = sum(bool(missed_targets(result, row)) for result in results)
    return (
        row.name,
        str(len(results)),
        _ms(statistics.median(times)) if times else "-",
        _ms(max(times)) if times else "-",
        f"{row.limit:.0f}" if row.stops | row.creeps else "-",
        f"{max(result.distance for result in results):.2f}",
        str(sum(result.contacts for result in results)),
        f"{sum(bool(result.right) for result in with_reason)}/{len(with_reason)}" if with_reason else "-",
        f"{sum(result.resumed for result in results)}/{len(results)}",
        f"{max(result.wrong_while_good for result in results):.1f}",
        f"{bad} not good" if bad else "good",
        " ".join(reasons),
    )


def fault_summary(results: list[FaultResult]) -> dict[str, Any]:
    """Over all trials, and by fault."""
    by_name = {row.name: row for row in FAULT_ROWS}
    good = [not missed_targets(result, by_name[result.fault]) for result in results]
    return {
        "trials": len(results),
        "good": sum(good),
        "contacts": sum(result.contacts for result in results),
        "wrong_while_good_s": round(max((result.wrong_while_good for result in results), default=0.0), 2),
        "resumed": sum(result.resumed for result in results),
        "faults": {
            row.name: {
                "n": len(results_of(results, row)),
                "good": sum(not missed_targets(result, row) for result in results_of(results, row)),
                "limit_ms": row.limit,
                "missed": sorted(
                    {target for result in results_of(results, row) for target in missed_targets(result, row)}
                ),
            }
            for row in _rows(results)
        },
    }


def _ms(value: float) -> str:
    return "never" if value == inf else f"{value:.0f}"


def _lockstep(robot: str, trial: FaultTrial) -> FaultResult:
    import shared.repeatable  # noqa: F401  # a spawned process begins here
    from zenav.bench.fault_trial import lockstep

    return lockstep(robot, trial)


def _live(robot: str, trial: FaultTrial) -> FaultResult:
    from zenav.bench.fault_trial import live

    return live(robot, trial)
