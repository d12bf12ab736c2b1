# SPDX-License-Identifier: Apache-2.0
"""CARMEN logs: text, one message a line, gzipped or not. Source: CARMEN's logger_io."""

import gzip
import zlib
from collections.abc import Callable, Iterator
from functools import partial
from math import isfinite, pi, radians
from pathlib import Path

import numpy as np

from shared.config import UserError
from shared.geometry import Pose2
from shared.types import Float32s
from zenav.convert.records import DriveLog, LoggedPose, LoggedScan

MAX_LINE = 1 << 20  # bytes; a longer one is no scan
BOUND = 1e6  # m, rad, s: farther is a damaged number (stamps: 1e10 s, the year 2286)


def read_carmen(path: Path) -> DriveLog:
    """Reads ODOM, FLASER and ROBOTLASER1 lines; others are skipped, and damaged ones are counted.

    Raises UserError where the file cannot be read at all.
    """
    log = DriveLog([])
    try:
        for line in _lines(path, log):
            kind, _, rest = line.partition(" ")
            reader = READERS.get(kind)
            if reader is None:
                continue
            try:
                log.records.append(reader(rest.split()))
            except (ValueError, IndexError):
                log.n_bad += 1
    except OSError as error:
        raise UserError(
            f"cannot read {path}: {error.strerror or error}", "check the path and its permissions"
        ) from None
    return log


def _lines(path: Path, log: DriveLog) -> Iterator[str]:
    with path.open("rb") as raw:
        zipped = raw.read(2) == b"\x1f\x8b"
    with gzip.open(path, "rb") if zipped else path.open("rb") as file:
        try:
            for line in iter(partial(file.readline, MAX_LINE), b""):
                yield line.decode("ascii", "replace").strip()
        except (EOFError, zlib.error, gzip.BadGzipFile):
            log.truncated = True


def _odom(cells: list[str]) -> LoggedPose:
    x, y, yaw, v, w = _numbers(cells[:5], 5)
    return LoggedPose(_stamp(cells[6]), Pose2(x, y, yaw), v, w)


def _flaser(cells: list[str]) -> LoggedScan:
    n = _count(cells[0])
    ranges = _ranges(cells[1 : 1 + n], n)
    x, y, yaw, base_x, base_y, base_yaw = _numbers(cells[1 + n : 7 + n], 6)
    # 181 and 361 beams hold both ends of the half circle, 180 and 360 leave out the last
    increment = radians(1.0) if n < 270 else radians(0.5)
    if n not in (180, 181, 360, 361):
        increment = pi / (n - 1)
    return LoggedScan(
        stamp=_stamp(cells[7 + n]),
        odom_from_base=Pose2(base_x, base_y, base_yaw),
        odom_from_laser=Pose2(x, y, yaw),
        angle_min=-pi / 2,
        angle_increment=increment,
        range_max=0.0,
        ranges=ranges,
    )


def _robotlaser(cells: list[str]) -> LoggedScan:
    start, _, increment, range_max = _numbers(cells[1:5], 4)
    n = _count(cells[7])
    ranges = _ranges(cells[8 : 8 + n], n)
    rest = cells[9 + n + _count(cells[8 + n], minimum=0) :]
    x, y, yaw, base_x, base_y, base_yaw, v, w = _numbers(rest[:8], 8)
    if abs(start) > 2 * pi or increment == 0 or abs(increment) * (n - 1) > 2 * pi + 1e-3 or not 0 < range_max <= 250:
        raise ValueError("a scan of no angles")
    return LoggedScan(
        stamp=_stamp(rest[11]),
        odom_from_base=Pose2(base_x, base_y, base_yaw),
        odom_from_laser=Pose2(x, y, yaw),
        angle_min=start,
        angle_increment=increment,
        range_max=range_max,
        ranges=ranges,
        v=v,
        w=w,
    )


def carmen_lines(log: DriveLog) -> Iterator[str]:
    """A log as ODOM and ROBOTLASER1 lines. A beam without an echo is at the largest range, as CARMEN has it.

    What the format has no place for: how long a sweep took.
    """
    yield "# CARMEN Logfile\n# message_name [message contents] ipc_timestamp ipc_hostname logger_timestamp\n"
    first = min((record.stamp for record in log.records), default=0)
    for record in log.records:
        base, end = record.odom_from_base, f"{_seconds(record.stamp)} zenav {_seconds(record.stamp - first)}\n"
        if isinstance(record, LoggedPose):
            yield f"ODOM {_row(base)} {record.v:.9g} {record.w:.9g} 0 {end}"
            continue
        measured = np.isfinite(record.ranges)
        n, far = len(measured), record.range_max or float(np.max(record.ranges, initial=1.0, where=measured))
        ranges = np.where(measured, record.ranges, far)
        yield (
            f"ROBOTLASER1 0 {record.angle_min:.9g} {record.angle_increment * (n - 1):.9g} {record.angle_increment:.9g} "
            f"{far:.9g} 0 0 {n} {' '.join(f'{r:.9g}' for r in ranges)} 0 {_row(record.odom_from_laser)} {_row(base)} "
            f"0 0 0 0 0 {end}"
        )


def _row(pose: Pose2) -> str:
    return f"{pose.x:.9f} {pose.y:.9f} {pose.yaw:.9f}"


def _seconds(stamp: int) -> str:
    return f"{stamp // 10**9}.{stamp % 10**9 // 1000:06d}"


READERS: dict[str, Callable[[list[str]], LoggedPose | LoggedScan]] = {
    "ODOM": _odom,
    "FLASER": _flaser,
    "ROBOTLASER1": _robotlaser,
}


def _numbers(cells: list[str], n: int) -> list[float]:
    numbers = [float(cell) for cell in cells]
    if len(numbers) != n or not all(isfinite(v) and abs(v) <= BOUND for v in numbers):
        raise ValueError("a number is missing or out of bounds")
    return numbers


def _stamp(word: str) -> int:
    """The stamp, ns, of a line's seconds, rounded to microseconds: a float's last bits are noise."""
    stamp = float(word)
    if not 0 <= stamp < 1e10:
        raise ValueError("a stamp out of bounds")
    return round(stamp * 1e6) * 1000


def _count(word: str, minimum: int = 2) -> int:
    n = int(word)
    if not minimum <= n <= 20000:
        raise ValueError("a count out of bounds")
    return n


def _ranges(cells: list[str], n: int) -> Float32s:
    ranges = np.array(cells, np.float64)
    if len(ranges) != n:
        raise ValueError("fewer ranges than the line says")
    # a range that is no number is a beam without a measurement, not a reason to lose the others
    return np.where(np.isfinite(ranges) & (ranges >= 0), np.minimum(ranges, 250.0), np.nan).astype(np.float32)
