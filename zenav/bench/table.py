# SPDX-License-Identifier: Apache-2.0
"""What benchmarks share: seeds as people write them, a table, a JSON file with a `summary`; and `zenav bench sim`."""

import json
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from shared.config import UserError

PROMISED = 50.0  # times real time: the simulator with 720 beams at 40 Hz in 1000 x 1000 cells


def seeds_from(text: str, what: str = "seeds") -> list[int]:
    """The numbers of `0-9`, `3` or `0,4,7-9`, in order. Raises UserError on anything else."""
    found: list[int] = []
    for part in text.split(","):
        low, dash, high = part.strip().partition("-")
        if not low.isdigit() or (dash and not high.isdigit()):
            raise UserError(f"{text!r} names no {what}", "write 3, 0-9 or 0,4,7-9")
        found += range(int(low), int(high or low) + 1)
    if not found:
        raise UserError(f"{text!r} names no {what}", "the smaller number comes first, like 0-9")
    return list(dict.fromkeys(found))


def table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> None:
    """Shows a table on stdout; the first column is a name, the others are numbers."""
    from rich.console import Console
    from rich.table import Table

    shown = Table(title=title, title_justify="left", box=None, pad_edge=False)
    for i, column in enumerate(columns):
        shown.add_column(column, justify="right" if i else "left", overflow="fold")
    for row in rows:
        shown.add_row(*row)
    console = Console()
    if not console.is_terminal:
        console.width = 160  # a log's lines do not wrap
    console.print(shown)


def writable(out: Path | None) -> None:
    """Looks, before hours of measuring, whether the report can be written. Raises UserError where it cannot."""
    if out is None:
        return
    there = out.exists()
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with out.open("a"):
            pass
        if not there:
            out.unlink()
    except OSError as error:
        raise UserError(f"cannot write {out}: {error.strerror}", "choose another --out") from None


def write(out: Path | None, report: dict[str, Any]) -> None:
    """Writes the report as JSON. Raises UserError where the file refuses."""
    if out is None:
        return
    try:
        out.write_text(json.dumps(report, indent=2) + "\n")
    except OSError as error:
        raise UserError(f"cannot write {out}: {error.strerror}", "choose another --out") from None
    sys.stderr.write(f"{out}\n")


def sim(out: Path | None) -> int:
    """`zenav bench sim`; 0 when the simulator is as fast as promised."""
    from zenav.bench.sim import run

    writable(out)
    report = run()
    rows = [
        (name, f"{row['ratio']:.0f}", f"{row['cpu_ms_a_second']:.2f}", f"{row['scans_a_second']:.0f}")
        for name, row in report["rows"].items()
    ]
    table("the simulator on one core", ("world", "times real time", "CPU, ms a second", "scans a second"), rows)
    write(out, report)
    return 0 if report["summary"]["ratio"] >= PROMISED else 1
