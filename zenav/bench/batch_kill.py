# SPDX-License-Identifier: Apache-2.0
"""Runs of `zenav batch` over many tiny files. At half of them the command is killed (SIGKILL), or its scheduler.

The files are no logs. So the engine alone is measured: listing, scheduling, results, and the memory of each process.
"""

import signal
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from shared.config import UserError
from zenav.batch.storage import Folder
from zenav.batch.table import last_table
from zenav.bench.batch import Started, Used, batch_command, ended, started

LOOK_S = 0.2  # between two looks at how many results there are
JOBS = 2
NO_LOG = (1,)  # status of a batch of which no file is a log
KILLED = (-signal.SIGKILL,)


def killed_run(folder: Path, n: int) -> dict[str, Any]:
    """The command is killed, and a second one does the rest.

    again: files that were computed twice, at most those in work at the kill (`in_flight`). Raises UserError.
    """
    files, place = tiny_files(folder / "killed", n), folder / "killed_out"
    first = started(batch_command(files, place, JOBS))
    _wait_for_half(place, n, first)
    killed = _kill(first)
    n_before = _n_results(place)
    resumed = ended(started(batch_command(files, place, JOBS)), NO_LOG)
    rows = last_table(Folder(str(place)))
    return {
        "rows": len(rows),
        "done_at_kill": n_before,
        "again": max(n_before - sum(bool(row["cached"]) for row in rows), 0),
        "in_flight": JOBS,
        "ms_each": 1e3 * (killed.cpu + resumed.cpu) / n,
        "peak_mb": {"command": max(killed.peak_mb, resumed.peak_mb)},
    }


def killed_scheduler(folder: Path, n: int) -> dict[str, Any]:
    """The scheduler of a Dask cluster is killed with its workers, and started again; the command goes on by itself.

    again: results that are there at the kill and were computed once more. Raises UserError.
    """
    files, place = tiny_files(folder / "scheduler", n), folder / "scheduler_out"
    with socket.create_server(("127.0.0.1", 0)) as probe:
        address = f"tcp://127.0.0.1:{probe.getsockname()[1]}"
    with _killed_at_the_end() as programs:
        cluster = _start_cluster(address, folder, programs)
        run = started([*batch_command(files, place, JOBS), "--cluster", address])
        programs.append(run)
        _wait_for_half(place, n, run)
        first = [_kill(process) for process in cluster]
        before = _result_times(place)
        cluster = _start_cluster(address, folder, programs)
        used = ended(run, NO_LOG)
        second = [_kill(process) for process in cluster]
    after, rows = _result_times(place), last_table(Folder(str(place)))
    return {
        "rows": len(rows),
        "done_at_kill": len(before),
        "again": sum(after[name] != at for name, at in before.items()),
        "in_flight": JOBS,
        "ms_each": 1e3 * (used.cpu + sum(one.cpu for one in (*first, *second))) / n,
        "peak_mb": {
            "command": used.peak_mb,
            "scheduler": max(first[0].peak_mb, second[0].peak_mb),
            "worker": max(one.peak_mb for one in (*first[1:], *second[1:])),
        },
    }


@contextmanager
def _killed_at_the_end() -> Iterator[list[Started]]:
    """Programs that do not outlive the benchmark, however it ends."""
    programs: list[Started] = []
    try:
        yield programs
    finally:
        for program in programs:
            if program.process.poll() is None:
                _kill(program)


def tiny_files(folder: Path, n: int) -> Path:
    """A folder of files that are no logs, each with another content."""
    folder.mkdir()
    for number in range(n):
        (folder / f"{number:05}.log").write_text(f"no log, number {number}\n")
    return folder


def _start_cluster(address: str, folder: Path, programs: list[Started]) -> list[Started]:
    """A scheduler, and then its workers of one thread each; adds them to the programs."""
    module = [sys.executable, "-m"]
    scheduler = started([*module, "distributed.cli.dask_scheduler", "--host", address, "--no-dashboard"])
    programs.append(scheduler)
    worker = [*module, "distributed.cli.dask_worker", address, "--nthreads", "1", "--no-dashboard", "--no-nanny"]
    worker += ["--host", "127.0.0.1", "--local-directory", str(folder)]
    _wait_until_listening(address, scheduler)
    workers = [started(worker) for _ in range(JOBS)]
    programs += workers
    _wait_for_workers(address)
    return [scheduler, *workers]


def _wait_until_listening(address: str, scheduler: Started) -> None:
    host, _, port = address.removeprefix("tcp://").partition(":")
    while scheduler.process.poll() is None:
        try:
            socket.create_connection((host, int(port))).close()
            return
        except ConnectionRefusedError:
            threading.Event().wait(LOOK_S)
    raise UserError("dask scheduler ends at once", f"run it by hand: dask scheduler --host {address}")


def _wait_for_workers(address: str) -> None:
    from distributed import Client

    with Client(address, set_as_default=False) as client:
        client.wait_for_workers(JOBS)


def _wait_for_half(place: Path, n: int, run: Started) -> None:
    while _n_results(place) < n // 2:
        if run.process.poll() is not None:
            hint = "run it by hand: zenav batch slam LOGS --out PLACE"
            raise UserError("zenav batch ends before its files are done", hint)
        threading.Event().wait(LOOK_S)


def _kill(run: Started) -> Used:
    run.process.send_signal(signal.SIGKILL)
    return ended(run, KILLED)


def _n_results(place: Path) -> int:
    return sum(1 for _ in place.glob("results/*/row.json"))


def _result_times(place: Path) -> dict[str, int]:
    return {path.parent.name: path.stat().st_mtime_ns for path in place.glob("results/*/row.json")}
