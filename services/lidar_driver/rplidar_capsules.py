# SPDX-License-Identifier: Apache-2.0
"""Express scan packets of an RPLIDAR: legacy (A1, A2), extended (A3), dense and ultra-dense (S, C) capsules.

SLAMTEC, 'RPLIDAR interface protocol', rev. 2.1, section 'express scan', and its public driver. Ultra-dense capsules are
only in the driver (rplidar_sdk 2.1, handler_capsules.cpp).

A capsule begins with two sync nibbles and the xor of the bytes after them. Then comes the angle of its first beam
(15 bits, 1/64 degree); bit 15 marks the first capsule of a scan. The beams are spaced evenly between this angle and
that of the next capsule, minus an offset for the laser's parallax.
"""

from collections.abc import Callable
from dataclasses import dataclass
from math import pi
from typing import cast

import numpy as np

from shared.types import Bools, Float64s, Int64s, UInt8s

SCALES = ((3328, 1 << 14, 4), (1792, 1 << 12, 3), (1280, 1 << 11, 2), (512, 1 << 9, 1), (0, 0, 0))
"""Scales of extended distances: first code, its distance in mm, and level; a step is 2 ** level mm."""
CABIN = np.dtype([("mm", "<u2", 2), ("offsets", "u1")])
ULTRA_DENSE_BASES_MM = np.array([0, 2046, 8187, 24567])  # of the four scales; a step is 2, 3, 4 or 5 mm
NIBBLES = np.array([0, 4])
NO_PREDICTION = (-512, 511)
MIN_OFFSET_DISTANCE = 200  # 1/4 mm; the offset is constant for shorter distances


def is_header(first: UInt8s, second: UInt8s) -> Bools:
    """(k,), (k,) -> (k,): whether two bytes have the sync nibbles."""
    return cast(Bools, (first >> 4 == 0xA) & (second >> 4 == 0x5))


def is_checksum_valid(packets: UInt8s) -> Bools:
    """(p, n) -> (p,): whether the low nibbles of the first two bytes are the xor of all others."""
    total = np.bitwise_xor.reduce(packets[:, 2:], axis=1)
    return cast(Bools, total == (packets[:, 0] & 0xF | (packets[:, 1] & 0xF) << 4))


def decode_legacy(capsules: UInt8s, _: UInt8s) -> tuple[Int64s, Float64s]:
    """(p, 84) -> (p, 32) mm, degrees of offset; 16 cabins of 5 bytes.

    Cabin: two words of a distance (14 bits, mm) and the offset's high bits (2), then the offsets' low nibbles.
    """
    cabins = capsules[:, 4:].view(CABIN)
    pairs = cabins["mm"].astype(np.int64)
    offsets = cabins["offsets"][:, :, None] >> NIBBLES & 0xF | (pairs & 3) << 4
    return (pairs >> 2).reshape(-1, 32), (offsets / 8).reshape(-1, 32)


def decode_dense(capsules: UInt8s, _: UInt8s) -> tuple[Int64s, Float64s]:
    """(p, 84) -> (p, 40) mm, degrees of offset (0); 40 distances, u16 mm."""
    mm = capsules[:, 4::2].astype(np.int64) | capsules[:, 5::2].astype(np.int64) << 8
    return mm, np.zeros(mm.shape)


def decode_ultra_dense(capsules: UInt8s, _: UInt8s) -> tuple[Int64s, Float64s]:
    """(p, 170) -> (p, 64) mm, degrees of offset (0); 32 cabins of 5 bytes after a time, a status and the angle.

    Cabin: two words and a byte with the high nibbles of both. Word: scale (2 bits), then the distance in its steps
    (10 to 13 bits), then the quality, which is not used.
    """
    cabins = capsules[:, 10:].view(CABIN)
    words = cabins["mm"].astype(np.int64)
    scales = words & 3
    steps = (words | (cabins["offsets"].astype(np.int64)[:, :, None] >> NIBBLES & 0xF) << 16) >> 2
    mm = (steps & (1 << 10 + scales) - 1) * (scales + 2) + ULTRA_DENSE_BASES_MM[scales]
    return mm.reshape(-1, 64), np.zeros((len(mm), 64))


def decode_extended(capsules: UInt8s, following: UInt8s) -> tuple[Int64s, Float64s]:
    """(p, 132) and the capsules after them -> (p, 96) mm, degrees of offset; 32 words of 32 bits.

    Word: a scaled distance (12 bits), and two signed differences (10 bits each) to it and to the next word's distance.
    """
    words, after = (_words(c) for c in (capsules, following))
    majors, levels = decode_scaled(words & 0xFFF)
    last, last_level = decode_scaled(after[:, :1] & 0xFFF)
    next_majors, next_levels = np.hstack([majors[:, 1:], last]), np.hstack([levels[:, 1:], last_level])
    from_next = (majors == 0) & (next_majors != 0)
    bases = np.where(from_next, next_majors, majors), next_majors
    scales = np.where(from_next, next_levels, levels), next_levels
    mm = [majors]
    for shift, base, level in zip((12, 22), bases, scales):
        difference = (words >> shift & 0x3FF ^ 0x200) - 0x200
        mm.append(np.where(np.isin(difference, NO_PREDICTION), 0, np.maximum(base + (difference << level), 0)))
    distances = np.stack(mm, axis=2).reshape(-1, 96)
    quarters = np.maximum(distances * 4, 1)
    k = 98361 // quarters
    offset = np.where(quarters >= MIN_OFFSET_DISTANCE, 8 - ((k << 6) + k**3 // 98304) / (pi / 180 * 65536), 7.5)
    return distances, offset


def decode_scaled(codes: Int64s) -> tuple[Int64s, Int64s]:
    """Codes of 12 bits -> mm, and the levels of their scales."""
    mm, levels = np.zeros_like(codes), np.zeros_like(codes)
    for begin, base, level in reversed(SCALES):
        mm = np.where(codes >= begin, base + (codes - begin << level), mm)
        levels = np.where(codes >= begin, level, levels)
    return mm, levels


def _words(capsules: UInt8s) -> Int64s:
    """(p, 132) -> (p, 32) words of 32 bits."""
    parts = capsules[:, 4:].reshape(-1, 32, 4).astype(np.int64)
    return cast(Int64s, (parts << np.array([0, 8, 16, 24])).sum(axis=2))


@dataclass(frozen=True, slots=True)
class CapsuleFormat:
    """A kind of capsule.

    length: bytes.  angle_at: bytes before its angle.
    beams: capsules (p, length) and the next ones (p, length) -> (p, n_beams) mm, degrees of offset.
    """

    length: int
    n_beams: int
    beams: Callable[[UInt8s, UInt8s], tuple[Int64s, Float64s]]
    angle_at: int = 2


FORMATS = {
    0x82: CapsuleFormat(84, 32, decode_legacy),
    0x84: CapsuleFormat(132, 96, decode_extended),
    0x85: CapsuleFormat(84, 40, decode_dense),
    0x86: CapsuleFormat(170, 64, decode_ultra_dense, angle_at=8),
}
"""Type of the answer -> format."""
