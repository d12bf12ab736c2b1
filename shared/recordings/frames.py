# SPDX-License-Identifier: Apache-2.0
"""Places of an MCAP file's records, from its index or by reading the whole file. https://mcap.dev/spec

An index with a right checksum is used. Otherwise the file is read record by record. After damage, reading continues at
the next whole chunk. A chunk that is cut off by the end of the file is read as far as it unpacks.
"""

import mmap
import struct
import zlib
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from typing import IO, Any

import lz4.frame  # type: ignore[import-untyped]  # it has no types
import mcap.records as mc
import mcap.writer
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode

MAGIC = mcap.writer.MCAP0_MAGIC
FRAME = struct.Struct("<BQ")  # opcode, length
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log_time, publish_time
DAMAGE = (McapError, struct.error, ValueError, OverflowError, MemoryError, RuntimeError, zstandard.ZstdError)
"""Exceptions of the decoders of records and chunks on damaged bytes."""

_FOOTER = struct.Struct("<BQQQI")  # opcode, length, place of the summary, of its offsets, CRC
_TIMES = struct.Struct("<QQ")
_CHUNK_INDEX = struct.Struct("<QQQQI")  # first and last log_time, chunk's place and length, length of the map
_INDEX_ROW = 16  # bytes of a message in a message index: log_time, place
_COMPRESSIONS = (b"\x04\0\0\0zstd", b"\x03\0\0\0lz4")
_BEFORE_COMPRESSION = FRAME.size + 28  # bytes of a chunk: its frame, two times, size and CRC
_MAX_CHUNK_BYTES = 1 << 30  # bytes; a larger size in a record is damage
_KNOWN = range(Opcode.HEADER, Opcode.DATA_END + 1)
_CHUNK_HEAD = struct.Struct("<QQQI")  # first and last log_time, size, CRC
_SLICE = 1 << 14  # bytes that are decompressed at a time, so the data before a cut is kept
_NOTED = (Opcode.METADATA, Opcode.ATTACHMENT, Opcode.SCHEMA, Opcode.CHANNEL)


@dataclass(frozen=True, slots=True)
class Block:
    """A chunk or a single message: place and length (bytes) of its body, first and last log_time (ns).

    channels: of an indexed chunk, pairs of channel (2 bytes) and place (8 bytes).   cut: the file ends inside it.
    """

    opcode: int
    place: int
    length: int
    begin: int
    end: int
    channels: bytes | None = None
    cut: bool = False

    def holds(self, channels: set[int]) -> bool:
        """Whether the block may contain messages of these channels."""
        if self.channels is None:
            return True
        return any(number in channels for number, _ in struct.iter_unpack("<HQ", self.channels))


@dataclass(slots=True)
class Layout:
    """Blocks and other records of a file. statistics: only from an index.

    problems: damaged or missing parts by place.   harmless: places of the problems without a lost message.
    """

    profile: str = ""
    blocks: list[Block] = field(default_factory=list)
    notes: list[tuple[int, bytes, int]] = field(default_factory=list)  # opcode, body, place
    statistics: mc.Statistics | None = None
    problems: dict[int, str] = field(default_factory=dict)
    harmless: set[int] = field(default_factory=set)


def layout(file: IO[bytes], size: int) -> Layout:
    """The layout of a file of `size` bytes that begins with MAGIC."""
    try:
        indexed = _by_index(file, size)
    except DAMAGE:
        indexed = None
    file_layout = indexed or _by_reading(file, size)
    file_layout.profile = _profile(file)
    return file_layout


def _profile(file: IO[bytes]) -> str:
    """The profile in the header: the program that the file is for; empty where the header is damaged."""
    file.seek(len(MAGIC))
    opcode, length = FRAME.unpack(file.read(FRAME.size).ljust(FRAME.size, b"\0"))
    try:
        return mc.Header.read(ReadDataStream(BytesIO(file.read(length)))).profile if opcode == Opcode.HEADER else ""
    except DAMAGE:
        return ""


# --- by the index ---------------------------------------------------------------------------------------------------


def _by_index(file: IO[bytes], size: int) -> Layout | None:
    """The layout from the index; None where the index is missing or incomplete. Raises one of DAMAGE."""
    end = size - len(MAGIC) - _FOOTER.size
    if end < len(MAGIC):
        return None
    file.seek(end)
    foot = file.read(_FOOTER.size)
    opcode, length, start, _, crc = _FOOTER.unpack(foot)
    if opcode != Opcode.FOOTER or length != _FOOTER.size - FRAME.size or file.read() != MAGIC or not 0 < start <= end:
        return None
    file.seek(start)
    summary = file.read(end - start)
    if crc and zlib.crc32(foot[:-4], zlib.crc32(summary)) != crc:
        return None
    file_layout, n_channels, at = Layout(), 0, 0
    while at + FRAME.size <= len(summary):
        opcode, length = FRAME.unpack_from(summary, at)
        place, at = at + FRAME.size, at + FRAME.size + length
        body = summary[place:at]
        if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            file_layout.notes.append((opcode, body, start + place))
            n_channels += opcode == Opcode.CHANNEL
        elif opcode == Opcode.STATISTICS:
            file_layout.statistics = mc.Statistics.read(ReadDataStream(BytesIO(body)))
        elif opcode == Opcode.CHUNK_INDEX:
            begin, last, chunk, chunk_length, n_bytes = _CHUNK_INDEX.unpack_from(body)
            channels = body[_CHUNK_INDEX.size : _CHUNK_INDEX.size + n_bytes]
            block = Block(
                opcode=Opcode.CHUNK,
                place=chunk + FRAME.size,
                length=chunk_length - FRAME.size,
                begin=begin,
                end=last,
                channels=channels or None,
            )
            file_layout.blocks.append(block)
        elif opcode in (Opcode.METADATA_INDEX, Opcode.ATTACHMENT_INDEX):
            offset, whole = _TIMES.unpack_from(body)
            file.seek(offset)
            record = file.read(min(whole, size))
            file_layout.notes.append((record[0], record[FRAME.size :], offset))
    statistics = file_layout.statistics
    if statistics is None:
        return None
    if statistics.channel_count != n_channels or statistics.chunk_count != len(file_layout.blocks):
        return None
    if statistics.message_count and not statistics.chunk_count:
        return None
    file_layout.blocks.sort(key=lambda block: block.place)
    return file_layout


# --- by reading -----------------------------------------------------------------------------------------------------


def _by_reading(file: IO[bytes], size: int) -> Layout:
    file_layout = Layout()
    place = before = len(MAGIC)
    while place + FRAME.size <= size:
        file.seek(place)
        opcode, length = FRAME.unpack(file.read(FRAME.size))
        body = place + FRAME.size
        if opcode not in _KNOWN or body + length > size:
            after = _next_chunk(file, before + 1, size)
            if after is None:
                break
            file_layout.problems[place] = f"{after - place} bytes at byte {place} make no sense and are left out"
            before = place = after
            continue
        if opcode == Opcode.FOOTER:
            if length == _FOOTER.size - FRAME.size and _TIMES.unpack(file.read(_TIMES.size))[0]:
                file_layout.problems[place] = "its index is damaged or not whole: it was read from begin to end"
                file_layout.harmless.add(place)
            return file_layout
        if opcode in (Opcode.CHUNK, Opcode.MESSAGE):
            file_layout.blocks.append(_block(opcode, body, length, file.read(min(length, MESSAGE.size))))
        elif opcode in _NOTED:
            file_layout.notes.append((opcode, file.read(length), body))
        before, place = place, body + length
    _add_cut_chunk(file, place, size, file_layout)
    rest = size - min(place, size)
    file_layout.harmless |= set() if rest else {size}
    file_layout.problems[size] = "the recording was not closed" + (
        f": its last {rest} bytes are the beginning of a record whose end is missing" if rest else ""
    )
    return file_layout


def _block(opcode: int, place: int, length: int, head: bytes) -> Block:
    try:
        times = _TIMES.unpack_from(head) if opcode == Opcode.CHUNK else (MESSAGE.unpack_from(head)[2],) * 2
    except struct.error:
        times = 0, 2**64 - 1  # damaged: reported when it is read
    return Block(opcode, place, length, *times)


def _add_cut_chunk(file: IO[bytes], place: int, size: int, layout: Layout) -> None:
    """Adds the chunk at `place` that the end of the file cuts off, if it has a whole record."""
    if place + FRAME.size + _CHUNK_HEAD.size > size:
        return
    file.seek(place)
    if FRAME.unpack(file.read(FRAME.size))[0] != Opcode.CHUNK:
        return
    begin, end = _TIMES.unpack(file.read(_TIMES.size))
    block = Block(Opcode.CHUNK, place + FRAME.size, size - place - FRAME.size, begin, end, cut=True)
    if records_of(file, block):
        layout.blocks.append(block)


def _next_chunk(file: IO[bytes], start: int, size: int) -> int | None:
    """The place of the next compressed chunk that begins at `start` or later and lies in the file as a whole."""
    with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as view:
        for compression in _COMPRESSIONS:
            at = view.find(compression, start + _BEFORE_COMPRESSION)
            while at >= 0:
                chunk, head = at - _BEFORE_COMPRESSION, at + len(compression)
                opcode, length = FRAME.unpack_from(view, chunk)
                if opcode == Opcode.CHUNK and head + 8 <= size and chunk + FRAME.size + length <= size:
                    (n_bytes,) = struct.unpack_from("<Q", view, head)
                    if head + 8 + n_bytes == chunk + FRAME.size + length:
                        return chunk
                at = view.find(compression, at + 1)
    return None


# --- chunks ---------------------------------------------------------------------------------------------------------


def records_of(file: IO[bytes], block: Block) -> bytes:
    """The decompressed records of a block, as bytes. Raises one of DAMAGE."""
    if block.cut:
        file.seek(block.place)
        return _whole_records(file.read(block.length))
    file.seek(max(block.place - FRAME.size, 0))
    frame = file.read(FRAME.size)
    if len(frame) < FRAME.size or FRAME.unpack(frame) != (block.opcode, block.length):
        raise ValueError("it is not where the index says")
    body = file.read(block.length)
    if block.opcode == Opcode.MESSAGE:
        return frame + body
    chunk = mc.Chunk.read(ReadDataStream(BytesIO(body)))
    size = chunk.uncompressed_size
    if size > _MAX_CHUNK_BYTES:
        raise ValueError(f"it claims {size} bytes")
    records: Any
    if chunk.compression == "zstd":
        if zstandard.frame_content_size(chunk.data) not in (-1, size):
            raise ValueError("its sizes contradict each other")
        records = zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size)
    elif chunk.compression == "lz4":
        records = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
        if len(records) != size:
            raise ValueError("its sizes contradict each other")
    elif chunk.compression == "":
        records = chunk.data
    else:
        raise ValueError(f"unknown compression {chunk.compression!r}")
    if chunk.uncompressed_crc and zlib.crc32(records) != chunk.uncompressed_crc:
        raise ValueError("its checksum is wrong")
    return bytes(records)


def _whole_records(body: bytes) -> bytes:
    """The whole records at the beginning of a chunk whose end is missing."""
    at = _CHUNK_HEAD.size + 4
    if len(body) < at:
        return b""
    (n_bytes,) = struct.unpack_from("<I", body, _CHUNK_HEAD.size)
    compression, data = body[at : at + n_bytes], body[at + n_bytes + 8 :]  # between them: the length of the data
    if compression == b"":
        records = data
    elif compression in (b"zstd", b"lz4"):
        zstd = compression == b"zstd"
        unpack: Any = zstandard.ZstdDecompressor().decompressobj() if zstd else lz4.frame.LZ4FrameDecompressor()
        pieces = []
        with suppress(*DAMAGE, EOFError):
            for k in range(0, len(data), _SLICE):
                pieces.append(unpack.decompress(data[k : k + _SLICE]))
                if sum(map(len, pieces)) > _MAX_CHUNK_BYTES:
                    break
        records = b"".join(pieces)
    else:
        return b""
    end = 0
    while end + FRAME.size <= len(records):
        after = end + FRAME.size + FRAME.unpack_from(records, end)[1]
        if after > len(records):
            break
        end = after
    return records[:end]


def indexes_after(file: IO[bytes], block: Block) -> dict[int, bytes]:
    """The message indexes behind a chunk: by channel, rows of log_time and place (8 bytes each). Raises DAMAGE."""
    rows_by_channel: dict[int, bytes] = {}
    file.seek(block.place + block.length)
    while len(head := file.read(FRAME.size + 6)) == FRAME.size + 6:
        opcode, length, channel, n_bytes = struct.unpack("<BQHI", head)
        if opcode != Opcode.MESSAGE_INDEX or n_bytes != length - 6 or n_bytes % _INDEX_ROW:
            break
        rows = file.read(n_bytes)
        if len(rows) < n_bytes:
            break
        rows_by_channel[channel] = rows
    return rows_by_channel


def messages_in(file: IO[bytes], block: Block) -> int | None:
    """How many messages a chunk holds by the message indexes behind it; None where there are none."""
    if block.opcode == Opcode.MESSAGE:
        return 1
    indexes = indexes_after(file, block)
    return sum(len(rows) // _INDEX_ROW for rows in indexes.values()) if indexes else None
