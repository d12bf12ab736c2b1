# SPDX-License-Identifier: Apache-2.0
"""Recordings: MCAP files that hold every message as it went on the wire, in the order in which the recorder took them.

A channel is a key without the robot's name; message encoding `msgpack`, the schema's text beside it. `log_time` is when
the recorder took a message, `publish_time` when it was sent. What was written until the last `flush` can be read
whatever happens to the writer; the same input gives the same file.
"""

import platform
import struct
import subprocess
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import IO, Any, cast

import lz4.frame  # type: ignore[import-untyped]  # it has no types
import mcap.records as mc
import mcap.writer
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

from shared import topics
from shared.codec import CodecError, decode, schema, schema_id
from shared.config import UserError
from shared.messages import Journal, Message
from shared.repeatable import processor
from shared.runners.host import Sent
from shared.runners.journal import Life, events_of
from shared.topics import SERVICES, key_of

CONFIG = "config.yaml"
"""The attachment with the effective configuration."""
ABOUT = "zenav"
"""The metadata record with robot, versions and commit."""

_CHUNK_BYTES = 64 * 1024
_LARGEST_CHUNK = 1 << 30  # bytes; what claims to be larger is damage, not a chunk
_MAGIC = mcap.writer.MCAP0_MAGIC
_FRAME = struct.Struct("<BQ")
_MESSAGE = struct.Struct("<HIQQ")
_DAMAGE = (McapError, struct.error, ValueError, OverflowError, MemoryError, RuntimeError, zstandard.ZstdError)
"""What the decoders of records and chunks raise on bytes that are not what they say."""


@dataclass(frozen=True, slots=True)
class Channel:
    """Where messages of one type went: the key without the robot's name, and how they are written."""

    key: str
    encoding: str
    schema_name: str
    schema_encoding: str
    schema: bytes


@dataclass(frozen=True, slots=True)
class Entry:
    """One recorded message. Times in ns on the stack's clock."""

    channel: Channel
    log_time: int
    sent: int
    sequence: int
    payload: bytes

    @property
    def key(self) -> str:
        return self.channel.key


# --- writing --------------------------------------------------------------------------------------------------------


class Writer:
    """Writes a recording. Every method may raise OSError; the file is then cut back to the last `flush` and closed.

    about: metadata, like robot and versions.   attachments: texts by name.   exclusive: never over another file.
    """

    def __init__(
        self,
        path: Path,
        about: Mapping[str, str] | None = None,
        attachments: Mapping[str, bytes] | None = None,
        exclusive: bool = False,
    ) -> None:
        self.path, self.n_messages = path, 0
        self._channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._file = _File(path, "xb" if exclusive else "wb")
        self._mcap = mcap.writer.Writer(cast(IO[Any], self._file), chunk_size=_CHUNK_BYTES)
        self._mcap.start(profile="zenav", library="zenav")
        self._mcap.add_metadata(ABOUT, dict(about or {}))
        for name, text in (attachments or {}).items():
            kind = "application/yaml" if name.endswith(".yaml") else "application/octet-stream"
            self._mcap.add_attachment(0, 0, name, kind, text)
        self.flush()

    def __enter__(self) -> "Writer":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()

    @property
    def size(self) -> int:
        """Bytes in the file."""
        return self._file.size

    def write(self, key: str, type_: type[Message], payload: bytes, log_time: int, sent: int, sequence: int) -> None:
        """Adds a message as it went on the wire: key without the robot's name, times in ns."""
        name = schema_id(type_)
        if (key, name) not in self._channels:
            self._declare(Channel(key, "msgpack", name, "zenav", schema(type_)))
        self._add(self._channels[(key, name)], payload, log_time, sent, sequence)

    def copy(self, entry: Entry) -> None:
        """Adds a message of another recording, with its own schema, also one that today's stack does not know."""
        name = entry.channel.schema_name
        if (entry.key, name) not in self._channels:
            self._declare(entry.channel)
        self._add(self._channels[(entry.key, name)], entry.payload, entry.log_time, entry.sent, entry.sequence)

    def flush(self) -> None:
        """Ends the open chunk and hands everything to the system: it outlives this process from here on."""
        try:
            self._mcap.flush()  # type: ignore[no-untyped-call]  # mcap's own
        except OSError:
            self._file.cut()
            raise
        self._file.kept = self._file.size

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

    def _declare(self, channel: Channel) -> None:
        name = channel.schema_name
        if name not in self._schemas:
            self._schemas[name] = self._mcap.register_schema(name, channel.schema_encoding, channel.schema)
        number = self._mcap.register_channel(channel.key, channel.encoding, self._schemas[name])
        self._channels[(channel.key, name)] = number

    def _add(self, channel: int, payload: bytes, log_time: int, sent: int, sequence: int) -> None:
        try:
            self._mcap.add_message(channel, _unsigned(log_time), payload, _unsigned(sent), sequence & 0xFFFFFFFF)
        except OSError:
            self._file.cut()
            raise
        self.n_messages += 1


class _File:
    """An unbuffered file for mcap's writer, whose own buffering would keep failing bytes and try them again."""

    def __init__(self, path: Path, mode: str) -> None:
        self._raw = cast(IO[bytes], path.open(mode, buffering=0))
        self.size = self.kept = 0

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
        """Nothing is held back."""

    def cut(self) -> None:
        """Gives up: nothing stays that was not flushed."""
        if not self._raw.closed:
            with suppress(OSError):  # the first error is the one to tell
                self._raw.truncate(self.kept)
            self._raw.close()

    def close(self) -> None:
        self._raw.close()


def sink(writer: Writer) -> Callable[[Sent], None]:
    """Records what a runner publishes, with the time of sending as the time of logging: Lockstep(record=sink(w))."""

    def record(sent: Sent) -> None:
        envelope = sent.envelope
        writer.write(sent.key, sent.topic.type, sent.payload, envelope.sent, envelope.sent, envelope.sequence)

    return record


def about(robot: str) -> dict[str, str]:
    """Metadata of a recording that is made here and now: robot, versions, machine, git commit where there is one.

    Where `arithmetic()` is the same, the last bits of a replay are.
    """
    return {"robot": robot, **{name: version(name) for name in ("msgpack", "mcap")}, **arithmetic(), **_commit()}


def arithmetic() -> dict[str, str]:
    """What the last bits of a computation depend on here: processor, C library, numpy, numba."""
    libc = " ".join(platform.libc_ver())
    return {"processor": processor(), "libc": libc, "numpy": version("numpy"), "numba": version("numba")}


def _commit() -> dict[str, str]:
    try:
        found = subprocess.run(
            ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            timeout=5,
        )
    except (OSError, subprocess.TimeoutExpired):
        return {}
    return {"commit": found.stdout.strip()} if found.returncode == 0 else {}


def _unsigned(number: int) -> int:
    return min(max(number, 0), 2**64 - 1)


# --- reading --------------------------------------------------------------------------------------------------------


class Recording:
    """A recording that is read. A damaged file gives what is there; `problems` says what is not.

    Raises UserError where there is no file, nothing in it, or something else than MCAP.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.about: dict[str, str] = {}
        self.attachments: dict[str, bytes] = {}
        self._problems: dict[int, str] = {}  # by place in the file: reading twice tells once
        self._schemas: dict[int, mc.Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._blocks: list[tuple[int, int, int]] = []  # opcode, place, length of what holds messages
        try:
            with path.open("rb") as file:
                self._scan(file)
        except OSError as error:
            raise UserError(f"cannot read {path}: {error.strerror}", "check the path and its permissions") from None

    @property
    def problems(self) -> list[str]:
        """What is damaged or missing, as far as it was read: complete after `entries` ran to its end."""
        return [text for _, text in sorted(self._problems.items())]

    def entries(self, keys: Iterable[str] | None = None) -> Iterator[Entry]:
        """The messages of some keys, or of all, in the order in which they were recorded."""
        wanted = None if keys is None else frozenset(keys)
        with self.path.open("rb") as file:
            for opcode, place, length in self._blocks:
                file.seek(place)
                body = file.read(length)
                try:
                    records = _chunk(body) if opcode == Opcode.CHUNK else _FRAME.pack(opcode, length) + body
                except _DAMAGE as error:
                    self._problems[place] = f"a chunk of {length} bytes at byte {place} is damaged: {error}"
                    continue
                yield from self._messages(records, place, wanted)

    def lives(self) -> dict[str, list[Life]]:
        """By service, its sessions in the order in which they began, each with the events that its journals tell."""
        parts: dict[tuple[str, str], list[Journal]] = {}
        names = {key_of(topics.JOURNAL, name): name for name in SERVICES}
        for entry in self.entries(names):
            try:
                journal, _ = decode(Journal, entry.payload)
            except CodecError:
                continue  # a hole, told where its events are missed
            parts.setdefault((names[entry.key], journal.session), []).append(journal)
        found: dict[str, list[Life]] = {}
        for (name, session), journals in parts.items():
            found.setdefault(name, []).append(Life(name, session, events_of(journals)))
        return found

    def _scan(self, file: IO[bytes]) -> None:
        size = file.seek(0, 2)
        file.seek(0)
        if size == 0:
            raise UserError(f"{self.path} is empty", "its recorder was stopped before it wrote anything: record again")
        if file.read(len(_MAGIC)) != _MAGIC:
            raise UserError(f"{self.path} is no MCAP file", "name a recording, like recordings/x80-*.mcap")
        place = len(_MAGIC)
        while place + _FRAME.size <= size:
            opcode, length = _FRAME.unpack(file.read(_FRAME.size))
            place += _FRAME.size
            if place + length > size:
                break
            if opcode in (Opcode.CHUNK, Opcode.MESSAGE):
                self._blocks.append((opcode, place, length))
            elif opcode in (Opcode.METADATA, Opcode.ATTACHMENT, Opcode.SCHEMA, Opcode.CHANNEL):
                self._note(opcode, file.read(length), place)
            elif opcode == Opcode.FOOTER:
                return
            place += length
            file.seek(place)
        rest = size - min(place, size)
        self._problems[size] = "the recording was not closed" + (
            f": its last {rest} bytes are the beginning of a record whose end is missing" if rest else ""
        )

    def _note(self, opcode: int, body: bytes, place: int) -> None:
        stream = ReadDataStream(BytesIO(body))
        try:
            if opcode == Opcode.METADATA:
                metadata = mc.Metadata.read(stream)
                self.about |= metadata.metadata if metadata.name == ABOUT else {}
            elif opcode == Opcode.ATTACHMENT:
                attachment = mc.Attachment.read(stream)
                self.attachments[attachment.name] = attachment.data
            elif opcode == Opcode.SCHEMA:
                found = mc.Schema.read(stream)
                self._schemas[found.id] = found
            elif opcode == Opcode.CHANNEL:
                channel = mc.Channel.read(stream)
                of = self._schemas.get(channel.schema_id) or mc.Schema(0, b"", "", "")
                self._channels[channel.id] = Channel(
                    channel.topic, channel.message_encoding, of.name, of.encoding, of.data
                )
        except _DAMAGE as error:
            self._problems[place] = f"a record at byte {place} is damaged: {error}"

    def _messages(self, records: bytes, place: int, wanted: frozenset[str] | None) -> Iterator[Entry]:
        at, n_orphans = 0, 0
        while at + _FRAME.size <= len(records):
            opcode, length = _FRAME.unpack_from(records, at)
            at += _FRAME.size
            end = at + length
            if end > len(records) or (opcode == Opcode.MESSAGE and length < _MESSAGE.size):
                self._problems[place] = f"the chunk at byte {place} breaks off inside"
                return
            if opcode == Opcode.MESSAGE:
                number, sequence, log_time, sent = _MESSAGE.unpack_from(records, at)
                channel = self._channels.get(number)
                if channel is None:
                    n_orphans += 1
                elif wanted is None or channel.key in wanted:
                    yield Entry(channel, log_time, sent, sequence, records[at + _MESSAGE.size : end])
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self._note(opcode, records[at:end], place)
            at = end
        if n_orphans:
            self._problems[place] = f"{n_orphans} messages at byte {place} belong to channels that are lost"


def _chunk(body: bytes) -> bytes:
    """The records of a chunk. Raises one of _DAMAGE."""
    chunk = mc.Chunk.read(ReadDataStream(BytesIO(body)))
    size = chunk.uncompressed_size
    if size > _LARGEST_CHUNK:
        raise ValueError(f"it claims {size} bytes")
    if chunk.compression == "zstd":
        if zstandard.frame_content_size(chunk.data) not in (-1, size):
            raise ValueError("its sizes contradict each other")
        records = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size)
    elif chunk.compression == "lz4":
        records = lz4.frame.decompress(chunk.data)
    elif chunk.compression == "":
        records = chunk.data
    else:
        raise ValueError(f"unknown compression {chunk.compression!r}")
    if chunk.uncompressed_crc and zlib.crc32(records) != chunk.uncompressed_crc:
        raise ValueError("its checksum is wrong")
    return bytes(records)
