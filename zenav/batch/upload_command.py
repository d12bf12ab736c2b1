# SPDX-License-Identifier: Apache-2.0
"""`zenav recording upload` and `uploads`: upload a folder's recordings by hand, and see what is uploaded."""

import json
import logging
import sys
import threading
from dataclasses import asdict, dataclass
from pathlib import Path

from shared.config import UserError
from zenav.batch.upload_files import Uploaded, UploadProgress, finished_recordings
from zenav.batch.upload_stores import upload_store
from zenav.batch.uploading import FolderUpload
from zenav.console.table import show_table

PATTERNS = ("*.mcap",)


@dataclass(frozen=True, slots=True)
class UploadState:
    """The upload of a recording. size, sent: bytes.  url: of its verified copy, empty without one."""

    recording: str
    size: int
    sent: int
    url: str

    @property
    def text(self) -> str:
        return self.url or (f"{self.sent / 1e6:.1f} MB of it" if self.sent else "no")


def upload(folder: Path, url: str, rate: float) -> int:
    """Uploads until all is uploaded; 0 then. rate: MB/s, 0 is unlimited. Raises UserError."""
    logging.disable(logging.WARNING)  # of the store's library: each error is reported once, in our words
    wait = threading.Event().wait
    run = FolderUpload(
        folder=folder,
        patterns=PATTERNS,
        store=upload_store(url, rate, wait),
        say_state=lambda text: None if text.endswith(" MB") else _say(text),
        say_event=lambda level, text: _say(text) if level == "INFO" else None,
        wait=wait,
    )
    n = run.run()
    sys.stdout.write(f"{n} recording{'' if n == 1 else 's'} uploaded\n")
    return 0


def show_uploads(folder: Path, as_json: bool) -> int:
    """Shows the state of each finished recording; 1 where one is not uploaded. Raises UserError."""
    rows = [_row(path) for path in finished_recordings(folder, PATTERNS)]
    if not rows:
        raise UserError(f"{folder} has no finished recording", "name the folder of recorder.folder")
    for row in rows if as_json else ():
        sys.stdout.write(json.dumps(asdict(row)) + "\n")
    if not as_json:
        cells = [(row.recording, f"{row.size / 1e6:.1f}", row.text) for row in rows]
        show_table("", ("recording", "MB", "uploaded"), cells)
    return 0 if all(row.url for row in rows) else 1


def _row(path: Path) -> UploadState:
    size, uploaded, progress = path.stat().st_size, Uploaded.of(path), UploadProgress.left(path)
    if uploaded is not None and uploaded.is_of(path):
        return UploadState(path.name, size, size, uploaded.url)
    sent = 0 if progress is None else min(len(progress.parts) * progress.part_size, size)
    return UploadState(path.name, size, sent, "")


def _say(text: str) -> None:
    sys.stderr.write(f"{text}\n")
