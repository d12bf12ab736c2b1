# SPDX-License-Identifier: Apache-2.0
"""The recording's file: where it goes, and the only place where the recorder touches the disk."""

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path

from pydantic import Field

from shared import recording
from shared.config import Section, UserError
from shared.messages import Message


class RecorderConfig(Section):
    """Where recordings go."""

    folder: str = Field("recordings", min_length=1, description="folder of the recordings; made where it is missing")
    file: str = Field("", description="this file instead of one named by robot and start, like out/run.mcap")
    max_size: float = Field(10_000, gt=0, le=1e6, description="MB, at which recording ends, so that the disk survives")


class RecordingStore:
    """One recording. Never writes over another file: a recorder that comes back begins `NAME-2.mcap`."""

    def __init__(self, config: RecorderConfig) -> None:
        self._config = config
        self._writer: recording.Writer | None = None
        folder = Path(config.file).parent if config.file else Path(config.folder)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"cannot make {folder}: {error.strerror}", "set recorder.folder") from None
        self._folder = folder

    def begin(self, now: int, robot: str, attachments: Mapping[str, bytes]) -> None:
        """Begins the recording that starts at `now` (ns). Raises OSError."""
        name = Path(self._config.file).name or f"{robot}-{datetime.fromtimestamp(now / 1e9, UTC):%Y%m%d-%H%M%S}.mcap"
        path, about = self._folder / name, recording.about(robot)
        n = 1
        while self._writer is None:
            try:
                self._writer = recording.Writer(path, about, attachments, exclusive=True)
            except FileExistsError:
                n += 1
                path = self._folder / f"{Path(name).stem}-{n}{Path(name).suffix}"

    def write(self, key: str, type_: type[Message], payload: bytes, log_time: int, sent: int, sequence: int) -> None:
        """Adds a message. Raises OSError, also where the recording is as large as it may become."""
        if self._writer is None:
            raise OSError("no recording is open")
        if self._writer.size > self._config.max_size * 1e6:
            raise OSError(f"recorder.max_size of {self._config.max_size:g} MB is reached")
        self._writer.write(key, type_, payload, log_time, sent, sequence)

    def flush(self) -> None:
        """What was written outlives this process from here on. Raises OSError."""
        if self._writer is not None:
            self._writer.flush()

    def close(self) -> None:
        """Ends the recording with its index. Raises UserError where the disk refuses it."""
        if self._writer is None:
            return
        try:
            self._writer.close()
        except OSError as error:
            what = f"{self._writer.path}: its end could not be written: {error.strerror}"
            raise UserError(what, "free the disk; what was recorded until the last second can be read") from None
