# SPDX-License-Identifier: Apache-2.0
"""Framing of motion boards' bytes: lines of text, packets with a length, and their checksums.

The drivers and the emulated boards share it. The layouts of the content are written twice, once for each direction, so
that a test shows a wrong one.
"""

from collections.abc import Callable
from dataclasses import dataclass

MAX_LINE = 120  # bytes; a longer line is noise


@dataclass(slots=True)
class LineCounts:
    """Counters of a decoder since its construction."""

    n_good: int = 0  # packets or lines with a correct checksum
    n_bad: int = 0  # packets or lines with a wrong checksum
    n_resyncs: int = 0  # times that bytes were skipped before a packet
    n_skipped: int = 0  # bytes
    n_unreadable: int = 0  # lines with a correct checksum, whose fields are not those of the protocol


def crc16(data: bytes, crc: int = 0) -> int:
    """CRC-16/XMODEM: polynomial 0x1021, initial value 0, most significant bit first. crc: of the bytes before."""
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x1021) & 0xFFFF if crc & 0x8000 else crc << 1
    return crc


def xor(data: bytes) -> int:
    """XOR of all bytes."""
    total = 0
    for byte in data:
        total ^= byte
    return total


class LineFramer:
    """Converts bytes, in pieces of any size, to lines without their ends. Keeps at most MAX_LINE bytes."""

    def __init__(self) -> None:
        self._kept = b""

    def forget(self) -> None:
        """Discards the beginning of an incomplete line."""
        self._kept = b""

    def lines(self, data: bytes) -> list[bytes]:
        """The lines that these bytes complete, in order; CR and LF end a line, empty lines are left out."""
        *complete, self._kept = (self._kept + data).replace(b"\r", b"\n").split(b"\n")
        self._kept = self._kept[-MAX_LINE:]
        return [line for line in complete if line]


class PacketReader:
    """Converts bytes, in pieces of any size, to packets `header, length, content, checksum of one byte`. Never raises.

    lengths: permitted values of the length byte.  is_valid: whether the checksum of a whole packet is right.
    """

    def __init__(self, header: bytes, lengths: range, is_valid: Callable[[bytes], bool], counts: LineCounts) -> None:
        self._header, self._lengths, self._is_valid, self.counts = header, lengths, is_valid, counts
        self._kept = b""
        self._is_lost = False

    def forget(self) -> None:
        """Discards the beginning of an incomplete packet."""
        self.counts.n_skipped += len(self._kept)
        self._kept, self._is_lost = b"", False

    def packets(self, data: bytes) -> list[bytes]:
        """The contents of the packets that these bytes complete, in order."""
        data, at, found = self._kept + data, 0, []
        n_header = len(self._header)
        while at < len(data):
            length = self._length_at(data, at)
            if length == 0:
                self._skip()
                at += 1
            elif at + length > len(data):
                break
            elif self._is_valid(data[at : at + length]):
                self.counts.n_good += 1
                self._is_lost = False
                found.append(data[at + n_header + 1 : at + length - 1])
                at += length
            else:
                self.counts.n_bad += 1
                self._skip()
                at += 1
        self._kept = data[at:]
        return found

    def _length_at(self, data: bytes, at: int) -> int:
        """Bytes of the packet that begins here, or of its known beginning; 0 where none does."""
        n = len(self._header)
        if not self._header.startswith(data[at : at + n]):
            return 0
        if at + n >= len(data):
            return n + 1
        return n + 2 + data[at + n] if data[at + n] in self._lengths else 0

    def _skip(self) -> None:
        self.counts.n_skipped += 1
        self.counts.n_resyncs += not self._is_lost
        self._is_lost = True
