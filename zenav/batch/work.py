# SPDX-License-Identifier: Apache-2.0
"""One recording of a batch: its key, its result where there is one already, or the work.

A result is a folder `results/KEY` of the output, and its `row.json` is written last. So a killed worker leaves either a
whole result or none that counts.
"""

import hashlib
import json
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, NamedTuple

from shared.config import UserError, load_robot
from zenav.batch.storage import Folder, StoredLog, content_tag, local_copy
from zenav.batch.table import Row

ROW = "row.json"


@dataclass(frozen=True, slots=True)
class SlamWork:
    """The mapper over a log. topics and frames: of a bag, empty for the best ones."""

    registrar: Literal["line", "kiss"] = "line"
    topic_scan: str = ""
    topic_odom: str = ""
    base_frame: str = ""
    odom_frame: str = ""


@dataclass(frozen=True, slots=True)
class ReplayWork:
    """A recording through services of today. services: names.  settings: as for `--set`.

    robot_text: the configuration of `robot`, for the key: a file that was edited gives other results.
    """

    services: tuple[str, ...]
    robot: str = ""
    settings: tuple[str, ...] = ()
    robot_text: str = ""


Work = SlamWork | ReplayWork


class Result(NamedTuple):
    """What a work makes of a recording: figures for the table, and files by name."""

    figures: Row
    files: dict[str, bytes]


def _short_hash(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()[:16]


def result_key(tag: str, work: Work, code: str) -> str:
    """The name of a result: SHA-256 of input, code (its hash) and configuration."""
    text = json.dumps([tag, code, type(work).__name__, asdict(work)])
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def check_work(work: Work) -> None:
    """Raises UserError where a work's services, robot or settings are wrong, whatever the recording."""
    from zenav.replay.report import apply_settings, check_services

    if isinstance(work, ReplayWork):
        check_services(work.services, work.settings)
        if work.robot:
            apply_settings(load_robot(work.robot), work.services, work.settings)


def process(work: Work, out: str, code: str, source: StoredLog) -> Row:
    """The row of a recording, from its result in `out`, or after the work, whose result is then stored there.

    code: hash of this code. A recording that the work refuses is a result too: it is refused again until input, code or
    configuration change. Where an OSError is behind it, as of a full disk, the row is failed, and is not stored.
    Raises UserError where a store does not give or take a file.
    """
    folder, tag = Folder(out), content_tag(source)
    key = result_key(tag, work, code)
    place = f"results/{key}"
    if stored := _stored_row(folder.read(f"{place}/{ROW}")):
        return {**stored, "recording": source.url, "cached": True}
    begun, cpu = time.monotonic(), time.process_time()
    row: Row = {"recording": source.url, "key": key, "input": _short_hash(tag.encode()), "state": "done", "error": ""}
    files: dict[str, bytes] = {}
    with local_copy(source.url) as path:
        try:
            figures, files = _RUN[type(work)](work, path)
            row |= figures
        except UserError as error:
            state = "failed" if isinstance(error.__context__, OSError) else "refused"
            row |= {"state": state, "error": error.what.replace(str(path), source.url)}
    row |= {"seconds": round(time.monotonic() - begun, 3), "cpu_s": round(time.process_time() - cpu, 3)}
    if row["state"] == "failed":
        return {**row, "cached": False}
    for name, content in files.items():
        folder.write(f"{place}/{name}", content)
    folder.write(f"{place}/{ROW}", json.dumps(row).encode())
    return {**row, "cached": False}


def _stored_row(content: bytes | None) -> Row:
    """The row in a `row.json`; empty where there is none, or a full disk or a crash left it damaged."""
    try:
        row = json.loads(content or b"{}")
    except ValueError:
        return {}
    return row if isinstance(row, dict) and "state" in row else {}


def run_slam(work: SlamWork, path: Path) -> Result:
    """`zenav slam` over a log: its figures, map picture, trajectory and report. Raises UserError."""
    from shared.robot_files import ROBOTS_DIR
    from zenav.convert.content import Choice
    from zenav.slam.offline_slam import config_with_registrar, offline_slam
    from zenav.stack.warm import warm_first

    warm_first(str(ROBOTS_DIR / "x80sv.yaml"), [f"mapper.registration.registrar={work.registrar}"], ["mapper"])
    choice = Choice(work.topic_scan, work.topic_odom, "", work.base_frame, work.odom_frame)
    with TemporaryDirectory(prefix="zenav-") as folder:
        report = offline_slam(path, Path(folder), config=config_with_registrar(work.registrar), choice=choice)
        files = {name: (Path(folder) / name).read_bytes() for name in ("map.png", "trajectory.tum", "report.json")}
    states = report["states"]
    figures = {
        "scans": report["scans"],
        "scans_placed": report["scans_placed"],
        "placed": report["scans_placed"] / report["scans"],
        "good": states.get("good", 0) / max(report["scans_placed"], 1),
        "quality": report["quality"]["mean"],
        "length_m": report["length_m"],
        "duration_s": report["seconds"],
        "loops": report["loops"],
        "keyframes": report["keyframes"],
        "slam_cpu_s": report["cpu_s"],
        "truncated": report["truncated"],
        "digest": _short_hash(files["trajectory.tum"]),
    }
    return Result(figures, files)


def run_replay(work: ReplayWork, path: Path) -> Result:
    """`zenav replay --through` of a recording: how it differs from what was recorded, by topic. Raises UserError.

    An exception of a service is a result, too: it repeats.
    """
    from shared.recording import Recording
    from zenav.replay.report import replay_configuration, service_builder, topic_line
    from zenav.replay.reprocess import replay_file

    recording, names = Recording(path), list(work.services)
    file = replay_configuration(recording, names, work.robot, work.settings)
    with TemporaryDirectory(prefix="zenav-") as folder:
        again = Path(folder) / "again.mcap"
        try:
            report = replay_file(path, names, again, service_builder(file), lambda done, of: None)
        except UserError:
            raise
        except Exception as error:
            raise UserError(f"a service raises {type(error).__name__}: {error}", "zenav replay --pdb") from error
        digest = _published_digest(again, names)
    rows = report.topics
    different = [row for row in rows if not row.equal]
    figures = {
        "messages": sum(row.n_equal + row.n_within + row.n_different + row.n_new for row in rows),
        "equal": sum(row.n_equal for row in rows),
        "different": sum(row.n_different for row in rows),
        "lacking": sum(row.n_lacking for row in rows),
        "new": sum(row.n_new for row in rows),
        "first": f"{different[0].key} {different[0].first}" if different else "",
        "duration_s": (report.ended - report.began) / 1e9,
        "digest": digest,
    }
    lines = [topic_line(row) for row in rows] + report.notes
    return Result(figures, {"replay.txt": "".join(f"{line}\n" for line in lines).encode()})


def _published_digest(path: Path, names: list[str]) -> str:
    """SHA-256 of all that these services publish, in the order of the recording."""
    from shared import topics
    from shared.codec import CodecError, envelope_of
    from shared.recording import Recording

    digest = hashlib.sha256()
    for entry in Recording(path).entries():
        if topics.topic_of(entry.key) in (topics.HEALTH, topics.JOURNAL):
            continue
        try:
            publisher = envelope_of(entry.payload).publisher
        except CodecError:
            continue
        if publisher in names:
            digest.update(entry.key.encode() + b"\0" + entry.payload)
    return digest.hexdigest()[:16]


_RUN: dict[type[Any], Any] = {SlamWork: run_slam, ReplayWork: run_replay}
