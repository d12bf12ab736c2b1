# SPDX-License-Identifier: Apache-2.0
"""Tables of README and docs/benchmarks.md, written from docs/figures.json between markers; all else is left as it is.

<!-- figures: NAME -->
what is written
<!-- end -->
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from shared.config import UserError
from shared.ros_map import replace_file
from zenav.bench import gyro, merge, slam
from zenav.bench.faults import COLUMNS as FAULT_COLUMNS
from zenav.bench.figure_cells import README, SIZES
from zenav.bench.figure_rows import ROWS
from zenav.bench.published import ROOT, Published, PublishedFigure
from zenav.console.table import markdown_table

PAGES = "README.md", "docs/benchmarks.md"
MARKED = re.compile(r"(<!-- figures: ([\w-]+) -->\n).*?(<!-- end -->\n)", re.DOTALL)
MISSING = "not measured yet"

PEERS: dict[str, tuple[str, ...]] = {
    "intel": ("0.025 - 0.027", "0.416", "0.0216 - 4.1", "1.03", "0.0229", "0.031", "0.070"),
    "fr079": ("0.051", "0.176", "0.0466", "0.43", "0.0452", "0.056", "0.061"),
    "fr079-raw": ("0.94 - 2.6", "2.7", "1.9", "0.050 - 0.29", "-", "-", "-"),
    "aces": ("0.046", "0.048", "0.042", "0.36", "0.0375", "0.044", "0.060"),
    "intel-sparse": ("0.069", "0.436", "-", "16", "-", "-", "-"),
    "aces-sparse": ("1.37", "0.295", "-", "5.3", "-", "-", "-"),
    "edmonton": ("0.168", "0.253", "-", "0.054", "-", "-", "-"),
    "belgioioso": ("0.061", "0.141", "-", "4.9", "-", "-", "-"),
    "fhw": ("0.083", "0.292", "2.59", "2.0", "-", "-", "-"),
    "fr-clinic": ("0.72", "0.39", "2.6", "0.375", "0.108 on its local pairs", "-", "-"),
}
"""What others reach, m: run once on the same logs with the same measure; the last three columns are published."""
PEER_COLUMNS = (
    "GMapping", "slam_toolbox's Karto", "Cartographer", "kiss-icp with odometry, no loops", "Cartographer, published",
    "graph mapping, published", "RBPF, published",
)  # fmt: skip
ABOUT_LOGS = {
    "fr079-raw": "its odometry counts distance without direction",
    "fr-clinic": "outdoors, ranges to 81 m",
}
INTEL_PEERS = (
    ("Cartographer, one scan a second", "0.0216", "188"),
    ("Cartographer, all scans", "4.1", "1027"),
    ("Karto, 1314 scans kept", "0.416", "18"),
    ("kiss-icp with odometry, no loops", "1.03", "11"),
    ("GMapping, several runs", "0.025 - 0.027", "59 - 142"),
)
"""Error, m, and CPU, s, of the same run; of GMapping it is not known which run took how long."""


@dataclass(frozen=True, slots=True)
class TablePosition:
    """A table in a document. head: its columns; rows: whose cells under the place's name fill it, in this order."""

    head: tuple[str, ...]
    rows: tuple[str, ...]


PLACES: dict[str, TablePosition] = {
    "slam-line": TablePosition(slam.COLUMNS, ("slam",)),
    "buildings": TablePosition(
        (
            "building", "rooms", "not reached", "contacts", "driven, m", "pose, cm", "max", "keyframes, cm",
            "map in 5 cm, %", "aligned, %", "complete, %", "CPU, s",
        ),
        ("buildings",),
    ),
    "localise": TablePosition(
        (
            "maps", "poses", "found in 10 m", "median, m", "p95", "off when found, cm", "wrongly sure",
            "noticed in 3 s", "median, s", "back in 10 m", "median, m",
        ),
        ("localise", "localise-ros-5cm", "localise-ros-10cm"),
    ),
    "plan": TablePosition(
        ("CPU ms a query, median / p99", *SIZES, "solved", "touch a blocked cell", "length / shortest"), ("plan",)
    ),
    "plan-buildings": TablePosition(
        (
            "building", "planner", "median / p99, ms", "length, m", "mean clearance, m", "least clearance, m",
            "length / shortest at its least clearance", "at equal clearance", "sharpest turn, deg",
        ),
        ("plan",),
    ),
    "barn": TablePosition(
        (
            "what was added to `zenav bench barn`", "runs", "success", "collisions", "of these standing", "time-outs",
            "mean time, s", "score", "least clearance, m",
        ),
        ("barn", "barn-noise", "crowd", "crowd-unseen"),
    ),
    "stack": TablePosition(("ms", "p50", "p95", "p99", "max"), ("stack",)),
    "odometry": TablePosition(
        ("integration, from", "off at most, mm", "at the end, mm", "turned off at most, deg"), ("odometry",)
    ),
    "merge": TablePosition(merge.COLUMNS, ("merge",)),
    "gyro": TablePosition(gyro.COLUMNS, ("gyro",)),
    "faults": TablePosition(FAULT_COLUMNS, ("faults",)),
    "faults-dark": TablePosition(FAULT_COLUMNS, ("faults-dark",)),
    "faults-live": TablePosition(FAULT_COLUMNS, ("faults-live",)),
    "soak": TablePosition(
        (
            "what was added to `zenav bench soak`", "goals reached", "failed", "faults", "contacts",
            "zero command, s at most", "standing, s", "did not drive on", "most growth",
            "p99 of scan to `cmd/vel`, ms, or CPU, ms in each s", "walls, m", "pose, m", "recordings, MB",
            "limits missed",
        ),
        ("soak-hour", "soak", "soak-faults"),
    ),
}  # fmt: skip


def write_pages(published: Published, root: Path = ROOT) -> None:
    """Writes the tables into the documents. Raises UserError where a document names a table that there is not."""
    for page in PAGES:
        path = root / page
        text = path.read_text(encoding="utf-8")
        now = page_with_tables(text, published)
        if now != text:
            replace_file(path, now.encode())


def page_with_tables(text: str, published: Published) -> str:
    """A document's text with what stands between its markers written from the figures. Raises UserError."""

    def written(match: re.Match[str]) -> str:
        if match[2] not in TABLES:
            raise UserError(f"no figures are called {match[2]!r}", f"known: {', '.join(TABLES)}")
        return match[1] + "\n".join(["", *TABLES[match[2]](published), "", ""]) + match[3]

    return MARKED.sub(written, text)


def tables_in(text: str) -> list[str]:
    """The names of a document's markers."""
    return [match[2] for match in MARKED.finditer(text)]


def _measured(published: Published) -> list[str]:
    """README's table: every row that has words for it."""
    lines: list[tuple[str, ...]] = []
    for row in ROWS:
        entry = published.get(row.name)
        figure = entry.cells.get(README, [[MISSING]])[0][0] if entry else MISSING
        command = entry.command if entry else row.command
        if row.what:
            lines.append((row.what, figure, f"`{command}`", when_measured(entry, len(row.parts)) if entry else "-"))
    machines = dict.fromkeys(entry.machine for entry in published.values() if entry.machine)
    footnote = (
        [f"Load is the machine's average of a minute at begin and end: {' and '.join(machines)}."] if machines else []
    )
    return [
        *markdown_table(("what", "figure", "command", "commit, date, load"), lines),
        *([""] if footnote else []),
        *footnote,
    ]


def when_measured(entry: PublishedFigure, n_parts: int = 1) -> str:
    """Commit, date and load of a row, in a cell."""
    parts = [f"`{entry.commit}`" + (" with uncommitted changes" if entry.dirty else ""), entry.ended[:10]]
    parts.append(f"load {entry.load[0]:.1f} to {entry.load[-1]:.1f}")
    missed = "missed its target" if n_parts == 1 else "a part missed its target"
    return ", ".join([*parts, *([] if entry.kept else [missed])])


def _table_of(name: str, published: Published) -> list[str]:
    """A place's table, with where each row is from below it."""
    place = PLACES[name]
    lines = [tuple(cells) for row in place.rows if row in published for cells in published[row].cells.get(name, [])]
    return [*markdown_table(place.head, lines), "", *_sources(place.rows, published)]


def _sources(names: tuple[str, ...], published: Published) -> list[str]:
    """A line a row: command, commit, date, machine, load."""
    parts = {row.name: len(row.parts) for row in ROWS}
    commands = {row.name: row.command for row in ROWS}
    lines = []
    for name in names:
        entry = published.get(name)
        if entry is None:
            lines.append(f"- `{commands[name]}`: {MISSING}")
        else:
            about = f"; {entry.machine}; {entry.seconds:.0f} s" if entry.machine else "; machine and load are not known"
            lines.append(f"- `{entry.command}`: {when_measured(entry, parts[name])}{about}")
    return lines


def _comparison(published: Published) -> list[str]:
    """The logs by this mapper, with both registrars, and by others."""
    ours = [_by_log(published, name) for name in ("line", "kiss")]
    lines = []
    for log, peers in PEERS.items():
        name = f"{log} ({ABOUT_LOGS[log]})" if log in ABOUT_LOGS else log
        lines.append((name, *(by_log[log][0] if log in by_log else "-" for by_log in ours), *peers))
    head = "mean error, m", "zenav", "zenav with `--registrar kiss`", *PEER_COLUMNS
    return [*markdown_table(head, lines), "", *_sources(("slam", "slam-kiss"), published)]


def _registrars(published: Published) -> list[str]:
    """Both registrars: error and cost of the same run."""
    ours = [_by_log(published, name) for name in ("line", "kiss")]
    lines = [(log, *(cell for by_log in ours for cell in by_log.get(log, ("-", "-", "-")))) for log in PEERS]
    head = "log", "`line`: mean, m", "max, m", "CPU, s", "`kiss`: mean, m", "max, m", "CPU, s"
    return markdown_table(head, lines)


def _intel(published: Published) -> list[str]:
    """Error and CPU time of the same run on one log."""
    ours = [
        (name, by_log["intel"][0], by_log["intel"][2])
        for name, key in (("zenav", "line"), ("zenav with `--registrar kiss`", "kiss"))
        if "intel" in (by_log := _by_log(published, key))
    ]
    return markdown_table(("intel", "mean error, m", "CPU, s"), [*ours, *INTEL_PEERS])


def _by_log(published: Published, registrar: str) -> dict[str, tuple[str, ...]]:
    """Mean and largest error, m, and CPU, s, by log."""
    entry = published.get("slam" if registrar == "line" else "slam-kiss")
    return {log: tuple(cells) for log, *cells in entry.cells.get(f"beside-{registrar}", [])} if entry else {}


TABLES: dict[str, Callable[[Published], list[str]]] = {
    README: _measured,
    "beside": _comparison,
    "registrars": _registrars,
    "intel": _intel,
    **{name: partial(_table_of, name) for name in PLACES},
}
