# SPDX-License-Identifier: Apache-2.0
"""`zenav slam` and `zenav convert`: files in, files out, with progress for people."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from shared.config import UserError

if TYPE_CHECKING:
    from zenav.convert.content import Choice

NOTICED = 0.05  # s between odometry and laser, from which a note is printed


@contextmanager
def progress_bar(text: str) -> Iterator[Callable[[float], None]]:
    """A function that shows the share that is done, 0..1, on a terminal."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = TextColumn(text), BarColumn(), TaskProgressColumn(), TimeRemainingColumn()
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task(text, total=1.0)
        yield lambda share: progress.update(task, completed=share)


def slam(
    log: Path,
    out: Path,
    mode: Literal["map", "localise", "continue"],
    saved_map: Path | None,
    choice: "Choice",
    registrar: Literal["line", "kiss"] = "line",
) -> None:
    """The mapper over a log; writes into `out` and says what came of it."""
    if not log.exists():
        raise UserError(f"there is no log {log}", "give the path of a CARMEN log, a bag or a recording")
    from zenav.slam import registering
    from zenav.slam import slam as run

    with progress_bar(log.name) as progress:
        report = run(log, out, progress, registering(registrar), mode=mode, saved_map=saved_map, choice=choice)
    sys.stdout.write(
        f"{out}/map.png: {report['scans_placed']} of {report['scans']} scans, {report['length_m']:.1f} m, "
        f"{report['loops']} loops closed, {report['cpu_s']:.1f} s of CPU\n"
    )
    lag = report["odometry_lag_s"]
    if lag is not None and abs(lag) >= NOTICED:
        sys.stdout.write(f"odometry tells {abs(lag):.2f} s {'later' if lag > 0 else 'sooner'} than the laser\n")
    if report["truncated"]:
        sys.stderr.write(f"{log} ends early: its rest is missing, the map is of what came before\n")
    for note in report["notes"]:
        sys.stderr.write(f"{note}\n")
    for unit in ("lines", "messages"):
        if n := report.get(f"bad_{unit}", 0):
            sys.stderr.write(f"{log}: {n} {unit} could not be read and were left out\n")


def convert(source: Path, out: Path, to: str, choice: "Choice", trajectory: str, force: bool) -> None:
    """A file in another format; says what went into it."""
    from zenav.convert.export import convert as run

    with progress_bar(source.name) as progress:
        counts, notes = run(source, out, to, choice, trajectory, force, progress)
    sys.stdout.write(f"{out}: {', '.join(f'{n} {name}' for name, n in counts.items() if n)}\n")
    for note in notes:
        sys.stderr.write(f"{note}\n")
