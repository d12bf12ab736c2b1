# SPDX-License-Identifier: Apache-2.0
"""Parts of the recorder's files for a site that fetches them. A part is read in a handler: it has 64 KiB at most."""

import os
import re
from contextlib import suppress
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path

NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,127}\.mcap")
MAX_LISTED = 500


@dataclass(frozen=True, slots=True)
class RecordingFile:
    """size: bytes.  modified: ns."""

    name: str
    size: int
    modified: int


def listed_recordings(folder: Path) -> list[RecordingFile]:
    """The recordings of a folder, the newest first."""
    found = []
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            if NAME.fullmatch(entry.name) and entry.is_file(follow_symlinks=False):
                with suppress(OSError):  # it was removed meanwhile
                    stat = entry.stat()
                    found.append(RecordingFile(entry.name, stat.st_size, stat.st_mtime_ns))
    return sorted(found, key=lambda row: (-row.modified, row.name))[:MAX_LISTED]


def read_part(folder: Path, name: str, offset: int, length: int) -> tuple[bytes, bytes, int] | None:
    """Bytes of a recording from `offset` on, their SHA-256, and the file's size. None where there is no such file.

    Raises OSError.
    """
    path = folder / name
    if not NAME.fullmatch(name) or path.is_symlink() or not path.is_file():
        return None
    with path.open("rb") as file:
        file.seek(offset)
        data = file.read(length)
        return data, sha256(data).digest(), os.fstat(file.fileno()).st_size
