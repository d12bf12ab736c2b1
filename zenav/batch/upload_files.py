# SPDX-License-Identifier: Apache-2.0
"""Finished recordings of a folder, and the files beside them that say how far their upload is.

`NAME.uploaded` says where the verified copy is. `NAME.uploading` has the state of an upload that can be continued.
"""

import hashlib
import json
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from stat import S_ISREG
from typing import Self

from services.recorder.retention import UPLOADED_SUFFIX
from shared.config import UserError
from shared.recording import is_finished
from shared.ros_map import replace_file

PROGRESS_SUFFIX = ".uploading"
BLOCK = 1 << 20  # bytes that are hashed at a time


@dataclass(frozen=True, slots=True)
class FileState:
    """A state of a file here. size: bytes.  changed: ns, of its last change.  sha256: in hex."""

    size: int
    changed: int
    sha256: str

    def is_of(self, path: Path) -> bool:
        """Whether the file still has this size and change. Raises OSError."""
        stat = path.stat()
        return (self.size, self.changed) == (stat.st_size, stat.st_mtime_ns)


@dataclass(frozen=True, slots=True)
class _Sidecar(FileState):
    @classmethod
    def _read(cls, path: Path) -> Self | None:
        """None where there is none, or it is of another version or damaged: then the work is done again."""
        try:
            return cls(**json.loads(path.read_bytes()))
        except (OSError, ValueError, TypeError):
            return None

    def _write(self, path: Path) -> None:
        replace_file(path, json.dumps(asdict(self)).encode())


@dataclass(frozen=True, slots=True)
class Uploaded(_Sidecar):
    """A verified copy of a recording. revision: of its row in the catalogue."""

    url: str
    revision: int

    @classmethod
    def of(cls, path: Path) -> Self | None:
        """That of a recording, perhaps of an earlier content; None without one."""
        return cls._read(_beside(path, UPLOADED_SUFFIX))

    def write(self, path: Path) -> None:
        """Raises OSError."""
        self._write(_beside(path, UPLOADED_SUFFIX))


@dataclass(frozen=True, slots=True)
class UploadProgress(_Sidecar):
    """An upload in parts. upload_id: the store's name of it.  part_size: bytes.  parts: ETag and checksum of each."""

    url: str
    upload_id: str
    part_size: int
    parts: tuple[tuple[str, str], ...] = ()
    is_verified: bool = True

    @classmethod
    def of(cls, path: Path, content: FileState, url: str) -> Self | None:
        """That of this content to this URL; None without one."""
        found = cls.left(path)
        if found is None or (found.size, found.sha256, found.url) != (content.size, content.sha256, url):
            return None
        return found

    @classmethod
    def left(cls, path: Path) -> Self | None:
        """What an earlier upload left, of whatever content."""
        found = cls._read(_beside(path, PROGRESS_SUFFIX))
        return found and replace(found, parts=tuple((str(etag), str(checksum)) for etag, checksum in found.parts))

    def write(self, path: Path) -> None:
        """Raises OSError."""
        self._write(_beside(path, PROGRESS_SUFFIX))

    @staticmethod
    def remove(path: Path) -> None:
        """Forgets the upload of a recording."""
        with suppress(OSError):
            _beside(path, PROGRESS_SUFFIX).unlink(missing_ok=True)


def finished_recordings(folder: Path, patterns: Iterable[str]) -> list[Path]:
    """Recordings in a folder that no process writes, the oldest first. What cannot be read is left out.

    Raises UserError where the folder cannot be read.
    """
    found = []
    try:
        for path in folder.iterdir():
            if path.suffix in (UPLOADED_SUFFIX, PROGRESS_SUFFIX) or path.name.startswith("."):
                continue
            if any(fnmatchcase(path.name, pattern) for pattern in patterns):
                with suppress(OSError):  # removed meanwhile, or not to be read
                    stat = path.stat()
                    if S_ISREG(stat.st_mode) and stat.st_size and _is_finished(path):
                        found.append((stat.st_mtime_ns, path))
    except OSError as error:
        raise UserError(f"cannot read {folder}: {error.strerror}", "name a folder of recordings") from None
    return [path for _, path in sorted(found)]


def abandoned_uploads(folder: Path) -> list[Path]:
    """Recordings that were removed while they were uploaded. Raises OSError."""
    paths = (path.with_name(path.name.removesuffix(PROGRESS_SUFFIX)) for path in folder.glob(f"*{PROGRESS_SUFFIX}"))
    return [path for path in paths if not path.exists()]


def content_of(path: Path) -> FileState:
    """Reads a file and hashes it. Raises OSError."""
    digest = hashlib.sha256()
    with path.open("rb") as file:
        stat = path.stat()
        while block := file.read(BLOCK):
            digest.update(block)
    return FileState(stat.st_size, stat.st_mtime_ns, digest.hexdigest())


def _is_finished(path: Path) -> bool:
    with path.open("rb", buffering=0) as file:
        return is_finished(file)


def _beside(path: Path, suffix: str) -> Path:
    return path.with_name(path.name + suffix)
