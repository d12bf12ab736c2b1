# SPDX-License-Identifier: Apache-2.0
"""Behind `zenav convert`: the formats that are written, and a file that appears whole or not at all."""

import gzip
import os
import shutil
import sqlite3
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from io import StringIO
from math import cos, sin
from pathlib import Path

from ruamel.yaml import YAML

from shared.codec import Envelope, encode
from shared.config import UserError, nearest
from shared.file_modes import FILE_MODE, FOLDER_MODE
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import LaserScan, MapUpdate, Odometry, PoseEstimate, Truth
from shared.recording import CONFIG, Recording, Writer, about
from shared.topics import BY_KEY
from zenav.convert.carmen import carmen_lines
from zenav.convert.content import Choice, log_of
from zenav.convert.conversion import Conversion
from zenav.convert.records import LoggedScan
from zenav.convert.ros_export import write_ros1, write_ros2, write_ros2_sqlite
from zenav.convert.source import read_content
from zenav.convert.stack_log import is_recording
from zenav.recording.selection import check_not_written

LATEST = 2**31 * 10**9  # ns: what ROS has no stamp for is damage
TRAJECTORIES = "pose", "odom", "truth"


@dataclass(frozen=True, slots=True)
class ExportFormat:
    """suffixes: of the files that are taken for this format.   write: writes `Conversion.out`; counts by what it wrote.

    folder: a name without a suffix is taken for it.
    """

    about: str
    suffixes: tuple[str, ...]
    write: Callable[[Conversion], Counter[str]]
    folder: bool = False


def convert(
    source: Path,
    out: Path,
    to: str,
    choice: Choice,
    trajectory: str,
    force: bool,
    progress: Callable[[float], None] = lambda share: None,
) -> tuple[Counter[str], list[str]]:
    """Writes what `source` holds as `out`, in the format `to` or, where that is "", the one that its name says.

    Returns how many messages went where, and what people must know. Raises UserError; then nothing was written.
    """
    chosen = FORMATS[format_name(to, out)]
    _check(source, out, force)
    content = read_content(source, choice)
    n_read = len(content.messages)
    content.messages = [row for row in content.messages if row[1].stamp < LATEST]
    content.n_bad += n_read - len(content.messages)
    try:
        with tempfile.TemporaryDirectory(prefix=f".{out.name}.", dir=out.parent) as folder:
            fresh = Path(folder) / out.name
            counts = chosen.write(Conversion(source, content, fresh, trajectory, progress))
            if not sum(counts.values()):
                raise UserError(f"{source}: nothing in it for {chosen.about}", content.lacks or "take another format")
            _close_to_others(fresh)
            if (fresh / "map.yaml").is_file() and (out / "map.yaml").is_file():
                _put_map(fresh, out)
            else:
                _put(fresh, out)
    except (OSError, sqlite3.Error) as error:
        cause = getattr(error, "strerror", None) or error
        raise UserError(f"cannot write {out}: {cause}", "check the path and the disk") from None
    progress(1.0)
    notes = list(content.notes)
    if content.n_bad:
        notes.append(f"{source}: {content.n_bad} messages could not be read and were left out")
    return counts, notes


def format_name(to: str, out: Path) -> str:
    """The format's name: `to`, or by the file's name. Raises UserError where there is none."""
    if to:
        if to not in FORMATS:
            raise UserError(f"{to} is not a format", nearest(to, tuple(FORMATS)))
        return to
    for name, format_ in FORMATS.items():
        if (out.suffix and out.name.endswith(format_.suffixes)) or (format_.folder and not out.suffix):
            return name
    raise UserError(f"the name {out.name} has no known format", f"give the format: --to {', '.join(FORMATS)}")


def _check(source: Path, out: Path, force: bool) -> None:
    if not source.exists():
        raise UserError(f"there is no {source}", "give the path of a CARMEN log, a bag or a recording")
    if not out.parent.is_dir():
        raise UserError(f"there is no folder {out.parent}", "make it first")
    if not out.exists():
        return
    if out.samefile(source) or (source.is_dir() and source.resolve() in out.resolve().parents):
        raise UserError(f"{out} is what is to be read", "choose another name")
    if out.resolve() in source.resolve().parents:
        raise UserError(f"{out} is the folder of what is to be read", "choose another name")
    if not force:
        raise UserError(f"{out} exists", "choose another name, or overwrite it: --force")
    check_not_written(out)
    if out.is_dir() and not any((out / name).is_file() for name in ("metadata.yaml", "map.yaml")):
        raise UserError(f"{out} is a folder, and neither a bag nor a map", "choose another name: it stays")


def _close_to_others(fresh: Path) -> None:
    """Gives a new file, or a folder and what is in it, the modes of shared/file_modes.py: packages have their own."""
    for path in (fresh, *fresh.rglob("*")):
        path.chmod(path.stat().st_mode & (FOLDER_MODE if path.is_dir() else FILE_MODE))


def _put(fresh: Path, out: Path) -> None:
    """Gives a finished file or folder its name; what has it now goes first, where it is a folder."""
    if out.is_dir():
        old = fresh.with_name("old")
        os.rename(out, old)
        try:
            os.rename(fresh, out)
        except OSError:
            os.rename(old, out)
            raise
        shutil.rmtree(old, ignore_errors=True)
    elif fresh.is_dir() and out.exists():
        out.unlink()
        os.rename(fresh, out)
    else:
        os.replace(fresh, out)


def _put_map(fresh: Path, out: Path) -> None:
    """Replaces a map in its folder, where zones, places and other files stay. A pose graph is of the former map."""
    from zenav.maps.atomic_folder import replace_together
    from zenav.maps.saved_map import GRAPH  # the mapper behind it takes long to load

    replace_together(out, {GRAPH: b""} | {path.name: path.read_bytes() for path in fresh.iterdir()})


# --- the formats that need few words --------------------------------------------------------------------------------


def _recording(task: Conversion) -> Counter[str]:
    """Writes a recording of the stack, with the log's robot, so that services replay it."""
    if not task.source.is_dir() and is_recording(task.source):
        raise UserError(f"{task.source} is a recording of the stack already", "take another format: --to ros2")
    from zenav.convert.log_robot import robot_of_log  # the mapper behind it takes long to load

    scans = [record for record in log_of(task.content).records if isinstance(record, LoggedScan)]
    attachments = {}
    if scans:
        text = StringIO()
        YAML(typ="safe").dump({"robot": robot_of_log(scans).model_dump(mode="json")}, text)
        attachments[CONFIG] = text.getvalue().encode()
    counts: Counter[str] = Counter()
    with Writer(task.out, {**about("log"), "converted": task.source.name}, attachments) as writer:
        for key, message in task.messages():
            topic = BY_KEY[key]
            sent = message.stamp + (round(message.scan_time * 1e9) if isinstance(message, LaserScan) else 0)
            payload = encode(message, Envelope(topic.publishers[0], "converted", counts[key], sent))
            writer.write(key, topic.type, payload, sent, sent, counts[key])
            counts[key] += 1
    return counts


def _tum(task: Conversion) -> Counter[str]:
    """`stamp x y z qx qy qz qw` a line: of the pose on the map, of odometry, or of the simulator's truth."""
    rows: dict[str, list[tuple[int, Pose2]]] = {name: [] for name in TRAJECTORIES}
    for _, message in task.messages():
        if isinstance(message, PoseEstimate):
            rows["pose"].append((message.stamp, message.map_from_base))
        elif isinstance(message, Odometry):
            rows["odom"].append((message.stamp, message.odom_from_base))
        elif isinstance(message, Truth):
            rows["truth"].append((message.stamp, message.start.inverse() @ message.world_from_base))
    chosen = task.trajectory or next((name for name in TRAJECTORIES if rows[name]), "pose")
    if not rows[chosen]:
        there = ", ".join(name for name in TRAJECTORIES if rows[name]) or "none"
        raise UserError(f"{task.source}: no {chosen} in it", f"trajectories that it has: {there}")
    with task.out.open("w") as file:
        for stamp, pose in rows[chosen]:
            file.write(
                f"{stamp // 10**9}.{stamp % 10**9:09d} {pose.x:.9f} {pose.y:.9f} 0 0 0 "
                f"{sin(pose.yaw / 2):.12f} {cos(pose.yaw / 2):.12f}\n"
            )
    return Counter({chosen: len(rows[chosen])})


def _carmen(task: Conversion) -> Counter[str]:
    log = log_of(task.content)
    opened = gzip.open if task.out.name.endswith(".gz") else open
    with opened(task.out, "wt") as file:
        file.writelines(carmen_lines(log))
    n_scans = sum(isinstance(record, LoggedScan) for record in log.records)
    return Counter({"ROBOTLASER1": n_scans, "ODOM": len(log.records) - n_scans})


def _map(task: Conversion) -> Counter[str]:
    """The last map of a recording, as `zenav map load` and ROS's map_server take it."""
    grid = OccupancyGrid()
    n = 0
    for _, message in task.messages():
        if isinstance(message, MapUpdate):
            grid.apply(message)
            n += 1
    if n:
        from zenav.maps.map_files import write_map  # with Zenoh behind it

        write_map(grid, task.out)
    return Counter({"map updates": n})


def _foxglove(task: Conversion) -> Counter[str]:
    """What Foxglove opens; of a foreign log by way of a recording of the stack."""
    from zenav.convert.foxglove import to_foxglove  # its package takes long to load

    if not task.source.is_dir() and is_recording(task.source):
        recording = task.source
    else:
        recording = task.out.with_name(f"{task.out.name}.zenav")
        _recording(replace(task, out=recording))
    counts, notes = to_foxglove(Recording(recording), task.out, task.progress)
    task.content.notes += notes
    return counts


FORMATS = {
    "ros2": ExportFormat("a ROS 2 bag, MCAP storage", (), write_ros2, folder=True),
    "ros2-sqlite": ExportFormat("a ROS 2 bag, sqlite3 storage", (), write_ros2_sqlite),
    "ros1": ExportFormat("a ROS 1 bag", (".bag",), write_ros1),
    "zenav": ExportFormat("a recording of the stack", (".mcap",), _recording),
    "tum": ExportFormat("a trajectory for evo", (".tum", ".txt"), _tum),
    "carmen": ExportFormat("a CARMEN log", (".log", ".log.gz", ".clf"), _carmen),
    "foxglove": ExportFormat("what Foxglove opens", (), _foxglove),
    "map": ExportFormat("a map's folder, for map_server", (), _map),
}
"""By the name that --to takes; the first whose suffix fits is taken for a file's name."""
