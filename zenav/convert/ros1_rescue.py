# SPDX-License-Identifier: Apache-2.0
"""Messages of a ROS 1 bag whose index does not read: the records, from the file's beginning.

A record is `length, header, length, data`; a header is `length, name=value` fields, one of which is `op`. What is no
record is skipped until the next one, and counted. Source: http://wiki.ros.org/Bags/Format/2.0
"""

import bz2
import mmap
import re
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, TypeAlias

import lz4.frame  # type: ignore[import-untyped]  # it has no types

from shared.config import UserError

MESSAGE, CHUNK, CONNECTION = 2, 5, 7
OPS = range(2, 8)
MAX_HEADER_BYTES = 1 << 20  # a connection's header holds names only
MARK = re.compile(rb"\x04\x00\x00\x00op=[\x02-\x07]")  # a field that every header has
BEFORE = 512  # bytes of other fields before the mark
MIN_HEADER_BYTES = 64  # about: a header with its lengths
LENGTH = struct.Struct("<I")
MAX_CHUNK_BYTES = 1 << 28  # unpacked; a larger size in a header is damage
SLICE = 1 << 14  # bytes that are unpacked at a time: what comes before damage is kept
DECOMPRESSORS = {b"lz4": lz4.frame.LZ4FrameDecompressor, b"bz2": bz2.BZ2Decompressor}
Bytes: TypeAlias = bytes | mmap.mmap
Message: TypeAlias = tuple[str, str, int, bytes]
"""Topic, type, ns when it was recorded, and the message's bytes."""


class BagRecord(NamedTuple):
    """op, fields by name, and where the data lie."""

    op: int
    fields: dict[bytes, bytes]
    start: int
    end: int


def records(content: Bytes, at: int, lost: list[int]) -> Iterator[BagRecord]:
    """The records of `content` from a place on. Bytes that are none are counted in `lost`.

    The data of an uncompressed chunk are records themselves and are gone through as such: so a chunk whose length is
    wrong costs nothing. A record counts only where another one, or the end, follows it.
    """
    while at < len(content):
        record = _record(content, at)
        if record is not None and (record.op == CHUNK or _followed(content, record.end)):
            yield record
            at = record.start if record.op == CHUNK and record.fields.get(b"compression") == b"none" else record.end
            continue
        next_at = _next(content, at + 1)
        lost.append((len(content) if next_at is None else next_at) - at)
        if next_at is None:
            return
        at = next_at


def rescue_messages(path: Path) -> tuple[Iterator[Message], list[str]]:
    """The messages of a bag, one by one, and what was lost, in words: complete when they are through."""
    lost: list[str] = []
    return _messages(path, lost), lost


def _messages(path: Path, lost: list[str]) -> Iterator[Message]:
    gaps: list[int] = []
    n_chunks = n_orphans = 0
    topics: dict[bytes, tuple[str, str]] = {}
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        begin = content.find(b"\n") + 1
        if content[:begin] != b"#ROSBAG V2.0\n":
            raise UserError(f"{path}: a ROS bag of another version than 2.0", "bring it up to date: rosbag fix")
        # the index at the end has each topic again, whose first chunk may be damaged
        for record in records(content, begin, []):
            if record.op == CONNECTION:
                topics[_number(record)] = _topic(content, record)
        for source, record in _flat(content, begin, gaps):
            if source is None:
                n_chunks += 1
                continue
            number = _number(record)
            if record.op == CONNECTION:
                topics[number] = _topic(source, record)
            elif record.op == MESSAGE and number in topics and len(record.fields.get(b"time", b"")) == 8:
                seconds, nanoseconds = struct.unpack("<II", record.fields[b"time"])
                yield *topics[number], seconds * 10**9 + nanoseconds, source[record.start : record.end]
            elif record.op == MESSAGE:
                n_orphans += 1
    if gaps:
        lost.append(f"{sum(gaps)} bytes in {len(gaps)} places are no records")
    if n_chunks:
        lost.append(f"{n_chunks} chunks do not unpack to their end")
    if n_orphans:
        lost.append(f"{n_orphans} messages belong to topics that are lost")


def _number(record: BagRecord) -> bytes:
    """Of a message's topic, or of a topic."""
    return record.fields.get(b"conn", b"")


def _topic(source: Bytes, record: BagRecord) -> tuple[str, str]:
    """Name and type of a connection's topic."""
    fields = _fields(source[record.start : record.end]) or {}
    return _text(record.fields.get(b"topic", b"")), _text(fields.get(b"type", b""))


def _flat(content: Bytes, begin: int, gaps: list[int]) -> Iterator[tuple[Bytes | None, BagRecord]]:
    """Every record with the bytes that it lies in, those of chunks too; None after a chunk that breaks off."""
    for record in records(content, begin, gaps):
        compression = record.fields.get(b"compression", b"none")
        if record.op != CHUNK:
            yield content, record
        elif compression != b"none":
            unpacked, whole = _unpacked(content[record.start : record.end], compression)
            yield from ((unpacked, inner) for inner in records(unpacked, 0, gaps))
            if not whole:
                yield None, record


def _unpacked(data: bytes, compression: bytes) -> tuple[bytes, bool]:
    """A chunk's content as far as it unpacks, and whether that is all."""
    make = DECOMPRESSORS.get(compression)
    if make is None:
        return b"", False
    decompressor, pieces, size = make(), [], 0
    try:
        for at in range(0, len(data), SLICE):
            pieces.append(decompressor.decompress(data[at : at + SLICE]))
            size += len(pieces[-1])
            if decompressor.eof or size > MAX_CHUNK_BYTES:
                break
    except (RuntimeError, OSError, ValueError, EOFError, MemoryError):
        return b"".join(pieces), False
    return b"".join(pieces), bool(decompressor.eof)


def _text(name: bytes) -> str:
    return name.decode(errors="replace")


def _record(content: Bytes, at: int) -> BagRecord | None:
    """The record that begins at a place, or None. A chunk may reach beyond the end."""
    header = _header(content, at)
    if header is None:
        return None
    fields, start = header
    op = fields[b"op"][0]
    end = start + LENGTH.unpack_from(content, start - 4)[0]
    if end > len(content) and op != CHUNK:
        return None
    return BagRecord(op, fields, start, min(end, len(content)))


def _header(content: Bytes, at: int) -> tuple[dict[bytes, bytes], int] | None:
    """The fields of the header that begins at a place, and where its data begin, or None."""
    if at + 8 > len(content):
        return None
    (length,) = LENGTH.unpack_from(content, at)
    start = at + 8 + length
    if not 0 < length <= MAX_HEADER_BYTES or start > len(content):
        return None
    fields = _fields(content[at + 4 : start - 4])
    if fields is None or len(op := fields.get(b"op", b"")) != 1 or op[0] not in OPS:
        return None
    return fields, start


def _followed(content: Bytes, at: int) -> bool:
    """Whether a header stands at a place, or so little that it may be the beginning of one."""
    return len(content) - at < MIN_HEADER_BYTES or _header(content, at) is not None


def _next(content: Bytes, at: int) -> int | None:
    """The place of the next record."""
    while (mark := MARK.search(content, at)) is not None:
        for begin in range(mark.start() - 4, max(at, mark.start() - BEFORE) - 1, -1):
            if _record(content, begin) is not None:
                return begin
        at = mark.start() + 1
    return None


def _fields(header: bytes) -> dict[bytes, bytes] | None:
    fields, at = {}, 0
    while at + 4 <= len(header):
        (length,) = LENGTH.unpack_from(header, at)
        name, equals, value = header[at + 4 : at + 4 + length].partition(b"=")
        at += 4 + length
        if not equals or at > len(header):
            return None
        fields[name] = value
    return fields if at == len(header) else None
