# SPDX-License-Identifier: Apache-2.0
"""Answers of a laser to requests, in the framing that SLAMTEC and YDLIDAR share.

A5 5A | u32: length 30 bits, mode 2 bits (0: once, 1: a stream) | type u8 | content
"""

import struct

START = b"\xa5\x5a"
DESCRIPTOR = struct.Struct("<BBIB")
MAX_ANSWER = 128  # bytes, of an answer without a fixed length
MAX_BUFFER = 4096  # bytes that are searched for an answer


def find_answer(buffer: bytes, expected: dict[int, int | None]) -> tuple[int, bytes] | None:
    """The first whole answer in the buffer: its type, and the bytes from its content on. None without one.

    expected: types of answers -> their length in bytes; None: not fixed. A stream is found by its descriptor.
    """
    at = buffer.find(START)
    while 0 <= at <= len(buffer) - DESCRIPTOR.size:
        _, _, size, kind = DESCRIPTOR.unpack_from(buffer, at)
        length = size & 0x3FFFFFFF
        fits = kind in expected and length == (expected[kind] or min(length, MAX_ANSWER))
        content = buffer[at + DESCRIPTOR.size :]
        if fits and (size >> 30 or len(content) >= length):
            return kind, content
        if fits:
            return None  # incomplete
        at = buffer.find(START, at + 1)
    return None
