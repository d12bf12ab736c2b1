# SPDX-License-Identifier: Apache-2.0
"""YDLIDAR X2, X4, G2: packets of up to 40 samples, clockwise, a zero packet a turn; the X2 takes no requests.

The head turns evenly. The direction of a beam from it depends on the distance (YDLIDAR, 'YDLidar-SDK Communication
Protocol', 'second-level analysis'). So each sample is searched among the beams around the head's angle.
"""

import struct
from functools import reduce
from math import degrees
from operator import xor

import numpy as np

from services.sim.hardware.beam_lookup import first_angle, ranges_mm, timed_chunk, turn_times
from services.sim.hardware.ld06 import strength
from services.sim.hardware.rplidar import MODE_STREAM, NO_MOTOR, descriptor
from shared.config import Laser
from shared.messages import LaserScan
from shared.types import Float64s

N_SAMPLES = 40  # of a packet
LAG_DEG = 7.75  # degrees by which a beam of 5 m lags behind the head: the middle of 3 m and 12 m
MAX_LEAD_DEG = 16.0  # degrees by which a beam of 0.05 m leads
MAX_MM = 0x3FFF
MAX_MISFIT = 0.6  # steps between the beam's direction and the one that its distance gives


def packet(first: float, last: float, samples: list[tuple[float, int]], rate: float | None, intensity: bool) -> bytes:
    """One packet. first, last: degrees of the head.  samples: mm, intensity.  rate: turns/s, of a zero packet."""
    ct = 0 if rate is None else 1 | round(rate * 10) << 1
    angles = [round(angle * 64) % (360 * 64) << 1 | 1 for angle in (first, last)]
    head = struct.pack("<HBBHH", 0x55AA, ct, len(samples), *angles)
    words = list(struct.unpack("<4H", head))
    body = b""
    for mm, strong in samples:
        word = round(mm) << 2 | strong >> 8 if intensity else round(mm * 4)
        words += [strong & 0xFF, word] if intensity else [word]
        body += struct.pack("<BH", strong & 0xFF, word) if intensity else struct.pack("<H", word)
    return head + struct.pack("<H", reduce(xor, words)) + body


def correction(mm: Float64s) -> Float64s:
    """(...) mm -> degrees from the head to the beam, clockwise; NaN without a distance."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(mm > 0, np.degrees(np.arctan(21.8 * (155.3 - mm) / (155.3 * mm))), np.nan)


class YdlidarEmulator:
    """While it does not turn it sends nothing, and reports its health as failed. The X2 scans from the start."""

    def __init__(self, laser: Laser, samples: int, baud: int, answers: bool = True, intensity: bool = False) -> None:
        """samples: a second."""
        self.laser, self.baud, self.answers, self.intensity = laser, baud, answers, intensity
        self.turning = True
        self.is_scanning = not answers
        self.n = round(samples / laser.rate)  # samples a turn
        self.received_bytes = b""

    def receive(self, data: bytes, now: int) -> bytes:
        answer = b""
        self.received_bytes = (self.received_bytes + data)[-64:]
        while self.answers and (at := self.received_bytes.find(0xA5)) >= 0 and len(self.received_bytes) > at + 1:
            answer += self._answer(self.received_bytes[at + 1])
            self.received_bytes = self.received_bytes[at + 2 :]
        return answer

    def _answer(self, request: int) -> bytes:
        if request == 0x65:
            self.is_scanning = False
        elif request == 0x90:
            return descriptor(20, 0x04) + bytes([6, 1, 1, 1]) + bytes(range(16))
        elif request == 0x91:
            return descriptor(3, 0x06) + (struct.pack("<BH", 0, 0) if self.turning else struct.pack("<BH", 2, NO_MOTOR))
        elif request == 0x60:
            self.is_scanning = True
            return descriptor(5 | MODE_STREAM, 0x81)
        return b""

    def sweep_chunks(self, scan: LaserScan, now: int) -> list[tuple[int, bytes]]:
        if not self.turning or not self.is_scanning:
            return []
        step = 360 / self.n
        head = np.asarray(-degrees(first_angle(scan, -1)) + LAG_DEG + step * np.arange(self.n), np.float64)
        mm = self._sampled(scan, head, step)
        zero = int(np.argmin(head % 360))
        edges = [*range(0, zero, N_SAMPLES), zero, *range(zero + 1, self.n, N_SAMPLES), self.n]
        begins, ends = edges[:-1], [edge - 1 for edge in edges[1:]]
        chunks: list[tuple[int, bytes]] = []
        sent = 0  # ns, when the last chunk is sent: a short packet does not overtake a long one
        for at, begin, end in zip(turn_times(scan, self.laser, np.array(ends) / self.n), begins, ends):
            samples = [(d, strength(round(d))) for d in mm[begin : end + 1].tolist()]
            rate = self.laser.rate if begin == zero else None
            data = packet(head[begin], head[end], samples, rate, self.intensity)
            chunks.append(timed_chunk(max(at, sent), data, self.baud))
            sent = chunks[-1][0]
        return chunks

    def _sampled(self, scan: LaserScan, head: Float64s, step: float) -> Float64s:
        """(n,) degrees of the head -> (n,) mm of the sample there, 0 without one."""
        places = np.arange(-2, round((LAG_DEG + MAX_LEAD_DEG) / step) + 1)
        beams = head[:, None] - LAG_DEG + step * places
        mm = ranges_mm(scan, np.radians(-beams).ravel()).reshape(beams.shape)
        mm[mm > MAX_MM] = 0
        misfits = np.nan_to_num(np.abs(beams - head[:, None] - correction(mm)), nan=np.inf)
        best = misfits.argmin(axis=1)
        rows = np.arange(self.n)
        return np.asarray(np.where(misfits[rows, best] < MAX_MISFIT * step, mm[rows, best], 0.0), np.float64)
