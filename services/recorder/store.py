# SPDX-License-Identifier: Apache-2.0
"""The recording's files: where they go, and the only place where the recorder touches the disk."""

import os
import platform
from collections.abc import Iterable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Self

from pydantic import Field, field_validator, model_validator

from services.recorder.retention import KEEP, Kept, to_remove
from shared import recording
from shared.codec import Envelope
from shared.config import Section, UserError, nearest
from shared.messages import Message
from shared.recording import CONFIG, Drop
from shared.recordings.held import Value
from shared.topics import KEYS

MB = 1e6


class RecorderConfig(Section):
    """What is recorded, and where."""

    folder: str = Field("recordings", min_length=1, description="folder of the recordings; made where it is missing")
    file: str = Field("", description="this file instead of one named by robot and start, like out/run.mcap")
    topics: tuple[str, ...] = Field(
        ("*",),
        min_length=1,
        description="keys that are recorded, * stands for anything; a replay equal to the byte needs journal/*",
    )
    exclude: tuple[str, ...] = Field((), description="keys that are not, though `topics` has them, like sim/*")
    attach: tuple[str, ...] = Field((), description="files that go into every part, like those of a saved map")
    split_size: float = Field(1000, gt=0, le=1e6, description="MB, at which a part ends and the next begins")
    split_time: float = Field(0, ge=0, le=1e7, description="s, after which a part ends and the next begins; 0: never")
    budget: float = Field(
        10_000,
        gt=0,
        le=1e7,
        description="MB for this robot's recordings in the folder: the oldest go, but never marked ones",
    )

    @field_validator("topics", "exclude")
    @classmethod
    def _known(cls, patterns: tuple[str, ...]) -> tuple[str, ...]:
        for pattern in patterns:
            if not any(fnmatchcase(key, pattern) for key in KEYS):
                raise ValueError(f"{pattern} is not a topic; {nearest(pattern, KEYS)}")
        return patterns

    @model_validator(mode="after")
    def _room(self) -> Self:
        if self.split_size > self.budget / 2:
            raise ValueError("split_size is over half of the budget: there would be no older part to remove")
        return self

    def wanted(self) -> frozenset[str]:
        """The keys that are recorded."""
        chosen = (key for key in KEYS if any(fnmatchcase(key, pattern) for pattern in self.topics))
        return frozenset(key for key in chosen if not any(fnmatchcase(key, pattern) for pattern in self.exclude))


class RecordingStore:
    """One recording in its parts. Never writes over another file: a recorder that comes back begins `NAME-2.mcap`."""

    def __init__(self, config: RecorderConfig) -> None:
        self._config = config
        self._writer: recording.Writer | None = None
        self._stem = ""  # of the first part
        self._n_parts = 0
        self._begun = 0
        self._attached = {Path(name).name: _content(Path(name)) for name in config.attach}
        folder = Path(config.file).parent if config.file else Path(config.folder)
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UserError(f"cannot make {folder}: {error.strerror}", "set recorder.folder") from None
        self._folder = folder

    @property
    def path(self) -> Path | None:
        """The open part."""
        return self._writer.path if self._writer is not None else None

    def begin(self, now: int, robot: str, robot_file: str, held: Iterable[Value]) -> None:
        """Begins a part at `now` (ns) with the values that are held for late joiners. Raises OSError."""
        suffix = Path(self._config.file).suffix or ".mcap"
        if not self._stem:
            start = f"{datetime.fromtimestamp(now / 1e9, UTC):%Y%m%d-%H%M%S}"
            self._stem = Path(self._config.file).stem or f"{robot}-{start}"
        about = {**recording.about(robot), **_here(), "part": str(self._n_parts + 1)}
        attachments = self._attached | ({CONFIG: robot_file.encode()} if robot_file else {})
        writer = self._opened(suffix, about, attachments)
        try:
            for value in held:
                sent, sequence = value.envelope.sent, value.envelope.sequence
                writer.write(value.key, value.type, value.payload, now, sent, sequence, latched=True)
            writer.flush()
        except OSError:
            with suppress(OSError):
                writer.path.unlink()  # a part with nothing in it
            raise
        self._writer, self._begun = writer, now
        self._n_parts += 1
        self._tidy(robot)

    def write(
        self, key: str, type_: type[Message], payload: bytes, log_time: int, envelope: Envelope, latched: bool = False
    ) -> None:
        """Adds a message, or what was kept for late joiners. Raises OSError."""
        if self._writer is None:
            raise OSError("no recording is open")
        self._writer.write(key, type_, payload, log_time, envelope.sent, envelope.sequence, latched)

    def note_drops(self, drops: list[Drop]) -> None:
        """Writes down what was missed. Raises OSError."""
        if self._writer is not None:
            self._writer.note_drops(drops)

    def flush(self) -> None:
        """What was written outlives this process from here on. Raises OSError."""
        if self._writer is not None:
            self._writer.flush()

    def full(self, now: int) -> bool:
        """Whether the open part is as large or as long as it may become, at `now` (ns)."""
        if self._writer is None:
            return False
        seconds = (now - self._begun) / 1e9
        long = 0 < self._config.split_time <= seconds
        return long or self._writer.size >= self._config.split_size * MB

    def end(self) -> None:
        """Ends the open part with its index. Raises OSError."""
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.close()

    def close(self) -> None:
        """Ends the recording with its index. Raises UserError where the disk refuses it."""
        path = self.path
        try:
            self.end()
        except OSError as error:
            what = f"{path}: its end could not be written: {error.strerror}"
            raise UserError(what, f"free the disk; then: zenav recording repair {path}") from None

    def _opened(self, suffix: str, about: Mapping[str, str], attachments: Mapping[str, bytes]) -> recording.Writer:
        """A new file: the recording's n-th part, or for its first one the first name that is free."""
        n = 1
        while True:
            if self._n_parts:
                stem = f"{self._stem}.part{self._n_parts + n:03}"
            else:
                stem = self._stem if n == 1 else f"{self._stem}-{n}"
            path, name = self._folder / f"{stem}{suffix}", self._stem if self._n_parts else stem
            try:
                writer = recording.Writer(path, {**about, "recording": name}, attachments, exclusive=True)
            except FileExistsError:
                n += 1
                continue
            except OSError:
                with suppress(OSError):
                    path.unlink()
                raise
            if not self._n_parts:
                self._stem = stem
            return writer

    def _tidy(self, robot: str) -> None:
        """Removes the oldest recordings that are over the budget; the disk's own refusal is not worth a word."""
        own = f"{self._stem}.part[0-9]*" if self._config.file else f"{robot}-[0-9]*"
        found = []
        with suppress(OSError):
            names = set(os.listdir(self._folder))
            for name in names:
                path = self._folder / name
                if path != self.path and path.suffix == ".mcap" and fnmatchcase(name, own):
                    about = path.stat()
                    found.append(Kept(path, about.st_size, about.st_mtime_ns, name + KEEP in names))
        coming = min(self._config.split_size, self._config.budget) * MB  # what the open part may still become
        for path in to_remove(found, round(self._config.budget * MB - coming)):
            with suppress(OSError):
                path.unlink()


def _content(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}", "set recorder.attach") from None


def _here() -> dict[str, str]:
    """What else a recording tells of the machine and the programs that made it."""
    found = {"host": platform.node(), "python": platform.python_version()}
    for name in ("zenav", "eclipse-zenoh"):
        with suppress(PackageNotFoundError):
            found[name] = version(name)
    return found
