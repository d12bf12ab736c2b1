# SPDX-License-Identifier: Apache-2.0
"""Folders for the files of a run."""

import time
from pathlib import Path

from shared.config import UserError


def new_run_folder(kind: str) -> Path:
    """A new folder out/KIND-DATE-TIME for what a run leaves behind. Raises UserError where it cannot be made."""
    base = Path("out") / f"{kind}-{time.strftime('%Y%m%d-%H%M%S')}"
    for i in range(100):
        folder = base if i == 0 else base.with_name(f"{base.name}-{i}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            continue
        except OSError as error:
            raise UserError(f"cannot write to {folder}: {error.strerror}", "run it from a folder of yours") from None
        return folder
    raise UserError(f"{base} exists 100 times", "wait a second")
