# SPDX-License-Identifier: Apache-2.0
"""Files of a recording: names, parts, retention. All disk access of the recorder is here."""

import glob
import json
import os
import platform
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from fnmatch import fnmatchcase
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Self

from pydantic import Field, field_validator, model_validator

from services.recorder.retention import KEEP_SUFFIX, UPLOADED_SUFFIX, StoredRecording, recordings_to_remove
from services.recorder.upload_process import UploadOrder, UploadProcess, check_upload
from shared import recording
from shared.codec import Envelope
from shared.config import Section, UserError, nearest
from shared.file_modes import make_folder
from shared.messages import Message
from shared.recording import CONFIG, Drop
from shared.recordings.latched_state import Value
from shared.service import Log
from shared.topics import KEYS

MB = 1e6
START_NAME = r"-\d{8}-\d{6}(-\d+)?(\.part\d+)?"
"""What follows the robot in a name that the recorder gives. A recording that a user named differs, and stays."""


class RecorderConfig(Section):
    """Which topics are recorded, and where."""

    folder: str = Field("recordings", min_length=1, description="folder of the recordings; created if missing")
    file: str = Field("", description="file to write, as out/run.mcap; empty: named by robot and start time")
    topics: tuple[str, ...] = Field(
        ("*",),
        min_length=1,
        description="recorded keys, * matches any text; a byte-exact replay needs journal/*",
    )
    exclude: tuple[str, ...] = Field((), description="keys of `topics` that are not recorded, as sim/*")
    attach: tuple[str, ...] = Field((), description="files to attach to every part, as those of a saved map")
    split_size: float = Field(1000, gt=0, le=1e6, description="maximum size of a part, MB")
    split_time: float = Field(0, ge=0, le=1e7, description="maximum duration of a part, s; 0: no limit")
    budget: float = Field(
        10_000,
        gt=0,
        le=1e7,
        description="MB for this robot's recordings in the folder; the oldest unmarked ones are removed, "
        "uploaded ones before others",
    )
    upload: str = Field(
        "",
        description="where finished parts are uploaded: s3://BUCKET/FOLDER, another URL of fsspec, or a folder; "
        "empty: nowhere",
    )
    upload_rate: float = Field(0, ge=0, le=1e5, description="MB/s that an upload takes at most; 0: no limit")

    @field_validator("topics", "exclude")
    @classmethod
    def _check_topics(cls, patterns: tuple[str, ...]) -> tuple[str, ...]:
        for pattern in patterns:
            if not any(fnmatchcase(key, pattern) for key in KEYS):
                raise ValueError(f"{pattern} is not a topic; {nearest(pattern, KEYS)}")
        return patterns

    @model_validator(mode="after")
    def _check_budget(self) -> Self:
        if self.split_size > self.budget / 2:
            raise ValueError("split_size is over half of the budget: there would be no older part to remove")
        return self

    @property
    def recordings_folder(self) -> Path:
        """Where the files are."""
        return Path(self.file).parent if self.file else Path(self.folder)

    def wanted(self) -> frozenset[str]:
        """The recorded keys: those of `topics` without those of `exclude`."""
        chosen = (key for key in KEYS if any(fnmatchcase(key, pattern) for pattern in self.topics))
        return frozenset(key for key in chosen if not any(fnmatchcase(key, pattern) for pattern in self.exclude))


class RecordingStore:
    """One recording in its parts. Never overwrites a file: a restarted recorder begins `NAME-2.mcap`."""

    def __init__(self, config: RecorderConfig) -> None:
        self.config = config
        self._writer: recording.Writer | None = None
        self._stem = ""  # of the first part
        self._n_parts = 0
        self._part_start = 0
        self._attachments = {Path(name).name: _read_attachment(Path(name)) for name in config.attach}
        self._robot = ""
        self._upload, self._pending_logs = UploadProcess(), list[Log]()
        self.n_removed_before_upload = 0
        self.last_drops: list[Drop] = []
        """Missing messages that `close` writes."""
        if config.upload:
            check_upload(config.upload)
        folder = config.recordings_folder
        try:
            make_folder(folder)
        except OSError as error:
            raise UserError(f"cannot make {folder}: {error.strerror}", "set recorder.folder") from None
        self._folder = folder

    @property
    def path(self) -> Path | None:
        """Path of the open part; None without one."""
        return self._writer.path if self._writer is not None else None

    def begin(self, now: int, robot: str, robot_file: str, latched: Iterable[Value]) -> None:
        """Begins a part at `now` (ns) with the latched values. Raises OSError."""
        suffix = Path(self.config.file).suffix or ".mcap"
        if not self._stem:
            start = f"{datetime.fromtimestamp(now / 1e9, UTC):%Y%m%d-%H%M%S}"
            self._stem = Path(self.config.file).stem or f"{robot}-{start}"
        metadata = {**recording.about(robot), **_host_metadata(), "part": str(self._n_parts + 1)}
        attachments = self._attachments | ({CONFIG: robot_file.encode()} if robot_file else {})
        writer = self._open_writer(suffix, metadata, attachments)
        try:
            for value in latched:
                sent, sequence = value.envelope.sent, value.envelope.sequence
                writer.write(value.key, value.type, value.payload, now, sent, sequence, latched=True)
            writer.flush()
        except OSError:
            with suppress(OSError):
                writer.path.unlink()  # the part is empty
            raise
        self._writer, self._part_start, self._robot = writer, now, robot
        self._n_parts += 1
        self._remove_old_recordings()
        self._wake_upload()

    def configure(self, config: RecorderConfig) -> None:
        """Takes other settings: the limits hold for the open part too, the budget from the next part on."""
        self.config = config
        if self._robot:
            self._wake_upload()

    def step_upload(self) -> Iterator[Log]:
        """Keeps the uploader going, and returns what there is to say. Waits for nothing."""
        logs, self._pending_logs = self._pending_logs, []
        yield from logs
        yield from self._upload.step()

    @property
    def upload_text(self) -> str:
        """State of the uploads in a few words; empty without uploads."""
        return self._upload.text if self.config.upload else ""

    def write(
        self, key: str, type_: type[Message], payload: bytes, log_time: int, envelope: Envelope, latched: bool = False
    ) -> None:
        """Writes a message, or a latched value; log_time: ns. Raises OSError."""
        if self._writer is None:
            raise OSError("no recording is open")
        self._writer.write(key, type_, payload, log_time, envelope.sent, envelope.sequence, latched)

    def note_drops(self, drops: list[Drop]) -> None:
        """Writes which messages are missing. Raises OSError."""
        if self._writer is not None:
            self._writer.note_drops(drops)

    def flush(self) -> None:
        """Flushes the file: its content survives a crash of this process. Raises OSError."""
        if self._writer is not None:
            self._writer.flush()

    def is_full(self, now: int) -> bool:
        """Whether the open part has reached its maximum size or duration at `now` (ns)."""
        if self._writer is None:
            return False
        seconds = (now - self._part_start) / 1e9
        long = 0 < self.config.split_time <= seconds
        return long or self._writer.size >= self.config.split_size * MB

    def end(self) -> None:
        """Closes the open part and writes its index. Raises OSError."""
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.close()

    def close(self) -> None:
        """Closes the recording and writes its index. Raises UserError on a disk error."""
        path = self.path
        self._upload.close()
        try:
            self.note_drops(self.last_drops)
            self.end()
        except OSError as error:
            what = f"{path}: its end could not be written: {error.strerror}"
            raise UserError(what, f"free the disk; then: zenav recording repair {path}") from None

    def _open_writer(
        self, suffix: str, metadata: Mapping[str, str], attachments: Mapping[str, bytes]
    ) -> recording.Writer:
        """Opens a new file: the recording's next part, or for its first part the first free name."""
        n = 1
        while True:
            if self._n_parts:
                stem = f"{self._stem}.part{self._n_parts + n:03}"
            else:
                stem = self._stem if n == 1 else f"{self._stem}-{n}"
            path, name = self._folder / f"{stem}{suffix}", self._stem if self._n_parts else stem
            try:
                writer = recording.Writer(path, {**metadata, "recording": name}, attachments, exclusive=True)
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

    def _remove_old_recordings(self) -> None:
        """Removes the oldest recordings over the budget; ignores disk errors."""
        own = rf"{re.escape(self._stem)}\.part\d+" if self.config.file else f"{self._robot}{START_NAME}"
        names, recordings = set[str](), []
        with suppress(OSError):
            names.update(os.listdir(self._folder))
        for name in names:
            path = self._folder / name
            if path != self.path and re.fullmatch(rf"{own}\.mcap", name):
                with suppress(OSError):  # removed meanwhile, or a link that leads nowhere: the others count
                    recordings.append(_stored_recording(path, names))
        reserved = min(self.config.split_size, self.config.budget) * MB  # maximum size of the open part
        uploaded = {recording.path for recording in recordings if recording.uploaded}
        for path in recordings_to_remove(recordings, round(self.config.budget * MB - reserved)):
            with suppress(OSError):
                path.unlink()
                path.with_name(path.name + UPLOADED_SUFFIX).unlink(missing_ok=True)
                if self.config.upload and path not in uploaded:
                    self.n_removed_before_upload += 1
                    text = f"{path} was removed before its upload: the recordings reached recorder.budget"
                    self._pending_logs.append(Log("WARNING", text))

    def _wake_upload(self) -> None:
        if not self.config.upload:
            return
        suffix = Path(self.config.file).suffix or ".mcap"
        stem = glob.escape(Path(self.config.file).stem)
        names = (stem, f"{stem}-[0-9]*", f"{stem}.part[0-9]*") if self.config.file else (f"{self._robot}-[0-9]*",)
        patterns = tuple(f"{name}{suffix}" for name in names)
        self._upload.wake(UploadOrder(str(self._folder), self.config.upload, self.config.upload_rate, patterns))


def _stored_recording(path: Path, names: set[str]) -> StoredRecording:
    """A recording of a folder with these names. Raises OSError."""
    stat, uploaded = path.stat(), False
    if path.name + UPLOADED_SUFFIX in names:
        with suppress(OSError, ValueError, KeyError, TypeError):  # half of it was written: it was not uploaded
            record = json.loads(path.with_name(path.name + UPLOADED_SUFFIX).read_bytes())
            uploaded = (record["size"], record["changed"]) == (stat.st_size, stat.st_mtime_ns)
    return StoredRecording(path, stat.st_size, stat.st_mtime_ns, path.name + KEEP_SUFFIX in names, uploaded)


def _read_attachment(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise UserError(f"cannot read {path}: {error.strerror}", "set recorder.attach") from None


def _host_metadata() -> dict[str, str]:
    """Host name, Python version and package versions, for the recording's metadata."""
    recordings = {"host": platform.node(), "python": platform.python_version()}
    for name in ("zenav", "eclipse-zenoh"):
        with suppress(PackageNotFoundError):
            recordings[name] = version(name)
    return recordings
