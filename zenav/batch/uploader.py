# SPDX-License-Identifier: Apache-2.0
"""The recorder's uploader: `python -m zenav.batch.uploader PARENT_PID FOLDER URL RATE PATTERN...`.

It uploads what is finished and ends, with status 0, or with its parent. It writes a line of JSON for each change:
{"state": TEXT}, or {"log": LEVEL, "text": TEXT}. It takes only processor time and disk that nothing else wants.
"""

import shared.repeatable  # noqa: F401  # before numpy

# isort: split
import json
import logging
import os
import sys
import threading
import time
from contextlib import suppress
from pathlib import Path

import psutil

from shared.config import UserError
from zenav.batch.upload_stores import upload_store
from zenav.batch.uploading import FolderUpload
from zenav.stack.process_guard import die_with_parent

MIN_STATE_S = 0.5  # between two lines of a state that only counts


class Lines:
    """Writes the lines. A state that follows too soon is left out, if another one comes later."""

    def __init__(self) -> None:
        self._said_at = 0.0

    def state(self, text: str) -> None:
        is_count = text.endswith(" MB")
        if not is_count or time.monotonic() - self._said_at >= MIN_STATE_S:
            self._said_at = time.monotonic()
            self._write({"state": f"upload: {text}"})

    def event(self, level: str, text: str) -> None:
        self._write({"log": level, "text": text})

    @staticmethod
    def _write(line: dict[str, str]) -> None:
        sys.stdout.write(json.dumps(line) + "\n")
        sys.stdout.flush()


def main() -> None:
    parent, folder, url, rate, *patterns = sys.argv[1:]
    die_with_parent(int(parent))
    logging.disable(logging.WARNING)  # of the store's library: each error is reported once, in our words
    os.nice(19)
    with suppress(psutil.Error, OSError, AttributeError):  # AttributeError: no Linux
        psutil.Process().ionice(psutil.IOPRIO_CLASS_IDLE)
    lines, wait = Lines(), threading.Event().wait
    try:
        store = upload_store(url, float(rate), wait)
        FolderUpload(
            folder=Path(folder),
            patterns=tuple(patterns),
            store=store,
            say_state=lines.state,
            say_event=lines.event,
            wait=wait,
        ).run()
    except UserError as error:
        lines.state(f"{error.what}; {error.hint}")
        lines.event("ERROR", f"{error.what}; hint: {error.hint}")
        sys.exit(2)


if __name__ == "__main__":
    main()
