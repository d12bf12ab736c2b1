# SPDX-License-Identifier: Apache-2.0
"""`zenav bench plan`: the planner over maps with known optima and over real buildings, beside others."""

import os
from pathlib import Path
from typing import Any

from shared.config import UserError, load_robot
from zenav.bench.plan.buildings import building_maps, building_rows
from zenav.bench.plan.maps import SIZES, read_movingai_maps
from zenav.bench.plan.measure import PlannerRow, movingai_rows
from zenav.console.json_report import check_writable, write_report
from zenav.console.table import show_table

MAX_MS = {256: (0.12, 0.6), 512: (0.4, 4.0), 1024: (2.0, 20.0), 4096: (10.0, 350.0)}
"""What the planner is to keep, costs included: CPU ms, median and p99."""

MAX_LENGTH_RATIO = 1.010  # times the shortest path of all, free and blocked, in the mean of a class
MAX_EQUAL_RATIO = 1.05  # times the shortest path of the same clearance, in the mean of a building
MAX_TILE_MS = 10.0  # of CPU for a tile's update, median
COLUMNS = (
    "planner", "n", "median, ms", "p99", "solved", "touched", "of the shortest", "max", "same clearance", "mean, m",
    "clearance, m", "least, m", "turn",
)  # fmt: skip


def plan(directory: Path | None, limit: int, robot: str, out: Path | None) -> int:
    """Measures, shows the tables, writes the JSON; 0 when every promise was kept."""
    check_writable(out)
    folder = directory or _default_folder()
    body = load_robot(robot).robot
    classes: dict[int, dict[str, PlannerRow]] = {size: {} for size in SIZES}
    by_map: dict[str, Any] = {}
    benchmarks, left_out = read_movingai_maps(folder / "movingai", limit)
    for benchmark in benchmarks:
        rows, missing = movingai_rows(benchmark, body)
        left_out += [*benchmark.notes, *missing]
        by_map[benchmark.name] = {name: row.summary() for name, row in rows.items()}
        for name, row in rows.items():
            classes[benchmark.size].setdefault(name, PlannerRow()).add(row)
    summary: dict[str, Any] = {}
    for size, rows in classes.items():
        summary[str(size)] = _show_rows(f"Moving AI, up to {SIZES[size]} cells, class {size}", rows)
    for path in building_maps(folder / "ros_maps"):
        try:
            rows = building_rows(path, body)
        except UserError as error:
            left_out.append(f"{path.stem}: left out, {error.what}")
            continue
        if rows:
            summary[path.stem] = _show_rows(f"{path.stem}, {robot}", rows)
    if left_out:
        show_table("left out", ("",), [(line,) for line in left_out])
    broken = _missed_targets(summary)
    if broken:
        show_table("not kept", ("",), [(line,) for line in broken])
    write_report(out, {"summary": summary, "not_kept": broken, "left_out": left_out, "maps": by_map})
    return 1 if broken else 0


def _default_folder() -> Path:
    data = os.environ.get("ZENAV_DATA")  # noqa: TID251  # only the environment has the folder of benchmark data
    if not data:
        raise UserError("there is no folder of maps", "give DIR with movingai/ and ros_maps/, or set ZENAV_DATA")
    return Path(data) / "planning"


def _show_rows(title: str, rows: dict[str, PlannerRow]) -> dict[str, Any]:
    summaries = {name: row.summary() for name, row in rows.items()}
    if summaries:
        show_table(title, COLUMNS, [_line(name, row) for name, row in summaries.items()])
    return summaries


def _line(name: str, row: dict[str, Any]) -> tuple[str, ...]:
    def number(key: str, digits: int) -> str:
        return f"{row[key]:.{digits}f}" if key in row else "-"

    return (
        name, str(row["n"]), number("ms_median", 3), number("ms_p99", 2), number("solved", 3), str(row["touched"]),
        number("length", 4), number("length_max", 3), number("equal", 4), number("path_m", 2),
        number("clearance_mean_m", 3), number("clearance_least_m", 3), number("turn_deg", 1),
    )  # fmt: skip


def _missed_targets(summary: dict[str, Any]) -> list[str]:
    """The promises that were not kept, one line each."""
    lines = []
    for size, (median, p99) in MAX_MS.items():
        rows = summary[str(size)]
        if (raw := rows.get("raw, exact 8-connected")) and raw["wrong"] > 0:
            lines.append(f"{size}: raw lengths are not the published ones: {raw['wrong'] * raw['n']:.0f}")
        if (timed := rows.get("ours, with costs")) and (timed["ms_median"] > median or timed["ms_p99"] > p99):
            lines.append(f"{size}: {timed['ms_median']} / {timed['ms_p99']} ms, to be kept {median} / {p99}")
        if (free := rows.get("ours, free and blocked")) and free.get("length", 1.0) > MAX_LENGTH_RATIO:
            lines.append(f"{size}: {free['length']} of the shortest length, to be kept {MAX_LENGTH_RATIO}")
        if (tile := rows.get("a tile's update")) and tile["ms_median"] > MAX_TILE_MS:
            lines.append(f"{size}: {tile['ms_median']} ms a tile's update, to be kept {MAX_TILE_MS}")
    for where, rows in summary.items():
        for name, row in rows.items():
            if name.startswith("ours") and (row["solved"] < 1 or row["touched"]):
                lines.append(f"{where}, {name}: solved {row['solved']}, {row['touched']} touch a blocked cell")
            if row.get("equal", 1.0) > MAX_EQUAL_RATIO:
                lines.append(
                    f"{where}, {name}: {row['equal']} of the shortest of its clearance, to be kept {MAX_EQUAL_RATIO}"
                )
    return lines
