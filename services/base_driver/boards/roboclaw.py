# SPDX-License-Identifier: Apache-2.0
"""RoboClaw in packet serial mode: motor 1 is the left wheel, motor 2 the right one.

A request is address, command, data and CRC-16 (high byte first). A reading answers data and the CRC of address, command
and data; a setting answers FF. Commands 14, 24, 37, 49 and 78 of the "RoboClaw Series Brushed DC Motor Controllers User
Manual", Basicmicro, 2015 and later. The next request is sent after the answer to the one before.
"""

from struct import Struct

import numpy as np

from services.base_driver.boards.board_config import SerialBoardConfig
from services.base_driver.boards.device import BoardInput, WheelDevice
from shared.board_framing import crc16
from shared.config import Robot

SET_TIMEOUT, BATTERY, DRIVE, CURRENTS, ENCODERS = 14, 24, 37, 49, 78  # commands
READINGS = {BATTERY: Struct(">H"), CURRENTS: Struct(">hh"), ENCODERS: Struct(">II")}
ACKNOWLEDGE = b"\xff"
ANSWER_NS = 40_000_000  # ns after which an answer counts as lost
MAX_SPEED_COUNTS = 1_000_000  # counts/s
CHAIN = (ENCODERS, BATTERY, CURRENTS)
"""What is read after each command."""


class RoboclawBoard(WheelDevice):
    """Sends the speeds, then reads encoders, battery and currents, one request after the other."""

    NAME = "roboclaw"
    INVERTIBLE = True

    def __init__(self, config: SerialBoardConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self._kept = b""
        self._expected: list[int] = []  # commands whose answers come next; the first one was sent
        self._asked_at = 0  # ns
        self._speeds_to_send: tuple[float, float] | None = None
        self._must_start = True

    def forget(self) -> None:
        super().forget()
        self._kept, self._expected, self._speeds_to_send = b"", [], None

    def start_command(self) -> bytes:
        self._kept, self._expected, self._must_start = b"", [], True
        return b""  # the timeout is set before the next command

    def stop_command(self) -> bytes:
        return self._setting(DRIVE, bytes(8))

    def command(self, left: float, right: float, now: int) -> bytes:
        self._speeds_to_send = left, right
        if self._expected and 0 <= now - self._asked_at < ANSWER_NS:
            return b""  # it follows the answer that is awaited
        self._kept, self._must_start = b"", self._must_start or bool(self._expected)  # it may have been restarted
        return self._begin(now)

    def receive(self, data: bytes, stamp: int, now: int) -> BoardInput:
        received = BoardInput()
        self._kept += data
        while self._expected and self._kept:
            reading = READINGS.get(self._expected[0])
            length = len(ACKNOWLEDGE) if reading is None else reading.size + 2
            if len(self._kept) < length:
                break
            answer, self._kept = self._kept[:length], self._kept[length:]
            command = self._expected.pop(0)
            if not self._decode(command, answer, stamp, received):
                self.counts.n_bad += 1
                self.counts.n_resyncs += 1
                self.counts.n_skipped += length + len(self._kept)
                self._kept, self._expected = b"", []
                break
            self.counts.n_good += 1
            if self._expected:
                self._asked_at = now
                received.answer += self._request(self._expected[0])
            elif self._speeds_to_send is not None:
                received.answer += self._begin(now)
        if not self._expected:
            self._kept = b""  # an answer to no request: of the start, or late
        return received

    def _begin(self, now: int) -> bytes:
        """The first request of the next chain."""
        self._expected = [*((SET_TIMEOUT,) if self._must_start else ()), DRIVE, *CHAIN]
        self._asked_at, self._must_start = now, False
        return self._request(self._expected[0])

    def _request(self, command: int) -> bytes:
        if command == SET_TIMEOUT:
            return self._setting(command, bytes((max(1, round(self.config.command_life * 10)),)))  # 0.1 s
        if command == DRIVE:
            left, right = self.forward_counts(*(self._speeds_to_send or (0.0, 0.0)))
            self._speeds_to_send = None
            speeds = (min(max(round(speed), -MAX_SPEED_COUNTS), MAX_SPEED_COUNTS) for speed in (left, right))
            return self._setting(command, Struct(">ii").pack(*speeds))
        return bytes((self.config.address, command))

    def _setting(self, command: int, data: bytes) -> bytes:
        packet = bytes((self.config.address, command)) + data
        return packet + crc16(packet).to_bytes(2, "big")

    def _decode(self, command: int, answer: bytes, stamp: int, received: BoardInput) -> bool:
        """Adds an answer's content; False where it is damaged."""
        if command not in READINGS:
            return answer == ACKNOWLEDGE
        data = answer[:-2]
        if crc16(bytes((self.config.address, command)) + data) != int.from_bytes(answer[-2:], "big"):
            return False
        first, *rest = READINGS[command].unpack(data)
        if command == ENCODERS:
            received.report = self.report(stamp, first, rest[0], stamp * 1e-9)
            received.n_reports += 1
        elif command == BATTERY:
            self.battery = min(first * 0.1, 100.0)
        elif command == CURRENTS:
            self.currents = np.clip(np.array((first, rest[0]), np.float32) * np.float32(0.01), -200, 200)
        return True
