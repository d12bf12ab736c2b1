# SPDX-License-Identifier: Apache-2.0
"""SLAMTEC RPLIDAR A1, A2, A3, S1: asked for its health and its modes, then to scan; turns clockwise.

SLAMTEC, 'RPLIDAR interface protocol and application notes', rev. 1.1 (A1, A2) and 2.1: requests are A5 cmd [length,
payload, xor of all]; an answer is a descriptor A5 5A, u32 (30 bits length, 2 bits mode), u8 type, then packets of that
length.
"""

import struct
from functools import reduce
from operator import xor

from services.lidar_driver.device import Counts, Returns
from services.lidar_driver.rplidar_capsules import FORMATS
from services.lidar_driver.rplidar_scan import CapsuleScan, NodeScan, Scan

MS = 1_000_000
STOP, RESET, SCAN = b"\xa5\x25", b"\xa5\x40", b"\xa5\x20"
INFO, HEALTH, SAMPLE_RATE = b"\xa5\x50", b"\xa5\x52", b"\xa5\x59"
CONFIGURATION, EXPRESS, MOTOR = 0x84, 0x82, 0xF0
TYPICAL_MODE, MODE_SAMPLE_TIME = 0x7C, 0x71  # entries of the configuration
MOTOR_SPEED = 660  # of 1023: what SLAMTEC's driver sets
NODES = 0x81
ANSWERS: dict[int, dict[int, int | None]] = {
    0x50: {0x04: 20},
    0x52: {0x06: 3},
    0x59: {0x15: 4},
    0x20: {NODES: 5},
    CONFIGURATION: {0x20: None},
    EXPRESS: {kind: format_.length for kind, format_ in FORMATS.items()},
}
"""Request -> types of its answer, and their length in bytes, where that is fixed."""
DESCRIPTOR = struct.Struct("<BBIB")
MOST_KEPT = 4096  # bytes among which an answer is looked for
LONGEST_ANSWER = 128
FIRST_A2 = 0x20  # models from here on take a motor speed, and scan fully only in express mode
UNHEALTHY = 2


def with_payload(request: int, payload: bytes) -> bytes:
    """A request with its payload and their sum."""
    body = bytes([0xA5, request, len(payload)]) + payload
    return body + bytes([reduce(xor, body)])


class Rplidar:
    """An RPLIDAR on a serial line. express: whether to ask for it; None: where the model needs it."""

    clockwise = True

    def __init__(self, baud: int, express: bool | None) -> None:
        self.counts = Counts()
        self.byte_time = 10.0 / baud  # s
        self.wanted = express
        self.trouble = ""
        self.met = None
        self.opened(0)

    def opened(self, now: int) -> bytes:
        self.scan: Scan | None = None
        self.asked, self.answered = STOP, False
        self.until = now + 100 * MS  # what was under way on the line has passed by then
        self.rest = b""
        self.model = 0
        self.mode: int | None = None  # of express scans, where it tells
        self.sample_times = (500e-6, 500e-6)  # s, standard and express, of firmware that does not tell
        return STOP

    def farewell(self) -> bytes:
        return STOP + (with_payload(MOTOR, bytes(2)) if self.model >= FIRST_A2 else b"")

    @property
    def scanning(self) -> bool:
        return self.scan is not None

    @property
    def speed(self) -> float | None:
        return self.scan.speed if self.scan is not None else None

    @property
    def express(self) -> bool:
        return self.model >= FIRST_A2 if self.wanted is None else self.wanted

    def due(self, now: int) -> bytes:
        if self.scanning or (now < self.until and not self.answered):
            return b""
        if not self.answered and self.asked in (INFO, HEALTH):
            return self.opened(now)
        request = self.asked[1]
        if self.asked in (STOP, RESET):
            return self._ask(INFO, now, 500)
        if self.asked == INFO:
            return self._ask(HEALTH, now, 500)
        if self.asked == HEALTH:
            return self._ask(RESET, now, 2000) if self.trouble else self._ask(SAMPLE_RATE, now, 500)
        if self.asked == SAMPLE_RATE and self.express:  # firmware before 1.17 does not know the question
            return self._ask(with_payload(CONFIGURATION, struct.pack("<I", TYPICAL_MODE)), now, 300)
        if request == CONFIGURATION and self.mode is not None and len(self.asked) == 8:
            return self._ask(with_payload(CONFIGURATION, struct.pack("<IH", MODE_SAMPLE_TIME, self.mode)), now, 300)
        if request in (EXPRESS, SCAN[1]):
            return self.opened(now)  # it did not begin
        motor = with_payload(MOTOR, struct.pack("<H", MOTOR_SPEED)) if self.model >= FIRST_A2 else b""
        order = with_payload(EXPRESS, struct.pack("<BI", self.mode or 0, 0)) if self.express else SCAN
        return motor + self._ask(order, now, 2000)

    def _ask(self, request: bytes, now: int, patience: int) -> bytes:
        """patience: ms."""
        self.asked, self.answered, self.until, self.rest = request, False, now + patience * MS, b""
        return request

    def received(self, data: bytes, now: int) -> list[Returns]:
        if self.scan is None:
            data = self._answered(data)
        return self.scan.received(data) if self.scan is not None else []

    def _answered(self, data: bytes) -> bytes:
        """Takes the answer to what was asked; gives back what follows it when a scan has begun."""
        expected = ANSWERS.get(self.asked[1])
        if expected is None or self.answered:
            return b""
        self.rest = (self.rest + data)[-MOST_KEPT:]
        at = self.rest.find(b"\xa5\x5a")
        while 0 <= at <= len(self.rest) - DESCRIPTOR.size:
            _, _, size, kind = DESCRIPTOR.unpack_from(self.rest, at)
            length = size & 0x3FFFFFFF
            fits = kind in expected and length == (expected[kind] or min(length, LONGEST_ANSWER))
            answer = self.rest[at + DESCRIPTOR.size :]
            if fits and (size >> 30 or len(answer) >= length):
                self.answered, self.rest = True, b""
                self.counts.n_good += 1
                return self._understood(kind, answer)
            if fits:
                break  # the rest of it is to come
            at = self.rest.find(b"\xa5\x5a", at + 1)
        return b""

    def _understood(self, kind: int, answer: bytes) -> bytes:
        """Takes an answer of this type; gives back the beginning of a scan."""
        if kind in FORMATS:
            self.scan = CapsuleScan(self.counts, FORMATS[kind], self.sample_times[1], self.byte_time)
            return answer
        if kind == NODES:
            self.scan = NodeScan(self.counts, self.sample_times[0], self.byte_time)
            return answer
        if self.asked == INFO:
            self.model = answer[0]
        elif self.asked == HEALTH:
            status, code = struct.unpack_from("<BH", answer)
            self.trouble = f"the laser reports a health error, code {code}" if status == UNHEALTHY else ""
        elif self.asked == SAMPLE_RATE:
            standard, express = struct.unpack_from("<HH", answer)
            self.sample_times = max(standard, 20) * 1e-6, max(express, 20) * 1e-6
        elif len(answer) >= 6 and answer[0] == TYPICAL_MODE:
            self.mode = answer[4]
        elif len(answer) >= 8 and answer[0] == MODE_SAMPLE_TIME:
            (sample_time,) = struct.unpack_from("<I", answer, 4)  # 1/256 us
            self.sample_times = self.sample_times[0], max(sample_time / 256, 20) * 1e-6
        return b""
