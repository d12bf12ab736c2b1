# SPDX-License-Identifier: Apache-2.0
"""The chunk at the end of an MCAP file that was cut off, as far as it unpacks. Source: https://mcap.dev/spec"""

import shutil
import struct
from contextlib import suppress
from pathlib import Path
from typing import Any

import lz4.frame  # type: ignore[import-untyped]  # it has no types
import zstandard

MAGIC = 8  # bytes
CHUNK = 6
RECORD = struct.Struct("<BQ")  # opcode, length
HEAD = struct.Struct("<QQQI")  # a chunk's first and last time, size, CRC
TEXT, LENGTH = struct.Struct("<I"), struct.Struct("<Q")
SLICE = 1 << 14  # bytes that are unpacked at a time: what comes before the end is kept


def with_last_chunk(path: Path, copy: Path) -> Path:
    """A copy in which the unfinished chunk at the end is a whole one of what it held; the path itself without such."""
    size, at, opcode = path.stat().st_size, MAGIC, 0
    with path.open("rb") as file:
        while at + RECORD.size <= size:
            file.seek(at)
            opcode, length = RECORD.unpack(file.read(RECORD.size))
            if at + RECORD.size + length > size:
                break
            at += RECORD.size + length
        records = _unpacked(file.read()) if opcode == CHUNK and at + RECORD.size < size else b""
        if not records:
            return path
        body = HEAD.pack(0, 0, len(records), 0) + TEXT.pack(0) + LENGTH.pack(len(records)) + records
        file.seek(0)
        with copy.open("wb") as target:
            shutil.copyfileobj(file, target)
            target.seek(at)
            target.truncate()
            target.write(RECORD.pack(CHUNK, len(body)) + body)
    return copy


def _unpacked(body: bytes) -> bytes:
    """The whole records at the beginning of a chunk whose end is missing."""
    if len(body) < HEAD.size + TEXT.size:
        return b""
    (n,) = TEXT.unpack_from(body, HEAD.size)
    begin = HEAD.size + TEXT.size + n
    compression, data = body[HEAD.size + TEXT.size : begin], body[begin + LENGTH.size :]
    content = data
    if compression in (b"zstd", b"lz4"):
        zstd = compression == b"zstd"
        unpack: Any = zstandard.ZstdDecompressor().decompressobj() if zstd else lz4.frame.LZ4FrameDecompressor()
        pieces = []
        with suppress(zstandard.ZstdError, RuntimeError, EOFError, MemoryError):
            for k in range(0, len(data), SLICE):
                pieces.append(unpack.decompress(data[k : k + SLICE]))
        content = b"".join(pieces)
    elif compression:
        return b""
    at = 0
    while at + RECORD.size <= len(content):
        end = at + RECORD.size + RECORD.unpack_from(content, at)[1]
        if end > len(content):
            break
        at = end
    return content[:at]
