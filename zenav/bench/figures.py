# SPDX-License-Identifier: Apache-2.0
"""`zenav bench figures`: runs the published figures' commands, keeps what they say, and writes it into the documents.

Each part of a row leaves a file, so what was interrupted goes on there. A part counts while the committed code is the
same; with changes that are not committed, everything asked for is run.
"""

import json
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from shared.config import UserError, nearest
from shared.ros_map import replace_file
from zenav.bench.figure_cells import Report
from zenav.bench.figure_pages import write_pages
from zenav.bench.figure_rows import ROWS, FigureRow
from zenav.bench.published import (
    FILE,
    CheckoutState,
    Published,
    PublishedFigure,
    checkout_state,
    load_published,
    machine,
    save_published,
)
from zenav.console.table import show_table

Execute = Callable[[list[str], Path], int]
"""Runs a command's arguments (without `zenav`) in a folder; its exit status."""

LISTED = "row", "command", "parts", "measured on", "state"


@dataclass(frozen=True, slots=True)
class PartialRun:
    """One run of a command: what it was asked on which code, what it said, and how busy the machine was."""

    arguments: list[str]
    code: str
    dirty: bool
    report: Report
    kept: bool
    began: str
    ended: str
    seconds: float
    load: tuple[float, float]
    machine: str


@dataclass(frozen=True, slots=True)
class Bench:
    """Where figures are run and kept. data: $ZENAV_DATA, None without it; look: the checkout's state as it is now."""

    folder: Path
    data: Path | None
    state: CheckoutState
    jobs: int
    execute: Execute
    look: Callable[[], CheckoutState] = checkout_state
    file: Path = FILE
    pages: Callable[[Published], None] = write_pages

    def work(self) -> Path:
        """The folder of what is kept for the present code; another one where it has changes."""
        return self.folder / (f"{self.state.code[:12]}{'-changed' * self.state.dirty}")

    def needs(self, row: FigureRow) -> str:
        """What a row lacks here, in words; empty where it can run."""
        if not row.data:
            return ""
        if self.data is None:
            return f"needs data: set ZENAV_DATA to a folder that holds {row.data}/"
        folder = self.data / row.data
        return "" if folder.is_dir() else f"needs data: there is no {folder}"

    def arguments(self, row: FigureRow, part: str) -> list[str]:
        """A part's command without `zenav` and --out."""
        arguments = shlex.split(f"{row.command} {part} {row.hidden}")[1:]
        folder = str((self.data or Path()) / row.data)
        arguments = [folder if word == "DIR" else word.replace("{work}", str(self.work())) for word in arguments]
        return [*arguments, "--jobs", str(self.jobs)] if row.jobs else arguments

    def kept_part(self, row: FigureRow, part: str) -> PartialRun | None:
        """The part's run on the present code, if there was one and the code has no other changes."""
        path = self._path(row, part)
        if self.state.dirty or not path.exists():
            return None
        try:
            tree = json.loads(path.read_text(encoding="utf-8"))
            run = PartialRun(**tree | {"load": tuple(tree["load"])})
        except (OSError, ValueError, TypeError, KeyError):
            return None  # half a file: it is run again
        wanted = _figures_of(self.arguments(row, part))
        same = run.code == self.state.code and not run.dirty
        return run if same and _figures_of(run.arguments) == wanted else None

    def run_part(self, row: FigureRow, part: str) -> PartialRun | None:
        """Runs a part and keeps it; None where it left no report.

        Raises UserError where the code changed meanwhile: the report would be of neither state.
        """
        path = self._path(row, part)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.unlink(missing_ok=True)
        out = path.with_suffix(".out.json")
        out.unlink(missing_ok=True)
        arguments = self.arguments(row, part)
        began, busy, begun = _utc(), os.getloadavg()[0], time.monotonic()
        status = self.execute([*arguments, "--out", str(out)], path.parent)
        try:
            report: dict[str, Any] = json.loads(out.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        now = self.look()
        if (now.code, now.dirty) != (self.state.code, self.state.dirty):
            raise UserError(
                f"the code changed while {row.name} ran", "measure in a checkout of its own; finished parts are kept"
            )
        done = PartialRun(
            arguments=arguments,
            code=self.state.code,
            dirty=self.state.dirty,
            report=report,
            kept=status == 0,
            began=began,
            ended=_utc(),
            seconds=round(time.monotonic() - begun, 1),
            load=(round(busy, 2), round(os.getloadavg()[0], 2)),
            machine=machine(),
        )
        replace_file(path, (json.dumps(asdict(done)) + "\n").encode())
        out.unlink()
        return done

    def _path(self, row: FigureRow, part: str) -> Path:
        place = row.parts.index(part)
        return self.work() / row.name / f"part-{place:02}.json"


def figures(only: str, again: bool, listed: bool, folder: Path, jobs: int, data: Path | None) -> int:
    """Runs what is not measured on the present code, or shows what is; 0 when no row failed or lacks its data."""
    bench = Bench(folder.resolve(), data and data.resolve(), checkout_state(), jobs, _executed)
    rows = selected_rows(only)
    if listed:
        show_rows(bench, rows)
        return 0
    if bench.state.dirty:
        sys.stderr.write("the code has changes that are not committed: figures say so, and nothing is taken over\n")
        shutil.rmtree(bench.work(), ignore_errors=True)
    return 0 if measure_rows(bench, rows, again) else 1


def selected_rows(only: str, rows: Sequence[FigureRow] = ROWS) -> list[FigureRow]:
    """The rows of names separated by commas; all where there are none. Raises UserError on an unknown one."""
    by_name = {row.name: row for row in rows}
    names = [name.strip() for name in only.split(",") if name.strip()]
    for name in names:
        if name not in by_name:
            raise UserError(f"no row {name!r}", nearest(name, tuple(by_name)))
    return [row for row in rows if row.name in (names or by_name)]


def measure_rows(bench: Bench, rows: Sequence[FigureRow], again: bool = False) -> bool:
    """Runs the rows in order and writes each into file and documents. Returns whether all are measured now.

    A row that lacks its data or fails is reported, and the next one runs.
    """
    good = True
    for row in rows:
        if lack := bench.needs(row):
            sys.stderr.write(f"{row.name}: {lack}\n")
            good = False
        elif not again and current(bench, row, load_published(bench.file)):
            sys.stderr.write(f"{row.name}: measured on this code already\n")
        elif (entry := _row(bench, row, again)) is not None:
            published = load_published(bench.file) | {row.name: entry}
            save_published(published, bench.file)
            bench.pages(published)
        else:
            good = False
    return good


def current(bench: Bench, row: FigureRow, published: Published) -> bool:
    """Whether a row was measured by its present command on the present code, all of it committed."""
    entry = published.get(row.name)
    if entry is None or entry.dirty or bench.state.dirty:
        return False
    return entry.code == bench.state.code and entry.command == row.command


def _row(bench: Bench, row: FigureRow, again: bool) -> PublishedFigure | None:
    parts: list[PartialRun] = []
    for i, name in enumerate(row.parts):
        done = None if again else bench.kept_part(row, name)
        state = "kept from before" if done else "runs"
        sys.stderr.write(f"{row.name}, part {i + 1} of {len(row.parts)}: {state}\n")
        done = done or bench.run_part(row, name)
        if done is None:
            sys.stderr.write(f"{row.name}: failed: {shlex.join(bench.arguments(row, name))}\n")
            return None
        parts.append(done)
    return entry_of(row, parts, bench.state)


def entry_of(row: FigureRow, parts: Sequence[PartialRun], state: CheckoutState) -> PublishedFigure:
    """What all parts together say."""
    machines = " and ".join(dict.fromkeys(part.machine for part in parts))
    first, last = min(parts, key=lambda part: part.began), max(parts, key=lambda part: part.ended)
    return PublishedFigure(
        command=row.command,
        cells=row.cells([part.report for part in parts]),
        commit=state.commit,
        ended=last.ended,
        code=state.code,
        dirty=state.dirty,
        began=first.began,
        seconds=round(sum(part.seconds for part in parts), 1),
        machine=machines,
        load=(first.load[0], last.load[1]),
        kept=all(part.kept for part in parts),
    )


def show_rows(bench: Bench, rows: Sequence[FigureRow]) -> None:
    """A table of the rows: what is measured on which commit, and what would run."""
    published = load_published(bench.file)
    lines = []
    for row in rows:
        entry = published.get(row.name)
        n_kept = sum(bench.kept_part(row, part) is not None for part in row.parts)
        if current(bench, row, published):
            state = "measured on this code"
        else:
            state = bench.needs(row) or (f"{n_kept} of {len(row.parts)} parts are kept" if n_kept else "to be run")
        lines.append((row.name, row.command, str(len(row.parts)), entry.commit if entry else "-", state))
    show_table("published figures", LISTED, lines)


def _figures_of(arguments: list[str]) -> list[str]:
    """Arguments without --jobs N, which changes no figure but the time that all takes."""
    return arguments[: arguments.index("--jobs")] if "--jobs" in arguments else arguments


def _executed(arguments: list[str], folder: Path) -> int:
    """Runs zenav in a process that ends with this one; its status. Interrupting this one interrupts it."""
    command = [sys.executable, "-P", "-m", "zenav.stack.process_guard", str(os.getpid()), "zenav", *arguments]
    with subprocess.Popen(command, cwd=folder, stdin=subprocess.DEVNULL, stdout=sys.stderr) as process:
        try:
            return process.wait()
        except BaseException:
            process.terminate()
            raise


def _utc() -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S", time.gmtime())
