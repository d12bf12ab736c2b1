# SPDX-License-Identifier: Apache-2.0
"""A Neato XV-11: 90 packets of four degrees a turn, counter-clockwise, silent while its motor stands."""

import struct
from math import degrees

import numpy as np

from services.sim.hardware.beam_lookup import first_angle, ranges_mm, timed_chunk, turn_times
from shared.config import Laser
from shared.messages import LaserScan

BAUD = 115200
N_PACKETS = 90
INVALID = b"\x35\x80\x00\x00"  # bit 15, and a code of an error
MAX_MM = 0x3FFF  # mm


def packet(index: int, rpm: float, mm: list[int]) -> bytes:
    """One packet of four readings; 0 mm is no measurement."""
    readings = (struct.pack("<HH", d, strength(d)) if 0 < d <= MAX_MM else INVALID for d in mm)
    body = struct.pack("<BBH", 0xFA, 0xA0 + index, round(rpm * 64)) + b"".join(readings)
    total = 0
    for word in struct.unpack("<10H", body):
        total = (total << 1) + word
    return body + struct.pack("<H", ((total & 0x7FFF) + (total >> 15)) & 0x7FFF)


def strength(mm: int) -> int:
    """Intensity, decreasing with the distance."""
    return min(2000, 400_000 // mm)


class Xv11Emulator:
    """Streams one turn a sweep, from the packet that holds the sweep's first angle."""

    def __init__(self, laser: Laser) -> None:
        self.laser = laser
        self.turning = True

    def receive(self, data: bytes, now: int) -> bytes:
        return b""

    def sweep_chunks(self, scan: LaserScan, now: int) -> list[tuple[int, bytes]]:
        if not self.turning:
            return []
        first = round(degrees(first_angle(scan, 1)) / 4)
        index = (first + np.arange(N_PACKETS)) % N_PACKETS
        angles = np.radians((4 * index[:, None] + np.arange(4)).ravel())
        mm = np.rint(ranges_mm(scan, angles)).astype(int).reshape(-1, 4).tolist()
        times = turn_times(scan, self.laser, np.arange(1, N_PACKETS + 1) / N_PACKETS)
        rpm = 60 * self.laser.rate
        return [timed_chunk(at, packet(i, rpm, four), BAUD) for at, i, four in zip(times, index.tolist(), mm)]
