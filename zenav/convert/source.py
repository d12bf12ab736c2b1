# SPDX-License-Identifier: Apache-2.0
"""Any log of a drive, found by what is in the file: CARMEN logs, ROS bags, zenav recordings."""

import gzip
import zlib
from contextlib import suppress
from pathlib import Path

from shared.config import UserError
from zenav.convert.carmen import read_carmen
from zenav.convert.content import Choice, Content, content_of, log_of
from zenav.convert.records import DriveLog, LoggedScan
from zenav.convert.ros_files import MAGICS, kind_of
from zenav.convert.ros_log import read_ros
from zenav.convert.stack_log import is_recording, read_recording

FORMATS = "a CARMEN log, a ROS 1 or ROS 2 bag, or a zenav recording"
GZIP = b"\x1f\x8b"
TEXT = 1024  # bytes in which text has no zero


def read_log(path: Path, choice: Choice) -> DriveLog:
    """What a mapper takes of any log. Raises UserError where it cannot be read, or holds no scan."""
    if _carmen(path):
        log = read_carmen(path)
        if not any(isinstance(record, LoggedScan) for record in log.records):
            raise UserError(f"{path}: no FLASER or ROBOTLASER1 line that can be read", f"give {FORMATS} of a 2D laser")
        return log
    content = read_content(path, choice)
    log = log_of(content)
    if not any(isinstance(record, LoggedScan) for record in log.records):
        raise UserError(f"{path}: no LaserScan in it", content.lacks or f"give {FORMATS} of a 2D laser")
    return log


def read_content(path: Path, choice: Choice) -> Content:
    """A log's messages. Raises UserError where it cannot be read."""
    if _carmen(path):
        return content_of(read_carmen(path))
    if not path.is_dir() and is_recording(path):
        return read_recording(path, choice)
    return read_ros(path, choice)


def _carmen(path: Path) -> bool:
    """Whether a file is text, zipped or not. Raises UserError where it is nothing that is known."""
    if path.is_dir() or kind_of(path):
        return False
    with path.open("rb") as file:
        head = file.read(TEXT)
    if head.startswith(GZIP):
        with gzip.open(path, "rb") as file, suppress(EOFError, zlib.error, gzip.BadGzipFile):
            head = file.read(TEXT)
        if head.startswith(tuple(MAGICS)):
            raise UserError(f"{path}: a zipped bag", f"unpack it first: gunzip {path}")
    if b"\0" in head:
        raise UserError(f"{path} is no log that is known", f"give {FORMATS}")
    return True
