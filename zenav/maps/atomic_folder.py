# SPDX-License-Identifier: Apache-2.0
"""Files of a folder that are replaced together: a crash or a full disk leaves all old ones, or all new ones.

New files are written into `.saving` and synchronised to the disk. Renaming that folder to `.saved` is the one step in
which the new files replace the old ones. Then each file is moved to its place. A process that finds a `.saved` finishes
the move, or reads from it. Processes that replace files of one folder do so one after the other.
"""

import fcntl
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from shared.config import UserError
from shared.file_modes import make_folder, opener

SAVING, SAVED = ".saving", ".saved"


def replace_together(folder: Path, contents: Mapping[str, bytes]) -> None:
    """Writes files by name; one without a content is removed. Raises UserError where the folder refuses."""
    try:
        make_folder(folder)
        with _locked(folder):
            finish_replacing(folder)
            _write(folder, contents)
            finish_replacing(folder)
    except OSError as error:
        raise UserError(
            f"cannot write to {folder}: {error.strerror}", "check the path and the disk; what was there is whole"
        ) from None


def read_together(folder: Path, name: str, max_bytes: int = 1 << 31) -> bytes:
    """A file's content. Raises UserError where it cannot be read or is over `max_bytes`."""
    settle(folder)
    moved = folder / SAVED / name
    path = moved if moved.exists() else folder / name
    try:
        if path.stat().st_size > max_bytes:
            raise UserError(f"{path}: larger than {max_bytes} bytes", "this is no file that zenav wrote")
        return path.read_bytes()
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}", "give the folder of a saved map") from None


def settle(folder: Path) -> None:
    """`finish_replacing` before a folder is read; where nothing may be written, the folder stays as it is."""
    if not (folder / SAVED).is_dir():
        return
    with suppress(OSError), _locked(folder):
        finish_replacing(folder)


def finish_replacing(folder: Path) -> None:
    """Moves what a crash left in `.saved` to its place; a file without content stands for one that is no more."""
    saved = folder / SAVED
    if not saved.is_dir():
        return
    for path in sorted(saved.iterdir()):
        with suppress(FileNotFoundError):  # another one finishes it too
            if path.stat().st_size:
                os.replace(path, folder / path.name)
            else:
                (folder / path.name).unlink(missing_ok=True)
                path.unlink()
    _to_disk(folder)
    with suppress(FileNotFoundError):
        saved.rmdir()


def _write(folder: Path, contents: Mapping[str, bytes]) -> None:
    new = folder / SAVING
    shutil.rmtree(new, ignore_errors=True)  # of a crash
    make_folder(new)
    try:
        for name, content in contents.items():
            with open(new / name, "wb", opener=opener) as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
        _to_disk(new)
        os.rename(new, folder / SAVED)
    except BaseException:
        shutil.rmtree(new, ignore_errors=True)
        raise
    _to_disk(folder)


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Waits until no other process replaces files of the folder. The kernel releases the lock of a killed process."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # of a file system without locks
            fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def _to_disk(folder: Path) -> None:
    """A folder's names; where the system can do that."""
    if not hasattr(os, "O_DIRECTORY"):
        return
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
