# SPDX-License-Identifier: Apache-2.0
"""`zenav recording repair`: gives a recording that is damaged, or was not closed, its index back."""

import os
import sys
from pathlib import Path

from shared.config import UserError
from zenav.recording.new_recording import new_recording
from zenav.recording.opening import open_recording
from zenav.recording.selection import check_new_recording, check_not_written


def repair(path: Path, out: Path | None) -> int:
    """Gives a recording that was not closed, or is damaged, its index back; in its place, or into `out`.

    Where something is lost, the damaged file stays beside it as NAME.damaged. 1 where something is lost.
    """
    recording = open_recording(path)
    if out is None:
        check_not_written(path)
    else:
        check_new_recording(out, path)
    n = 0
    to = out or path.with_name(f"{path.name}.repaired")
    with new_recording(to, recording, recording.about, recording.attachments) as writer:
        writer.note_drops(recording.drops)
        for entry in recording.entries(as_recorded=True):
            writer.copy(entry)
            n += 1
    lost = bool(recording.damage)
    if out is None:
        _replace_original(path, lost)
    sys.stdout.write(f"{out or path}: {n} messages, with an index\n")
    for problem in recording.problems:
        sys.stderr.write(f"{problem}\n")
    if lost:
        known = f"{recording.n_lost} messages are known to be lost" if recording.n_lost else "something is lost"
        kept = "" if out else f"; the damaged file is {path}.damaged"
        sys.stderr.write(f"{known}{kept}\n")
    return 1 if lost else 0


def _replace_original(path: Path, lost: bool) -> None:
    repaired = path.with_name(f"{path.name}.repaired")
    try:
        if lost:
            os.link(path, _unused(path.with_name(f"{path.name}.damaged")))
        repaired.replace(path)
    except OSError as error:
        raise UserError(f"cannot replace {path}: {error.strerror}", f"the repaired one is {repaired}") from None


def _unused(path: Path) -> Path:
    """The path, or the first of its like that is not taken."""
    n, unused = 1, path
    while unused.exists():
        n, unused = n + 1, path.with_name(f"{path.name}-{n + 1}")
    return unused
