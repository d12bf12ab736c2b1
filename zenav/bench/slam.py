# SPDX-License-Identifier: Apache-2.0
"""`zenav bench slam`: the mapper over every log of a folder that has a reference beside it, each in a new process."""

import multiprocessing
import os
import resource
import sys
import traceback
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from shared.config import UserError, nearest
from zenav.console.json_report import check_writable, write_report
from zenav.console.run_folder import new_run_folder
from zenav.console.table import show_table
from zenav.stack.process_guard import die_with_parent

if TYPE_CHECKING:
    from services.mapper.front_end.registration import Registrar

# What maps and scores is imported in each log's own process: Linux counts a child's peak memory from its parent's.

LOGS = ".log.gz", ".log"
REFERENCES = ".relations", ".ref.tum"
TRAJECTORY = "trajectory.tum"
KINDS = "relations", "loops", "neighbours"  # of pairs; what systems are compared by comes first
COLUMNS = (
    "log, pairs", "n", "mean, m", "std", "median", "max", "rotation, deg", "CPU, s", "of jobs", "scan median, ms",
    "p99", "memory, MB", "keyframes", "loops",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class ReferenceLog:
    """A log and what it is scored against."""

    name: str
    log: Path
    references: tuple[Path, ...]


def slam(directory: Path, names: Sequence[str], out: Path | None, registrar: "Registrar" = "line") -> int:
    """Maps the logs of a folder, shows the figures, writes JSON and Markdown; 0 when all were mapped and scored."""
    logs = selected_logs(directory, names)
    markdown = out and out.with_suffix(".md")
    if out is not None and out == markdown:
        raise UserError(f"{out} is where the Markdown table goes", "call the JSON file F.json")
    check_writable(out)
    check_writable(markdown)
    folder = new_run_folder("bench-slam")
    runs: dict[str, dict[str, Any]] = {}
    for logged in logs:
        runs[logged.name] = run = map_in_process(logged, folder / logged.name, registrar)
        sys.stderr.write(f"{logged.name}: {run.get('trouble', 'done')}; {folder / logged.name}\n")
    figures = {name: summary(run) for name, run in runs.items() if "trouble" not in run}
    rows = [row for name, figure in figures.items() for row in rows_of(name, figure)]
    show_table(f"{directory}, pictures in {folder}", COLUMNS, rows)
    write_report(out, {"summary": figures, "runs": runs})
    write_markdown(markdown, rows)
    return 0 if len(figures) == len(logs) else 1


def selected_logs(directory: Path, names: Sequence[str] = ()) -> list[ReferenceLog]:
    """The folder's logs that have a reference, by name; only `names`, where there are any.

    Raises UserError where there is none, or a name is not among them.
    """
    if not directory.is_dir():
        raise UserError(f"there is no folder {directory}", "give the folder that holds the logs")
    logs: dict[str, ReferenceLog] = {}
    for suffix in LOGS:
        for log in directory.glob(f"*{suffix}"):
            name = log.name.removesuffix(suffix)
            references = tuple(path for end in REFERENCES if (path := directory / f"{name}{end}").is_file())
            if references:
                logs.setdefault(name, ReferenceLog(name, log, references))
    if not logs:
        raise UserError(
            f"{directory} holds no log with a reference", "NAME.log.gz or NAME.log, and NAME.relations or NAME.ref.tum"
        )
    for name in names:
        if name not in logs:
            raise UserError(f"{directory} holds no log {name} with a reference", nearest(name, tuple(sorted(logs))))
    return [logs[name] for name in sorted(logs) if name in (names or logs)]


def map_in_process(logged: ReferenceLog, folder: Path, registrar: "Registrar" = "line") -> dict[str, Any]:
    """`measured` in a process of its own. A process that dies gives a report with `trouble`."""
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(1, context, die_with_parent, (os.getpid(),))
    try:
        return pool.submit(map_log, logged, folder, registrar).result()
    except BrokenProcessPool:
        return {"trouble": "its process died"}
    finally:  # an interrupt does not wait for a log, which takes a minute
        for process in multiprocessing.active_children():
            process.kill()
        pool.shutdown(cancel_futures=True)


def map_log(logged: ReferenceLog, folder: Path, registrar: "Registrar" = "line") -> dict[str, Any]:
    """Maps one log into a folder: the report of `zenav slam`, the `errors` by kind of pair, peak `memory_mb`.

    Only `trouble`, what was wrong, where that failed: the other logs are to be measured all the same.
    """
    import shared.repeatable  # noqa: F401  # a spawned process begins here
    from zenav.slam.offline_slam import config_with_registrar
    from zenav.slam.offline_slam import offline_slam as mapped
    from zenav.slam.slam_error import slam_errors

    try:
        report = mapped(logged.log, folder, config=config_with_registrar(registrar))
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024  # before scoring takes some
        errors_by_kind = {
            kind: row for path in logged.references for kind, row in slam_errors(folder / TRAJECTORY, path).items()
        }
    except UserError as error:
        return {"trouble": error.what}
    except Exception as error:
        traceback.print_exc()
        return {"trouble": repr(error)}
    errors = {
        kind: {key: round(value, 5) for key, value in errors_by_kind[kind].items()}
        for kind in KINDS
        if kind in errors_by_kind
    }
    return report | {"memory_mb": round(memory, 1), "errors": errors}


def summary(run: dict[str, Any]) -> dict[str, Any]:
    """The figures of one log."""
    return {
        "errors": run["errors"],
        "scans": run["scans"],
        "length_m": run["length_m"],
        "cpu_s": run["cpu_s"],
        "cpu_s_of_jobs": run["cpu_s_of_jobs"],
        "scan_ms_median": run["cpu_ms_per_scan"]["median"],
        "scan_ms_p99": run["cpu_ms_per_scan"]["p99"],
        "memory_mb": run["memory_mb"],
        "keyframes": run["keyframes"],
        "loops": run["loops"],
    }


def rows_of(name: str, figures: dict[str, Any]) -> Iterable[tuple[str, ...]]:
    """The table's rows of one log: one for each kind of pair, what the run cost in the first."""
    cost = (
        f"{figures['cpu_s']:.1f}", f"{figures['cpu_s_of_jobs']:.1f}", f"{figures['scan_ms_median']:.2f}",
        f"{figures['scan_ms_p99']:.2f}", f"{figures['memory_mb']:.0f}", str(figures["keyframes"]),
        str(figures["loops"]),
    )  # fmt: skip
    for i, (kind, row) in enumerate(figures["errors"].items()):
        metres = (f"{row[f'trans_{key}_m']:.4f}" for key in ("mean", "std", "median", "max"))
        yield f"{name}, {kind}", str(row["n"]), *metres, f"{row['rot_mean_deg']:.3f}", *(cost if not i else [""] * 7)


def write_markdown(out: Path | None, rows: list[tuple[str, ...]]) -> None:
    """Writes the table as Markdown. Raises UserError where the file refuses."""
    if out is None:
        return
    from zenav.console.table import markdown_table

    try:
        out.write_text("\n".join(markdown_table(COLUMNS, rows)) + "\n", encoding="utf-8")
    except OSError as error:
        raise UserError(f"cannot write {out}: {error.strerror}", "choose another --out") from None
    sys.stderr.write(f"{out}\n")
