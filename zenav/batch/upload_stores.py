# SPDX-License-Identifier: Apache-2.0
"""Places that recordings are uploaded to. A recording is there whole and verified, or not at all.

A folder, also of a mounted disk: written beside its name, continued after a crash, read back, renamed. S3 is in
s3_store.py. Other object stores of fsspec (`gs://`): written as a whole, read back; a crash begins again.
"""

import hashlib
import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, Protocol

from shared.config import UserError
from zenav.batch.storage import Folder, errors_of
from zenav.batch.upload_files import FileState

CHUNK = 8 << 20  # bytes that are written at a time


class DamagedError(OSError):
    """The store has other bytes than were sent."""


Report = Callable[[int], None]
"""Gets the bytes of a recording that are there, again and again."""


class Pace:
    """Keeps a rate in the mean. rate: bytes/s, 0 is unlimited.   wait: for s."""

    def __init__(self, rate: float, wait: Callable[[float], object]) -> None:
        self.rate, self._wait = rate, wait
        self._free_at = 0.0  # monotonic s

    def sent(self, n_bytes: int) -> None:
        """Waits so long that these bytes, which were sent since the last call, keep the rate."""
        if self.rate:
            now = time.monotonic()
            self._free_at = max(self._free_at, now - CHUNK / self.rate) + n_bytes / self.rate
            self._wait(max(self._free_at - now, 0.0))


class UploadStore(Protocol):
    """Raises OSError or UserError where the store cannot be reached or refuses."""

    folder: Folder

    def sha256_of(self, name: str) -> str:
        """Of a recording that is there; empty where there is none."""

    def put(self, path: Path, content: FileState, name: str, replaces: bool, report: Report) -> None:
        """Uploads a recording. Raises FileExistsError where there is another one, unless it `replaces` that."""

    def confirm(self, path: Path, content: FileState, name: str) -> None:
        """Ends an upload that was interrupted after its last byte, when a recording is there that has this content.

        Raises DamagedError where the copy was not checked yet, and has other bytes: it is removed.
        """

    def abandon(self, path: Path) -> None:
        """Removes what is there of an upload whose recording is gone here."""


class FolderStore:
    """A folder of this computer, or one that is mounted."""

    def __init__(self, folder: Folder, pace: Pace) -> None:
        self.folder, self._pace = folder, pace
        self._path = Path(folder.path)

    def sha256_of(self, name: str) -> str:
        try:
            with (self._path / name).open("rb") as file:
                return _sha256(file)
        except FileNotFoundError:
            return ""

    def put(self, path: Path, content: FileState, name: str, replaces: bool, report: Report) -> None:
        self._path.mkdir(parents=True, exist_ok=True)
        target, part = self._path / name, self._path / f".{name}.{content.sha256[:16]}.uploading"
        with path.open("rb") as source, part.open("ab") as copy:
            done = copy.tell() // CHUNK * CHUNK  # a crash of the computer may leave the last bytes unwritten
            copy.truncate(done)
            source.seek(done)
            while chunk := source.read(CHUNK):
                copy.write(chunk)
                self._pace.sent(len(chunk))
                report(source.tell())
            copy.flush()
            os.fsync(copy.fileno())
        with part.open("rb") as file:
            is_same = _sha256(file) == content.sha256
        if not is_same:
            part.unlink()
            raise DamagedError(f"{part} had other bytes than {path}; it is written again")
        if replaces:
            part.replace(target)
        else:
            _move_new(part, target)
        _sync_folder(self._path)

    def confirm(self, path: Path, content: FileState, name: str) -> None:
        """There is nothing to do: a copy is read back before it has its name."""

    def abandon(self, path: Path) -> None:
        """There is no file that says so: what is left is named by its content."""


class ObjectStore:
    """Any store of fsspec that writes an object whole or not at all."""

    def __init__(self, folder: Folder, pace: Pace) -> None:
        self.folder, self._pace = folder, pace

    def sha256_of(self, name: str) -> str:
        with errors_of(f"{self.folder.url}/{name}"):
            try:
                with self.folder.system.open(f"{self.folder.path}/{name}", "rb") as file:
                    return _sha256(file)
            except FileNotFoundError:
                return ""

    def put(self, path: Path, content: FileState, name: str, replaces: bool, report: Report) -> None:
        there, url = f"{self.folder.path}/{name}", f"{self.folder.url}/{name}"
        with errors_of(url):
            is_taken = not replaces and self.folder.system.exists(there)
        if is_taken:
            raise FileExistsError(there)
        with errors_of(url):
            self.folder.system.put_file(str(path), there)
        self._pace.sent(content.size)
        if self.sha256_of(name) != content.sha256:
            self.folder.remove([name])
            raise DamagedError(f"{there} had other bytes than {path}; it is written again")
        report(content.size)

    def confirm(self, path: Path, content: FileState, name: str) -> None:
        """There is nothing to do: `sha256_of` reads the object."""

    def abandon(self, path: Path) -> None:
        """There is nothing: an object is written whole."""


def upload_store(url: str, rate: float, wait: Callable[[float], object]) -> UploadStore:
    """The store of a URL. rate: MB/s, 0 is unlimited.  wait: for s. Raises UserError."""
    pace = Pace(rate * 1e6, wait)
    kind = url.partition("://")[0] if "://" in url else "file"
    if kind in ("http", "https"):
        raise UserError(f"{url} cannot be written to", "s3://BUCKET/FOLDER, or a folder")
    if kind in ("s3", "s3a"):
        from zenav.batch.s3_store import S3Store

        return S3Store(url, pace)
    folder = Folder(url)
    return FolderStore(folder, pace) if folder.is_local else ObjectStore(folder, pace)


def _move_new(part: Path, target: Path) -> None:
    """Renames a file to a name that is free. Raises FileExistsError."""
    try:
        os.link(part, target)
    except FileExistsError:
        raise
    except OSError:  # the file system has no hard links
        if target.exists():
            raise FileExistsError(str(target)) from None
        part.replace(target)
    else:
        part.unlink()


def _sync_folder(folder: Path) -> None:
    with suppress(OSError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)


def _sha256(file: IO[Any]) -> str:
    return hashlib.file_digest(file, "sha256").hexdigest()  # type: ignore[arg-type]  # any binary file
