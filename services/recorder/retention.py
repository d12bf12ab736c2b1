# SPDX-License-Identifier: Apache-2.0
"""Which recordings go when there are too many: the oldest first, the marked ones never."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

KEEP = ".keep"
"""Added to a recording's name: the empty file that marks it, made by `zenav recording mark`."""


@dataclass(frozen=True, slots=True)
class Kept:
    """A recording, or a part of one, that lies in the folder. changed: ns, its file's last change."""

    path: Path
    size: int
    changed: int
    marked: bool


def to_remove(recordings: Iterable[Kept], budget: int) -> list[Path]:
    """The oldest unmarked ones, until the unmarked rest takes at most `budget` bytes.

    What is marked does not count: it is the user's, and so is the decision about it.
    """
    own = sorted((r for r in recordings if not r.marked), key=lambda r: (r.changed, r.path.name))
    total, removed = sum(r.size for r in own), []
    for recording in own:
        if total <= budget:
            break
        removed.append(recording.path)
        total -= recording.size
    return removed
