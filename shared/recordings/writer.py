# SPDX-License-Identifier: Apache-2.0
"""Writer of recordings (MCAP, by the `mcap` package), also onto a disk that is full or fails."""

import fcntl
import os
from collections.abc import Iterable, Iterator, Mapping
from contextlib import suppress
from itertools import groupby
from pathlib import Path
from types import TracebackType
from typing import IO, Any, cast

import mcap.writer
from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex

from shared.file_modes import opener
from shared.messages import Message
from shared.recordings.frames import MAGIC
from shared.recordings.reader import ABOUT, DROPS, ENCODING, LATCHED, Channel, Drop, Entry, drops_record
from shared.schema import schema, schema_id

_CHUNK_BYTES = 64 * 1024


class Writer:
    """Writes a recording. Every method may raise OSError; the file is then cut back to the last `flush` and closed.

    about: metadata, like robot and versions.   attachments: by name.   exclusive: never replaces a file.
    profile: of another program, where the file is a copy of its file.
    """

    def __init__(
        self,
        path: Path,
        about: Mapping[str, str] | None = None,
        attachments: Mapping[str, bytes] | None = None,
        exclusive: bool = False,
        profile: str = "zenav",
    ) -> None:
        self.path, self.n_messages = path, 0
        self._channels: dict[Channel, int] = {}
        self._own: dict[tuple[str, type[Message], bool], int] = {}
        self._schemas: dict[tuple[str, bytes], int] = {}
        self._file = _File(path, "xb" if exclusive else "wb")
        self._mcap = mcap.writer.Writer(cast(IO[Any], self._file), chunk_size=_CHUNK_BYTES)
        vars(self._mcap)["_Writer__chunk_indices"] = _ChunkIndexes()  # mcap has no public place for it
        try:
            self._mcap.start(profile=profile, library="zenav")
            self._mcap.add_metadata(ABOUT, dict(about or {}))
            for name, content in (attachments or {}).items():
                kind = "application/yaml" if name.endswith(".yaml") else "application/octet-stream"
                self._mcap.add_attachment(0, 0, name, kind, content)
        except OSError:
            self._file.cut()
            raise
        self.flush()

    def __enter__(self) -> "Writer":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._file.size

    def write(
        self,
        key: str,
        type_: type[Message],
        payload: bytes,
        log_time: int,
        sent: int,
        sequence: int,
        latched: bool = False,
    ) -> None:
        """Adds an encoded message: key without the robot's name, times in ns. latched: see Channel."""
        number = self._own.get((key, type_, latched))
        if number is None:
            metadata = (LATCHED,) if latched else ()
            number = self._declared(
                Channel(
                    key=key,
                    encoding="msgpack",
                    schema_name=schema_id(type_),
                    schema_encoding=ENCODING,
                    schema=schema(type_),
                    metadata=metadata,
                )
            )
            self._own[(key, type_, latched)] = number
        self._add(number, payload, log_time, sent, sequence)

    def copy(self, entry: Entry) -> None:
        """Adds a message of another recording with its schema, which this stack need not know."""
        number = self._declared(entry.channel)
        self._add(number, entry.payload, entry.log_time, entry.sent, entry.sequence)

    def note_drops(self, drops: Iterable[Drop]) -> None:
        """Adds records of missed messages."""
        for _, together in groupby(drops, key=lambda drop: (drop.at, drop.why)):
            self.note(DROPS, drops_record(together))

    def note(self, name: str, metadata: Mapping[str, str]) -> None:
        """Adds a metadata record."""
        try:
            self._mcap.add_metadata(name, dict(metadata))
        except OSError:
            self._file.cut()
            raise

    def flush(self) -> None:
        """Ends the open chunk and writes it to the operating system: it survives the end of this process."""
        try:
            self._mcap.flush()  # type: ignore[no-untyped-call]  # mcap's own
        except OSError:
            self._file.cut()
            raise
        self._file.flushed_size = self._file.size

    def close(self) -> None:
        """Writes the index and closes; may be called twice."""
        if self._file.closed:
            return
        try:
            self._mcap.finish()  # type: ignore[no-untyped-call]  # mcap's own
        except OSError:
            self._file.cut()
            raise
        self._file.close()

    def _declared(self, channel: Channel) -> int:
        """The channel's number in this file."""
        number = self._channels.get(channel)
        if number is None:
            of, metadata = (channel.schema_name, channel.schema), dict(channel.metadata)
            if channel.schema_name and of not in self._schemas:
                self._schemas[of] = self._mcap.register_schema(of[0], channel.schema_encoding, of[1])
            number = self._mcap.register_channel(channel.key, channel.encoding, self._schemas.get(of, 0), metadata)
            self._channels[channel] = number
        return number

    def _add(self, channel: int, payload: bytes, log_time: int, sent: int, sequence: int) -> None:
        try:
            self._mcap.add_message(channel, _unsigned(log_time), payload, _unsigned(sent), sequence & 0xFFFFFFFF)
        except OSError:
            self._file.cut()
            raise
        self.n_messages += 1


def is_finished(file: IO[bytes]) -> bool:
    """Whether no process writes the recording. Keeps a shared lock on it until the file is closed."""
    try:
        return not is_locked(file)
    except OSError:  # the file system has no locks
        return file.seek(0, os.SEEK_END) >= len(MAGIC) and _end_of(file) == MAGIC


def is_locked(file: IO[bytes]) -> bool:
    """Whether a process holds the writer's lock. If not, keeps a shared lock on the file until it is closed.

    Raises OSError where the file system has no locks.
    """
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    return False


def _end_of(file: IO[bytes]) -> bytes:
    file.seek(-len(MAGIC), os.SEEK_END)
    return file.read()


class _File:
    """An unbuffered file for mcap's writer, whose own buffering would keep failing bytes and try them again.

    The process holds a lock on it while it writes. The kernel releases the lock of a killed process, too.
    """

    def __init__(self, path: Path, mode: str) -> None:
        self._raw = cast(IO[bytes], open(path, mode, buffering=0, opener=opener))  # noqa: SIM115  # as long as the writer
        with suppress(OSError):  # of a file system without locks
            fcntl.flock(self._raw, fcntl.LOCK_EX | fcntl.LOCK_NB)
        self.size = self.flushed_size = 0

    @property
    def closed(self) -> bool:
        return self._raw.closed

    def write(self, data: bytes) -> int:
        view = memoryview(data)
        while view:
            n_written = self._raw.write(view)
            self.size += n_written
            view = view[n_written:]
        return len(data)

    def tell(self) -> int:
        return self.size

    def flush(self) -> None:
        """Does nothing: the file has no buffer."""

    def cut(self) -> None:
        """Cuts the file back to the last flush and closes it."""
        if not self._raw.closed:
            with suppress(OSError):  # the first error is the informative one
                self._raw.truncate(self.flushed_size)
            self._raw.close()

    def close(self) -> None:
        self._raw.close()


class _ChunkIndexes:
    """Takes the place of mcap's list of chunk indexes, and keeps their bytes alone.

    An index with 40 channels is an object of 2.7 kB, and 0.5 kB in the file. A recording has two or more a second.
    """

    def __init__(self) -> None:
        self._records = bytearray()

    def append(self, index: ChunkIndex) -> None:
        builder = RecordBuilder()
        index.write(builder)
        self._records += builder.end()  # type: ignore[no-untyped-call]  # mcap's own

    def __iter__(self) -> Iterator["_ChunkIndexes"]:
        yield self

    def write(self, builder: RecordBuilder) -> None:
        """Adds all of them to the summary, in the order of the chunks."""
        builder.write(self._records)


def _unsigned(number: int) -> int:
    return min(max(number, 0), 2**64 - 1)
