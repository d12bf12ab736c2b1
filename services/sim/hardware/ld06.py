# SPDX-License-Identifier: Apache-2.0
"""LDROBOT LD06, LD19, LD14 and STL-27L: 12 beams a packet, clockwise, a clock in ms; speed 0 while they do not turn."""

import struct
from math import degrees

import numpy as np

from services.sim.hardware.beam_lookup import first_angle, ranges_mm, timed_chunk, turn_times
from shared.config import Laser
from shared.messages import LaserScan

BAUD = 230400
N_BEAMS = 12
SAMPLES = 4500  # a second
LD08_SAMPLES = 2300  # a second, of the LD08 (LDS-02), at 115200 baud
MS = 1_000_000
TIME_WRAP = 30000


def crc(data: bytes) -> int:
    """CRC-8, polynomial 0x4D, bit by bit."""
    value = 0
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = (value << 1 ^ 0x4D) & 0xFF if value & 0x80 else value << 1
    return value


def packet(speed: float, first: float, last: float, mm: list[int], ms: int) -> bytes:
    """One packet. speed: deg/s.  first, last: degrees, clockwise.  mm: 12 distances, 0 none."""
    hundredths = [round(angle * 100) % 36000 for angle in (first, last)]
    readings = b"".join(struct.pack("<HB", d, strength(d)) for d in mm)
    body = struct.pack("<BBHH", 0x54, 0x2C, round(speed), hundredths[0]) + readings
    body += struct.pack("<HH", hundredths[1], ms % TIME_WRAP)
    return body + bytes([crc(body)])


def strength(mm: int) -> int:
    """Intensity, decreasing with the distance; 0 without an echo."""
    return max(20, 230 - mm // 60) if mm else 0


class Ld06Emulator:
    """Streams one turn a sweep. The origin of its clock is arbitrary.

    A packet is full: the turn's last one, with beams left over, has them finer apart, every other one empty.
    """

    def __init__(self, laser: Laser, samples: int = SAMPLES, baud: int = BAUD) -> None:
        """samples: a second."""
        self.laser, self.baud = laser, baud
        self.turning = True
        self.n = round(samples / laser.rate)

    def receive(self, data: bytes, now: int) -> bytes:
        return b""

    def sweep_chunks(self, scan: LaserScan, now: int) -> list[tuple[int, bytes]]:
        if not self.turning:
            return [(now, packet(0, 0, 0, [0] * N_BEAMS, now // MS))]
        step = 360 / self.n
        first = -degrees(first_angle(scan, -1))
        mm = np.rint(ranges_mm(scan, np.radians(-(first + step * np.arange(self.n))))).astype(int)
        mm[mm > 0xFFFF] = 0
        starts = np.arange(0, self.n, N_BEAMS)
        finer = np.ones(len(starts), int)
        finer[-1] = N_BEAMS // (self.n - int(starts[-1]))
        ends = starts + (N_BEAMS - 1) / finer
        speed = 360 * self.laser.rate
        chunks = []
        for at, begin, end, parts in zip(
            turn_times(scan, self.laser, ends / self.n), starts.tolist(), ends.tolist(), finer.tolist()
        ):
            beams = np.zeros(N_BEAMS, int)
            own = mm[begin : begin + N_BEAMS]
            beams[: len(own) * parts : parts] = own
            data = packet(speed, first + step * begin, first + step * end, beams.tolist(), at // MS)
            chunks.append(timed_chunk(at, data, self.baud))
        return chunks
