# SPDX-License-Identifier: Apache-2.0
"""The DrRobot board's framing, both ways; what the packets carry is said where they are read and written.

    5E 02 | DEST | SEQ | TYPE | LEN | DATA[LEN] | CRC | 5E 0D

Shared by the driver and by the emulated board: both need it whole, and its bytes are tested against the protocol's
published examples. The layouts of DATA are written twice, once for each direction, so that a wrong one is seen.
"""

from enum import IntEnum
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

UInt8s = NDArray[np.uint8]
Int64s = NDArray[np.int64]

PC, BOARD = 0x00, 0x01
"""DEST: for whom a packet is."""

ADC_FULL = 4095
"""What an A/D channel reads at its full scale."""

OVERHEAD = 9  # bytes of a packet around its DATA


class Type(IntEnum):
    """What a packet is about."""

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
    """A packet that arrived whole. `type` may be one that nobody knows."""

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
def _judged(data: UInt8s, i: int, dest: int) -> int:
    """What begins at byte i: a packet, one whose end has not come yet, or none."""
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
def _packets_in(data: UInt8s, dest: int, lost: bool, starts: Int64s) -> tuple[int, int, int, int, bool]:
    """Fills `starts` with where packets for `dest` begin.

    lost: whether the bytes before `data` were no packet.  Returns how many packets, how many bytes are done with, how
    many had a bad CRC, how often something lay between packets, and whether the bytes done with end in no packet.

    A header whose end is not there yet waits; a whole packet after it proves that it was none. So no header by chance,
    however long it says it is, holds back the packets that follow it.
    """
    n_good = n_bad = n_resyncs = i = 0
    waiting = -1
    while i < len(data):
        verdict = _judged(data, i, dest)
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
    """Bytes in any pieces to packets for `dest`; keeps less than one packet. Never fails, whatever comes."""

    def __init__(self, dest: int) -> None:
        self.n_good = self.n_bad_crc = self.n_resyncs = self.n_bytes = self.n_skipped = 0
        self._dest = dest
        self._kept = b""
        self._lost = False

    def forget(self) -> None:
        """Drops what has come of a packet: its rest will not come."""
        self.n_skipped += len(self._kept)
        self._kept, self._lost = b"", False

    def packets(self, data: bytes) -> list[Packet]:
        """The packets that are whole with these bytes."""
        self.n_bytes += len(data)
        data = self._kept + data
        starts = np.empty(len(data), np.int64)  # more than there can be
        n, used, n_bad, n_resyncs, self._lost = _packets_in(
            np.frombuffer(data, np.uint8), self._dest, self._lost, starts
        )
        found = [Packet(data[i + 4], data[i + 6 : i + 6 + data[i + 5]]) for i in starts[:n].tolist()]
        self.n_good += n
        self.n_bad_crc += n_bad
        self.n_resyncs += n_resyncs
        self.n_skipped += used - sum(OVERHEAD + len(packet.data) for packet in found)
        self._kept = data[used:]
        return found

    @property
    def n_kept(self) -> int:
        """Bytes that wait for the rest of their packet."""
        return len(self._kept)
