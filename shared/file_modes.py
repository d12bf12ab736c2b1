# SPDX-License-Identifier: Apache-2.0
"""Modes of new files that show a building and its robot: maps, recordings, kept states.

They are readable for the user and its group, and for no others of the computer. A stricter umask of the user holds.
"""

import os
from pathlib import Path

FILE_MODE, FOLDER_MODE = 0o640, 0o750


def make_folder(folder: Path) -> None:
    """Makes a folder where there is none; one that exists keeps its mode. Raises OSError."""
    folder.mkdir(mode=FOLDER_MODE, parents=True, exist_ok=True)


def opener(path: str, flags: int) -> int:
    """For `open(..., opener=opener)`. Raises OSError."""
    return os.open(path, flags, FILE_MODE)
