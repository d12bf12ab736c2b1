# SPDX-License-Identifier: Apache-2.0
"""A SLAMTEC RPLIDAR: answers what it is asked, then streams standard nodes or express capsules, clockwise.

A1 and A2 answer an express scan with legacy capsules. S and C series know their modes, and answer with dense ones.

While it does not turn it streams nothing, and reports its health as failed.
"""

import struct
from functools import reduce
from math import degrees
from operator import xor

import numpy as np

from services.sim.hardware.beam_lookup import first_angle, ranges_mm, timed_chunk, turn_times
from shared.config import Laser
from shared.messages import LaserScan

BAUD = 115200
MODE_STREAM = 1 << 30
NO_MOTOR = 0x8001  # a code of ours
N_CABINS = 16
N_DENSE = 40  # beams of a dense capsule
WITH_PAYLOAD = {0x82, 0x84, 0xA8, 0xF0}
FIRST_C1 = 0x40
DENSE_MODE = 1


def descriptor(length: int, kind: int) -> bytes:
    """What comes before an answer, or before a stream of packets of this length."""
    return struct.pack("<BBIB", 0xA5, 0x5A, length, kind)


def node(first: bool, degrees_: float, mm: float) -> bytes:
    """One standard node: 1/64 degree, 1/4 mm."""
    quality = 47 if mm else 0
    angle = round(degrees_ * 64) % (360 * 64)
    return struct.pack("<BHH", quality << 2 | (1 if first else 2), angle << 1 | 1, min(round(mm * 4), 0xFFFF))


def capsule(degrees_: float, mm: list[int], is_first: bool) -> bytes:
    """32 beams from an angle on, evenly up to the next capsule's, in whole mm."""
    body = struct.pack("<H", round(degrees_ * 64) % (360 * 64) | (0x8000 if is_first else 0))
    for a, b in zip(mm[::2], mm[1::2]):
        body += struct.pack("<HHB", a << 2, b << 2, 0)
    return with_sync(body)


def dense_capsule(degrees_: float, mm: list[int], is_first: bool) -> bytes:
    """40 beams from an angle on, evenly up to the next capsule's, in whole mm."""
    return with_sync(struct.pack("<41H", round(degrees_ * 64) % (360 * 64) | (0x8000 if is_first else 0), *mm))


def with_sync(body: bytes) -> bytes:
    """A capsule's body with its sync nibbles and its sum."""
    total = reduce(xor, body)
    return bytes([0xA0 | total & 0xF, 0x50 | total >> 4]) + body


class RplidarEmulator:
    """model: 0x18 an A1, 0x28 an A2, 0x41 a C1, 0x61 an S1, 0x71 an S2."""

    def __init__(self, laser: Laser, model: int, baud: int = BAUD) -> None:
        self.laser, self.model, self.baud = laser, model, baud
        self.is_dense = model >= FIRST_C1
        self.rpm: int | None = None  # the speed that an S or C series got
        self.turning = True
        self.n = round(2 * np.pi / abs(laser.angle_increment))  # samples a turn
        self.mode = 0  # the request of the scan under way; 0: none
        self.received_bytes = b""
        self.beams: list[tuple[float, int]] = []  # degrees, mm: what a capsule waits for
        self.is_first = True

    def receive(self, data: bytes, now: int) -> bytes:
        self.received_bytes = (self.received_bytes + data)[-64:]
        answer = b""
        while (at := self.received_bytes.find(0xA5)) >= 0:
            request = self.received_bytes[at:]
            has_payload = len(request) > 1 and request[1] in WITH_PAYLOAD
            length = 2 if not has_payload else 4 + request[2] if len(request) > 2 else 3
            if len(request) < length:
                break
            self.received_bytes = request[length:]
            if not has_payload or reduce(xor, request[:length]) == 0:
                answer += self._answer(request[1], request[3 : length - 1])
        return answer

    def _answer(self, request: int, payload: bytes) -> bytes:
        if request in (0x25, 0x40):
            self.mode = 0
        elif request == 0x50:
            return descriptor(20, 0x04) + bytes([self.model, 29, 1, 7]) + bytes(range(16))
        elif request == 0x52:
            return descriptor(3, 0x06) + (struct.pack("<BH", 0, 0) if self.turning else struct.pack("<BH", 2, NO_MOTOR))
        elif request == 0x59:
            sample_time = round(1e6 / (self.laser.rate * self.n))
            return descriptor(4, 0x15) + struct.pack("<HH", sample_time, sample_time)
        elif request in (0x20, 0x21):
            self.mode = 0x20
            return descriptor(5 | MODE_STREAM, 0x81)
        elif request == 0x82:
            self.mode, self.beams, self.is_first = 0x82, [], True
            return descriptor(84 | MODE_STREAM, 0x85 if self.is_dense else 0x82)
        elif request == 0xA8:
            self.rpm = int.from_bytes(payload, "little")
        elif request == 0x84 and self.is_dense:
            return self._configuration(payload)
        return b""

    def _configuration(self, payload: bytes) -> bytes:
        """The answer to a request for an entry: the typical mode, or a mode's answer type or sample time."""
        sample_time = round(256e6 / (self.laser.rate * self.n))  # 1/256 us
        mode = int.from_bytes(payload[4:6], "little")
        entries = {
            0x7C: struct.pack("<H", DENSE_MODE),
            0x75: bytes([0x85 if mode == DENSE_MODE else 0x81]),
            0x71: struct.pack("<I", sample_time),
        }
        content = payload[:4] + entries.get(payload[0], b"")
        return descriptor(len(content), 0x20) + content

    def sweep_chunks(self, scan: LaserScan, now: int) -> list[tuple[int, bytes]]:
        if not self.turning or not self.mode:
            return []
        angles = -degrees(first_angle(scan, -1)) + 360 / self.n * np.arange(self.n)
        mm = ranges_mm(scan, np.radians(-angles))
        times = turn_times(scan, self.laser, np.arange(1, self.n + 1) / self.n)
        angles %= 360
        if self.mode == 0x20:
            first = int(np.argmin(angles))
            return [
                timed_chunk(at, node(i == first, angle, d), self.baud)
                for i, (at, angle, d) in enumerate(zip(times, angles.tolist(), mm.tolist()))
            ]
        n_beams, most, encoded = (N_DENSE, 0xFFFF, dense_capsule) if self.is_dense else (2 * N_CABINS, 0x3FFF, capsule)
        chunks = []
        for at, angle, d in zip(times, angles.tolist(), np.rint(mm).astype(int).tolist()):
            self.beams.append((angle, min(d, most)))
            if len(self.beams) == n_beams:
                data = encoded(self.beams[0][0], [d for _, d in self.beams], self.is_first)
                chunks.append(timed_chunk(at, data, self.baud))
                self.beams, self.is_first = [], False
        return chunks
