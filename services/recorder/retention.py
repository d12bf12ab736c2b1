# SPDX-License-Identifier: Apache-2.0
"""Which recordings are removed over budget? The oldest first, uploaded ones before others, marked ones never."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

KEEP_SUFFIX = ".keep"
"""Suffix to a recording's name of the empty file that marks it; `zenav recording mark` makes it."""
UPLOADED_SUFFIX = ".uploaded"
"""Suffix to a recording's name of the file that says where its verified copy is; the uploader writes it (JSON)."""


@dataclass(frozen=True, slots=True)
class StoredRecording:
    """A recording, or a part of one, in the folder. size: bytes.  changed: ns, last change of the file.

    uploaded: a verified copy of it is elsewhere.
    """

    path: Path
    size: int
    changed: int
    marked: bool
    uploaded: bool = False


def recordings_to_remove(recordings: Iterable[StoredRecording], budget: int) -> list[Path]:
    """Unmarked recordings to remove, so that the other unmarked ones take at most `budget` bytes.

    The oldest uploaded ones go first, then the oldest others. Marked ones do not count: only the user removes them.
    """
    own = sorted((r for r in recordings if not r.marked), key=lambda r: (not r.uploaded, r.changed, r.path.name))
    total, removed = sum(r.size for r in own), []
    for recording in own:
        if total <= budget:
            break
        removed.append(recording.path)
        total -= recording.size
    return removed
