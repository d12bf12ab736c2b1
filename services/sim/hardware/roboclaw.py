# SPDX-License-Identifier: Apache-2.0
"""The emulated RoboClaw in packet serial mode: answers each request; its wheels stop after its serial timeout."""

from struct import pack, unpack

from services.sim.hardware.electronics import BodyTruth, WheelElectronics
from shared.board_framing import crc16
from shared.config import Robot
from shared.messages import BoardReport

ADDRESS = 0x80
LENGTHS = {14: 5, 24: 2, 37: 12, 49: 2, 78: 2}  # command -> bytes of the request


class RoboclawElectronics(WheelElectronics):
    """State of the controller. Counters are those of the last period."""

    WRAP = 1 << 31

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot)
        self._received = b""
        self._battery, self._currents = 0, (0, 0)  # 0.1 V, 10 mA

    def restart(self) -> None:
        super().restart()
        self._received = b""

    def receive(self, data: bytes, now: int) -> bytes:
        self._received, answer = self._received + data if self.is_awake else b"", b""
        while self._received:
            command = self._received[1] if len(self._received) > 1 else 78
            if self._received[0] != ADDRESS or command not in LENGTHS:
                self._received = self._received[1:]
                continue
            if len(self._received) < LENGTHS[command]:
                break
            request, self._received = self._received[: LENGTHS[command]], self._received[LENGTHS[command] :]
            answer += self._answer(command, request, now)
        return answer

    def packets(self, truth: BoardReport, body: BodyTruth, now: int) -> list[bytes]:
        self.read_counters(truth)
        self._battery = round(truth.battery * 10) if truth.battery >= 0 else 0
        self._currents = round(float(truth.currents[0]) * 100), round(float(truth.currents[1]) * 100)
        return []

    def _answer(self, command: int, request: bytes, now: int) -> bytes:
        if command in (14, 37):
            if crc16(request) != 0:  # of data and its own CRC
                return b""
            if command == 14:
                self.life_ns = request[2] * 100_000_000 or None
            else:
                left, right = unpack(">ii", request[2:10])
                self.turn_wheels(left, right, now)
            return b"\xff"
        readings = {24: pack(">H", self._battery), 49: pack(">hh", *self._currents), 78: pack(">II", *self.last_counts)}
        data = readings[command]
        return data + pack(">H", crc16(request + data))
