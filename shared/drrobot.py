# SPDX-License-Identifier: Apache-2.0
"""Packet framing of the DrRobot board, in both directions. Readers and writers define the content of the packets.

    5E 02 | DEST | SEQ | TYPE | LEN | DATA[LEN] | CRC | 5E 0D

The driver and the emulated board share it. Tests compare its bytes with the protocol's published examples. The layouts
of DATA are written twice, once for each direction, so that a test shows a wrong one.
"""

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numba import njit

from shared.types import Int64s, UInt8s

PC, BOARD = 0x00, 0x01
"""DEST: receiver of a packet."""

ADC_FULL = 4095
"""Reading of an A/D channel at full scale."""

OVERHEAD = 9  # bytes of a packet around its DATA


class Type(IntEnum):
    """TYPE of a packet: subject of its DATA."""

    POSITION_ONE = 0x03
    POSITION_ALL = 0x04
    PWM_ONE = 0x05
    PWM_ALL = 0x06
    GAINS = 0x07
    OUTPUTS = 0x16
    VELOCITY_ONE = 0x1A
    VELOCITY_ALL = 0x1B
    SERVO_ONE = 0x1C
    SERVO_ALL = 0x1D
    DISABLE = 0x1E
    FRICTION = 0x1F
    MOTOR_SENSOR = 0x7B
    CUSTOM_SENSOR = 0x7C
    STANDARD_SENSOR = 0x7D
    SYSTEM = 0xFF


class Packet(NamedTuple):
    """A complete packet. `type` may be outside `Type`."""

    type: int
    data: bytes


def _crc_table() -> UInt8s:
    """(256,) the CRC of each byte: Dallas/Maxim CRC-8, reflected polynomial 0x8C."""
    table = np.arange(256, dtype=np.uint8)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ 0x8C, table >> 1).astype(np.uint8)
    return table


_TABLE = _crc_table()


@njit(cache=True, nogil=True)
def _crc(data: UInt8s) -> int:
    crc = 0
    for byte in data:
        crc = _TABLE[crc ^ byte]
    return int(crc)


def framed(dest: int, kind: int, data: bytes) -> bytes:
    """The bytes of a packet; SEQ is 0. At most 255 bytes of data."""
    covered = bytes((dest, 0, kind, len(data))) + data
    return b"\x5e\x02" + covered + bytes((_crc(np.frombuffer(covered, np.uint8)),)) + b"\x5e\x0d"


GOOD, INCOMPLETE, WRONG, BAD_CRC = range(4)


@njit(cache=True, nogil=True)
def _classify_at(data: UInt8s, i: int, dest: int) -> int:
    """GOOD, INCOMPLETE, WRONG or BAD_CRC: kind of the packet that begins at byte i."""
    n = len(data)
    if data[i] != 0x5E or (i + 1 < n and data[i + 1] != 0x02) or (i + 2 < n and data[i + 2] != dest):
        return WRONG
    if i + OVERHEAD > n:
        return INCOMPLETE
    length = int(data[i + 5]) + OVERHEAD
    if i + length > n:
        return INCOMPLETE
    if data[i + length - 2] != 0x5E or data[i + length - 1] != 0x0D:
        return WRONG
    return GOOD if _crc(data[i + 2 : i + length - 3]) == data[i + length - 3] else BAD_CRC


@njit(cache=True, nogil=True)
def _find_packets(data: UInt8s, dest: int, lost: bool, starts: Int64s) -> tuple[int, int, int, int, bool]:
    """Fills `starts` with where packets for `dest` begin.

    lost: whether the bytes before `data` were no packet.
    Returns the number of packets, of used bytes, of bad CRCs and of gaps between packets, and the next value of `lost`.

    A header without its end waits. A complete packet after it proves that it was none. So a header by chance cannot
    hold back the packets after it, whatever its length field says.
    """
    n_good = n_bad = n_resyncs = i = 0
    waiting = -1
    while i < len(data):
        verdict = _classify_at(data, i, dest)
        if verdict == GOOD:
            n_resyncs += waiting >= 0 and not lost
            lost, waiting = False, -1
            starts[n_good] = i
            n_good += 1
            i += int(data[i + 5]) + OVERHEAD
            continue
        if waiting < 0:
            if verdict == INCOMPLETE:
                waiting = i
            else:
                n_bad += verdict == BAD_CRC
                n_resyncs += not lost
                lost = True
        i += 1
    return n_good, waiting if waiting >= 0 else len(data), n_bad, n_resyncs, lost


class Deframer:
    """Converts bytes, in pieces of any size, to packets for `dest`. Keeps less than one packet and never raises."""

    def __init__(self, dest: int) -> None:
        self.n_good = self.n_bad_crc = self.n_resyncs = self.n_bytes = self.n_skipped = 0
        self._dest = dest
        self._kept = b""
        self._lost = False

    def forget(self) -> None:
        """Discards the beginning of an incomplete packet."""
        self.n_skipped += len(self._kept)
        self._kept, self._lost = b"", False

    def packets(self, data: bytes) -> list[Packet]:
        """The packets that these bytes complete, in order."""
        self.n_bytes += len(data)
        data = self._kept + data
        starts = np.empty(len(data), np.int64)  # an upper bound
        n, used, n_bad, n_resyncs, self._lost = _find_packets(
            np.frombuffer(data, np.uint8), self._dest, self._lost, starts
        )
        packets = [Packet(data[i + 4], data[i + 6 : i + 6 + data[i + 5]]) for i in starts[:n].tolist()]
        self.n_good += n
        self.n_bad_crc += n_bad
        self.n_resyncs += n_resyncs
        self.n_skipped += used - sum(OVERHEAD + len(packet.data) for packet in packets)
        self._kept = data[used:]
        return packets

    @property
    def n_kept(self) -> int:
        """Number of bytes of the incomplete packet."""
        return len(self._kept)
