# SPDX-License-Identifier: Apache-2.0
"""SLAMTEC RPLIDAR A, S and C series: requests for health and scan modes, then the scan; turns clockwise.

The A1 turns by its adapter's line DTR, A2 and A3 by a pulse width. S and C series take a speed.
SLAMTEC, 'RPLIDAR interface protocol and application notes', rev. 1.1 (A1, A2) and 2.1; rplidar_sdk 2.1 for S and C:

    request: A5 | command [| payload length | payload | xor of all bytes]
    answer: A5 5A | u32: length 30 bits, mode 2 bits | type u8 | packets of this length
"""

import struct
from functools import reduce
from operator import xor

from services.lidar_driver.device import PacketCounts, Returns, is_before
from services.lidar_driver.request_answers import MAX_BUFFER, find_answer
from services.lidar_driver.rplidar_capsules import FORMATS
from services.lidar_driver.rplidar_streams import BeamStream, CapsuleStream, NodeStream

MS = 1_000_000
STOP, RESET, SCAN = b"\xa5\x25", b"\xa5\x40", b"\xa5\x20"
INFO, HEALTH, SAMPLE_RATE = b"\xa5\x50", b"\xa5\x52", b"\xa5\x59"
CONFIGURATION, EXPRESS, MOTOR_PWM, MOTOR_SPEED = 0x84, 0x82, 0xF0, 0xA8
TYPICAL_MODE, MODE_ANSWER_TYPE, MODE_SAMPLE_TIME = 0x7C, 0x75, 0x71  # entries of the configuration
MOTOR_PULSE = 660  # of 1023: what SLAMTEC's driver sets
NODES = 0x81
ANSWERS: dict[int, dict[int, int | None]] = {
    0x50: {0x04: 20},
    0x52: {0x06: 3},
    0x59: {0x15: 4},
    0x20: {NODES: 5},
    CONFIGURATION: {0x20: None},
    EXPRESS: {kind: format_.length for kind, format_ in FORMATS.items()},
}
"""Request -> types of its answer -> length in bytes; None: not fixed."""
FIRST_A2 = 0x20  # first model with control of its motor; its full rate needs express mode
FIRST_C1 = 0x40  # first model with a motor speed in turns a minute; S1 is 0x61, S2 0x71, S3 0x81
STANDARD_MODE = 0
UNHEALTHY = 2


def mode_entry(entry: int, mode: int) -> bytes:
    """A request for an entry of the configuration that belongs to a scan mode."""
    return request_with_payload(CONFIGURATION, struct.pack("<IH", entry, mode))


def request_with_payload(request: int, payload: bytes) -> bytes:
    """A request with payload and checksum."""
    body = bytes([0xA5, request, len(payload)]) + payload
    return body + bytes([reduce(xor, body)])


class Rplidar:
    """An RPLIDAR on a serial line. express: whether to scan in express mode; None: if the model needs it.

    rate: turns/s, set in models of the S and C series.
    """

    clockwise = True

    def __init__(self, baud: int, express: bool | None, rate: float = 10.0) -> None:
        self.counts = PacketCounts()
        self.byte_time = 10.0 / baud  # s
        self.express_setting = express
        self.rate = rate
        self.fault = ""
        self.clock_reading = None
        self.start(0)

    def start(self, now: int) -> bytes:
        self.scan: BeamStream | None = None
        self.last_request, self.is_answered = STOP, False
        self.deadline = now + 100 * MS  # bytes of an earlier scan have passed by then
        self.buffer = b""
        self.model = 0
        self.mode: int | None = None  # the scan mode; None: not reported
        self.mode_answer = 0  # type of its answer; 0: not reported
        self.sample_times = (500e-6, 500e-6)  # s, standard and express; defaults of firmware without the request
        return STOP

    def stop_command(self) -> bytes:
        has_pulse = FIRST_A2 <= self.model < FIRST_C1
        return STOP + (request_with_payload(MOTOR_PWM, bytes(2)) if has_pulse else b"")

    @property
    def scanning(self) -> bool:
        return self.scan is not None

    @property
    def speed(self) -> float | None:
        return self.scan.speed if self.scan is not None else None

    @property
    def express(self) -> bool:
        return self.model >= FIRST_A2 if self.express_setting is None else self.express_setting

    def next_command(self, now: int) -> bytes:
        if self.scanning or (is_before(self.deadline, now) and not self.is_answered):
            return b""
        if not self.is_answered and self.last_request in (INFO, HEALTH):
            return self.start(now)
        request = self.last_request[1]
        if self.last_request in (STOP, RESET):
            return self._ask(INFO, now, 500)
        if self.last_request == INFO:
            return self._ask(HEALTH, now, 500)
        if self.last_request == HEALTH:
            return self._ask(RESET, now, 2000) if self.fault else self._ask(SAMPLE_RATE, now, 500)
        if self.last_request == SAMPLE_RATE and self.express:  # firmware before 1.17 does not know the request
            return self._ask(request_with_payload(CONFIGURATION, struct.pack("<I", TYPICAL_MODE)), now, 300)
        if self.last_request == SAMPLE_RATE and self.model >= FIRST_A2:
            self.mode, self.mode_answer = STANDARD_MODE, NODES
            return self._ask(mode_entry(MODE_SAMPLE_TIME, self.mode), now, 300)
        if request == CONFIGURATION and self.mode is not None:
            following = {TYPICAL_MODE: MODE_ANSWER_TYPE, MODE_ANSWER_TYPE: MODE_SAMPLE_TIME}.get(self.last_request[3])
            if following is not None:
                return self._ask(mode_entry(following, self.mode), now, 300)
        if request in (EXPRESS, SCAN[1]):
            return self.start(now)  # the scan did not begin
        return self._motor_command() + self._ask(self._scan_request(), now, 2000)

    def _motor_command(self) -> bytes:
        if self.model >= FIRST_C1:
            return request_with_payload(MOTOR_SPEED, struct.pack("<H", round(60 * self.rate)))
        return request_with_payload(MOTOR_PWM, struct.pack("<H", MOTOR_PULSE)) if self.model >= FIRST_A2 else b""

    def _scan_request(self) -> bytes:
        """Standard mode where no other is needed, or where the typical one answers in a format that is not known."""
        is_known = self.mode_answer in FORMATS or not self.mode_answer
        if not self.express or not is_known:
            return SCAN
        return request_with_payload(EXPRESS, struct.pack("<BI", self.mode or 0, 0))

    def _ask(self, request: bytes, now: int, timeout_ms: int) -> bytes:
        """Sends a request; `timeout_ms` is the maximum time to its answer."""
        self.last_request, self.is_answered, self.deadline, self.buffer = request, False, now + timeout_ms * MS, b""
        return request

    def receive(self, data: bytes, now: int) -> list[Returns]:
        if self.scan is None:
            data = self._receive_answer(data)
        return self.scan.receive(data) if self.scan is not None else []

    def _receive_answer(self, data: bytes) -> bytes:
        """Searches for the answer to the last request. Returns the bytes after it when a scan has begun."""
        expected = ANSWERS.get(self.last_request[1])
        if expected is None or self.is_answered:
            return b""
        self.buffer = (self.buffer + data)[-MAX_BUFFER:]
        answer = find_answer(self.buffer, expected)
        if answer is None:
            return b""
        self.is_answered, self.buffer = True, b""
        self.counts.n_good += 1
        return self._handle_answer(*answer)

    def _handle_answer(self, kind: int, answer: bytes) -> bytes:
        """Handles an answer of this type. Returns the first bytes of a scan."""
        if kind in FORMATS:
            self.scan = CapsuleStream(self.counts, FORMATS[kind], self.sample_times[1], self.byte_time)
            return answer
        if kind == NODES:
            self.scan = NodeStream(self.counts, self.sample_times[0], self.byte_time)
            return answer
        if self.last_request == INFO:
            self.model = answer[0]
        elif self.last_request == HEALTH:
            status, code = struct.unpack_from("<BH", answer)
            self.fault = f"the laser reports a health error, code {code}" if status == UNHEALTHY else ""
        elif self.last_request == SAMPLE_RATE:
            standard, express = struct.unpack_from("<HH", answer)
            self.sample_times = max(standard, 20) * 1e-6, max(express, 20) * 1e-6
        elif len(answer) >= 6 and answer[0] == TYPICAL_MODE:
            self.mode = answer[4]
        elif len(answer) >= 5 and answer[0] == MODE_ANSWER_TYPE:
            self.mode_answer = answer[4]
        elif len(answer) >= 8 and answer[0] == MODE_SAMPLE_TIME:
            sample_time = max(struct.unpack_from("<I", answer, 4)[0] / 256, 20) * 1e-6  # from 1/256 us
            standard, express = self.sample_times
            is_standard = self.mode_answer == NODES
            self.sample_times = (sample_time, express) if is_standard else (standard, sample_time)
        return b""
