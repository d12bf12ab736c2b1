# SPDX-License-Identifier: Apache-2.0
"""`zenav bench archive`: what the plan of docs/scale.md rests on, measured here.

A drive of the stack in lockstep is recorded and uploaded. The mapper, the replay and the catalogue then read it. A
catalogue of many made-up rows is written and asked by the command. Times are of CPU, of this process or its child.
"""

import hashlib
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from shared.config import UserError
from shared.recording import Recording
from shared.types import NS_PER_S
from zenav.batch.catalogue import FOLDER, MAX_ROW_FILES, Catalogue, table_of
from zenav.batch.recording_row import recording_row
from zenav.batch.storage import Folder
from zenav.batch.table import Row
from zenav.batch.upload_stores import upload_store
from zenav.batch.uploading import FolderUpload
from zenav.batch.work import ReplayWork, SlamWork, run_replay, run_slam
from zenav.bench.batch import ended, started
from zenav.console.json_report import check_writable, write_report
from zenav.console.table import show_table
from zenav.recording.selection import begin_of, end_of
from zenav.scenario.lockstep_run import run_lockstep
from zenav.scenario.scenario import load_scenario

SERVICES = ("odometry", "mapper", "planner", "local_ctrl", "guard")
UPLOADED_BYTES = 256 << 20
N_QUERIES = 5
MAX_QUERY_S = 1.0
"""s of CPU of `zenav recording find`, process and all, over the catalogue's rows."""


def archive(out: Path | None, seconds: float, url: str, n_rows: int) -> int:
    """`zenav bench archive`; 0 when a query keeps its limit.

    seconds: of the drive.  url: to upload to, empty for a folder.  n_rows: of the catalogue. Raises UserError.
    """
    check_writable(out)
    with tempfile.TemporaryDirectory(prefix="zenav-") as name:
        folder = Path(name)
        driven = folder / "drive.mcap"
        run_lockstep(load_scenario("x80sv", "office", 0, []), seconds, driven)
        report: dict[str, Any] = {
            "recording": recording_figures(driven),
            "upload": upload_figures(folder / "uploaded", url or str(folder / "there")),
            "catalogue": catalogue_figures(folder / "catalogued", driven, n_rows),
        }
    report["kept"] = report["catalogue"]["query_cpu_s"] <= MAX_QUERY_S
    show(report)
    write_report(out, report)
    return 0 if report["kept"] else 1


def recording_figures(path: Path) -> dict[str, float]:
    """Size of a recording, and CPU time that work on it takes. Raises UserError."""
    recording = Recording(path)
    seconds = (end_of(recording) - begin_of(recording)) / NS_PER_S
    payload = sum(len(entry.payload) for entry in recording.entries())
    source = Folder(str(path.parent)).source(path.name)
    work: dict[str, Callable[[], object]] = {
        "row": lambda: recording_row(source),
        "slam": lambda: run_slam(SlamWork(), path),
        "replay": lambda: run_replay(ReplayWork(SERVICES), path),
    }
    cpu = {name: _cpu_of(function) for name, function in work.items()}
    return {
        "seconds": seconds,
        "bytes_a_second": path.stat().st_size / seconds,
        "compression": payload / path.stat().st_size,
        **{f"{name}_cpu_s_an_hour": used * 3600.0 / seconds for name, used in cpu.items()},
    }


def upload_figures(here: Path, url: str) -> dict[str, float]:
    """Time of an upload of noise, which no store compresses. Raises UserError."""
    here.mkdir()
    noise = np.random.default_rng(0)
    with (here / "noise.mcap").open("wb") as file:
        for _ in range(UPLOADED_BYTES >> 20):
            file.write(noise.bytes(1 << 20))
    store = upload_store(url, 0.0, _refuse)
    upload = FolderUpload(
        folder=here,
        patterns=("*.mcap",),
        store=store,
        say_state=lambda text: None,
        say_event=lambda level, text: None,
        wait=_refuse,
    )
    begun, cpu = time.monotonic(), time.process_time()
    upload.run()
    seconds, used = time.monotonic() - begun, time.process_time() - cpu
    return {"mb_a_second": UPLOADED_BYTES / 1e6 / seconds, "cpu_s_a_gb": used * 1e9 / UPLOADED_BYTES}


def _refuse(seconds: float) -> None:
    if seconds > 0.0:
        raise UserError("the store refuses the upload", "upload by hand to see why: zenav recording upload")


def catalogue_figures(place: Path, driven: Path, n: int) -> dict[str, float]:
    """Size of the catalogue's rows, and CPU time to merge new ones and to ask. Raises UserError."""
    place.mkdir()
    row = recording_row(Folder(str(driven.parent)).source(driven.name))
    catalogue = Catalogue(Folder(str(place)))
    catalogue.replace(table_of([_made_up(row, i) for i in range(n)]), [])
    size = sum(path.stat().st_size for path in (place / FOLDER).iterdir())
    queries = [_query(place) for _ in range(N_QUERIES)]
    new = [_made_up(row, n + i) for i in range(MAX_ROW_FILES)]
    added = _cpu_of(lambda: [*map(catalogue.add, new)])
    with_new = _query(place)
    return {
        "rows": n,
        "bytes_a_row": size / n,
        "bytes_a_new_row": len(json.dumps(new[0])),
        "query_cpu_s": median(queries),
        "query_and_merge_cpu_s": with_new,
        "add_ms_a_row": 1e3 * added / len(new),
    }


def _made_up(row: Row, i: int) -> Row:
    """The row of another recording: other name, robot, time and figures, as if driven elsewhere."""
    values = {
        "robot": f"robot{i % 500}",
        "started": row["started"] + 600_000_000 * i,
        "driven": (i * 7919 % 9973) / 10.0,
    }
    checksum = hashlib.sha256(str(i).encode()).hexdigest()
    names = {"recording": f"s3://robots/2026/robot{i % 500}-{i:08}.mcap", "sha256": checksum, "tag": checksum[:32]}
    return {**row, **names, **values, "duration": 60.0 + i * 613 % 3600, "contact": i % 97 == 0, "revision": 1}


def _query(place: Path) -> float:
    """CPU time of the command, process and all."""
    words = "robot=robot7 and contact and duration>60"
    command = [sys.executable, "-m", "zenav", "recording", "find", words, str(place), "--as-it-is", "--json"]
    return ended(started(command)).cpu


def _cpu_of(function: Callable[[], object]) -> float:
    begun = time.process_time()
    function()
    return time.process_time() - begun


def show(report: dict[str, Any]) -> None:
    """Prints the figures."""
    for title, figures in report.items():
        if isinstance(figures, dict):
            show_table(title, ("", "value"), [(name, f"{value:.4g}") for name, value in figures.items()])
    sys.stdout.write(f"a query over {report['catalogue']['rows']} rows: limit {MAX_QUERY_S:g} s of CPU\n")
