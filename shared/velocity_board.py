# SPDX-License-Identifier: Apache-2.0
"""Lines of the `velocity` board, in both directions: `$`, fields with commas, `*`, checksum. docs/velocity_board.md.

The checksum is CRC-16/XMODEM of the bytes between `$` and `*`, as four hexadecimal digits.
"""

from enum import IntFlag

from shared.board_framing import crc16

COMMAND, TICKS, POSE = b"V", b"T", b"P"
"""First field of a line: its kind."""
SEQUENCES = 65536  # of lines, counted modulo
TICK_WRAP = 1 << 31  # a counter of 32 bits, without its sign


class BoardFlags(IntFlag):
    """What the board reports beside its measurements, as a hexadecimal field."""

    BUMPER_LEFT = 0x001
    BUMPER_FRONT = 0x002
    BUMPER_RIGHT = 0x004
    CLIFF_LEFT = 0x008
    CLIFF_FRONT = 0x010
    CLIFF_RIGHT = 0x020
    ESTOP = 0x040
    WATCHDOG = 0x080  # no command arrived for 200 ms: the motors stand
    MOTOR_FAULT = 0x100  # of the motor driver


def framed_line(*fields: bytes | int | str) -> bytes:
    """The bytes of a line."""
    body = b",".join(field if isinstance(field, bytes) else str(field).encode() for field in fields)
    return b"$%b*%04X\n" % (body, crc16(body))


def line_fields(line: bytes) -> list[bytes] | None:
    """The fields of a line without its end; None where it is none, or its checksum is wrong."""
    start, end = line.rfind(b"$"), line.rfind(b"*")
    if start < 0 or end < start or len(line) != end + 5:
        return None
    body = line[start + 1 : end]
    return body.split(b",") if line[end + 1 :] == b"%04X" % crc16(body) else None


def is_newer(sequence: int, before: int) -> bool:
    """Whether a line follows another one: ahead by less than half of all sequence numbers."""
    return 0 < (sequence - before) % SEQUENCES < SEQUENCES // 2
