# SPDX-License-Identifier: Apache-2.0
"""Which recordings are removed over budget? The oldest first, marked ones never."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

KEEP_SUFFIX = ".keep"
"""Suffix to a recording's name of the empty file that marks it; `zenav recording mark` makes it."""


@dataclass(frozen=True, slots=True)
class StoredRecording:
    """A recording, or a part of one, in the folder. size: bytes.  changed: ns, last change of the file."""

    path: Path
    size: int
    changed: int
    marked: bool


def recordings_to_remove(recordings: Iterable[StoredRecording], budget: int) -> list[Path]:
    """The oldest unmarked recordings, so that the other unmarked ones take at most `budget` bytes.

    Marked recordings do not count: only the user removes them.
    """
    own = sorted((r for r in recordings if not r.marked), key=lambda r: (r.changed, r.path.name))
    total, removed = sum(r.size for r in own), []
    for recording in own:
        if total <= budget:
            break
        removed.append(recording.path)
        total -= recording.size
    return removed
