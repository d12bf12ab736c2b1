# SPDX-License-Identifier: Apache-2.0
"""`zenav recording mark`: recordings that the recorder must not remove."""

import sys
from pathlib import Path

from services.recorder.retention import KEEP_SUFFIX
from shared.config import UserError
from zenav.recording.opening import open_recording


def mark(paths: list[Path], remove: bool) -> int:
    """Marks recordings, or takes their marks away. Raises UserError where one is none, or its folder refuses."""
    for path in paths:
        open_recording(path)
        keep = path.with_name(path.name + KEEP_SUFFIX)
        try:
            if remove:
                keep.unlink(missing_ok=True)
            else:
                keep.touch()
        except OSError as error:
            raise UserError(f"cannot mark {path}: {error.strerror}", "check its folder's permissions") from None
        sys.stdout.write(f"{path} {'may be removed' if remove else 'is kept'}\n")
    return 0
