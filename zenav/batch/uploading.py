# SPDX-License-Identifier: Apache-2.0
"""Uploads the finished recordings of a folder: each once, verified, with its row in the catalogue of the place.

    read and hash -> name that is free, or has the same content -> upload -> row of the catalogue -> NAME.uploaded

Each step may be done again. So after a crash at any place the next run does all of them, and skips what is there. Two
recordings with one name, as of a robot whose clock jumped back, get names that differ: nothing is overwritten.
"""

import fcntl
import os
import re
import secrets
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from shared.config import UserError
from zenav.batch.catalogue import REVISION, Catalogue
from zenav.batch.recording_row import row_of_file
from zenav.batch.upload_files import FileState, Uploaded, abandoned_uploads, content_of, finished_recordings
from zenav.batch.upload_stores import UploadStore

LOCK = ".uploads.lock"
"""File in the folder of the recordings: one process at a time uploads from it."""
MIN_WAIT_S, MAX_WAIT_S = 1.0, 300.0  # before the first and each later try after an error
LOCK_WAIT_S = 1.0
MAX_ERROR = 200  # characters of an error that are reported


class Backoff:
    """Waits that double with each failure, from a half to the whole of the bound at random: robots do not meet."""

    def __init__(self) -> None:
        self._bound = MIN_WAIT_S

    def succeeded(self) -> None:
        self._bound = MIN_WAIT_S

    def failed(self) -> float:
        """s to wait now."""
        bound, self._bound = self._bound, min(2.0 * self._bound, MAX_WAIT_S)
        return bound * (0.5 + secrets.randbelow(1000) / 2000)


class FolderUpload:
    """Uploads the recordings of a folder whose names match a pattern.

    say_state: gets what it is doing, in a few words.  say_event: gets (level, line) of what is worth a line of the log.
    wait: for s. Tests give another one.
    """

    def __init__(
        self,
        folder: Path,
        patterns: tuple[str, ...],
        store: UploadStore,
        say_state: Callable[[str], None],
        say_event: Callable[[str, str], None],
        wait: Callable[[float], object],
    ) -> None:
        self._folder, self._patterns, self._store = folder, patterns, store
        self._say_state, self._say_event, self._wait = say_state, say_event, wait
        self._catalogue = Catalogue(store.folder)
        self._n_failures: Counter[Path] = Counter()
        self._backoff = Backoff()

    def run(self) -> int:
        """Uploads until all that is finished is uploaded. Returns how many recordings were uploaded.

        An error of store or network is reported, and tried again later. Raises UserError where the folder is none, or
        is the place itself.
        """
        place = self._store.folder
        if place.is_local and Path(place.path).resolve() == self._folder.resolve():
            raise UserError(f"{self._folder} is the place of the uploads itself", "name another place")
        n_uploaded = 0
        with upload_lock(self._folder, self._say_state, self._wait):
            self._abandon()
            while left := self.waiting():
                for path in sorted(left, key=self._n_failures.__getitem__):  # one that always fails delays no other
                    if not self._try(path, left):
                        break
                    left.remove(path)
                    n_uploaded += 1
            self._say_state("all uploaded")
            with suppress(UserError):  # a robot without the right to read uploads too
                self._catalogue.merge()
        return n_uploaded

    def waiting(self) -> list[Path]:
        """Finished recordings that are not uploaded yet, the oldest first. Raises UserError."""
        found = []
        for path in finished_recordings(self._folder, self._patterns):
            with suppress(FileNotFoundError):  # removed meanwhile
                before = Uploaded.of(path)
                if before is None or not before.is_of(path) or not self._is_here(before.url):
                    found.append(path)
        return found

    def _try(self, path: Path, left: list[Path]) -> bool:
        size = sum(_size(one) for one in left)
        waiting = f"{len(left)} recording{'' if len(left) == 1 else 's'} to upload, {size / 1e6:.1f} MB"
        self._say_state(waiting)
        try:
            self._upload(path, lambda done: self._say_state(f"{waiting}: {path.name} {done / 1e6:.1f} MB"))
        except (OSError, UserError) as error:
            if not path.exists():
                self._abandon()
                return False
            self._n_failures[path] += 1
            text, seconds = _short(error), self._backoff.failed()
            self._say_state(f"{waiting}: {text}; tried again in {seconds:.0f} s")
            if self._n_failures[path] in (1, 10, 100):
                self._say_event("WARNING", f"{path.name} is not uploaded: {text}; it is tried again")
            self._wait(seconds)
            return False
        self._backoff.succeeded()
        self._n_failures.pop(path, None)
        return True

    def _upload(self, path: Path, report: Callable[[int], None]) -> None:
        content, before = content_of(path), Uploaded.of(path)
        name, is_there, replaces = self._name_for(path.name, content, before)
        if is_there:
            self._store.confirm(path, content, name)
        else:
            self._store.put(path, content, name, replaces, report)
        source = self._store.folder.source(name)
        revision = before.revision + 1 if before is not None and replaces else 1
        row = row_of_file(path, source)
        if not content.is_of(path):
            raise OSError(f"{path} changed while it was uploaded")
        self._catalogue.add({**row, "sha256": content.sha256, REVISION: revision})
        Uploaded(content.size, content.changed, content.sha256, source.url, revision).write(path)
        if not is_there:
            self._say_event("INFO", f"uploaded {path.name}, {content.size / 1e6:.1f} MB: {source.url}")

    def _name_for(self, name: str, content: FileState, before: Uploaded | None) -> tuple[str, bool, bool]:
        """(name in the store, whether this content is there, whether it replaces an earlier state of the recording)."""
        stem, dot, suffix = name.rpartition(".")
        for chosen in (name, f"{stem}-{content.sha256[:8]}{dot}{suffix}"):
            there = self._store.sha256_of(chosen)
            if there in ("", content.sha256):
                return chosen, bool(there), False
            if before is not None and before.url == f"{self._store.folder.url}/{chosen}" and before.sha256 == there:
                return chosen, False, True
        raise OSError(f"{self._store.folder.url} has two other recordings named {name}")

    def _is_here(self, url: str) -> bool:
        return url.rpartition("/")[0] == self._store.folder.url

    def _abandon(self) -> None:
        for path in abandoned_uploads(self._folder):
            self._store.abandon(path)


@contextmanager
def upload_lock(folder: Path, say_state: Callable[[str], None], wait: Callable[[float], object]) -> Iterator[None]:
    """Holds the folder's lock, which ends with the process. Waits for another one that has it. Raises UserError."""
    try:
        handle = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT, 0o640)
    except OSError as error:
        raise UserError(f"cannot write to {folder}: {error.strerror}", "name a folder of recordings") from None
    try:
        while True:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                say_state("another process uploads from this folder")
                wait(LOCK_WAIT_S)
            except OSError:  # the file system has no locks
                break
        yield
    finally:
        os.close(handle)


def _short(error: Exception) -> str:
    """An error in one line, without the parameters of a request's address."""
    return re.sub(r"\?[^\s\"']*", "", str(error) or type(error).__name__)[:MAX_ERROR]


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
