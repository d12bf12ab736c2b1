# SPDX-License-Identifier: Apache-2.0
"""Recordings for pages: list, path for a download, delete."""

import time
from functools import cache
from pathlib import Path

from services.recorder.recording_store import RecorderConfig
from services.recorder.retention import KEEP_SUFFIX, UPLOADED_SUFFIX
from shared.config import UserError
from zenav.page.target import PageTarget, Values

MAX_SILENCE_S = 5.0  # since its last change, of a recording that is being written: it grows each second


def recordings(target: PageTarget, values: Values) -> list[Values]:
    """Each recording: name, size in bytes, s since 1970 of its last change; whether it is marked, and being written."""
    rows = []
    for path in sorted(_folder(target).glob("*.mcap")):
        state = path.stat()
        marked, current = path.with_name(path.name + KEEP_SUFFIX).exists(), _is_current(path)
        row = {"name": path.name, "size": state.st_size, "modified": state.st_mtime}
        rows.append({**row, "marked": marked, "current": current})
    return rows


def path_of(target: PageTarget, values: Values) -> str:
    """The path of a recording. Raises UserError where there is none."""
    name = str(values["name"])
    path = _folder(target) / name
    if Path(name).name != name or not path.is_file() or path.is_symlink():
        raise UserError(f"there is no recording {name}", "see the list of recordings")
    return str(path.resolve())


def delete(target: PageTarget, values: Values) -> None:
    """Deletes a recording. Raises UserError where it is being written."""
    path = Path(path_of(target, values))
    if _is_current(path):
        raise UserError(f"{path.name} is being written", "stop the recorder, or wait for its next part")
    path.unlink()
    for suffix in (KEEP_SUFFIX, UPLOADED_SUFFIX):
        path.with_name(path.name + suffix).unlink(missing_ok=True)


@cache  # a replay asks ten times a second
def _folder(target: PageTarget) -> Path:
    config = target.file().section("recorder", RecorderConfig)
    return Path(config.file).parent if config.file else Path(config.folder)


def _is_current(path: Path) -> bool:
    return time.time() - path.stat().st_mtime < MAX_SILENCE_S  # noqa: TID251  # the file system's clock
