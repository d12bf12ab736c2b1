# SPDX-License-Identifier: Apache-2.0
"""Bosch BNO055 on its UART: registers are written and read by request (data sheet BST-BNO055-DS000, section 4.7).

    write  AA 00 register length data...   answered by  EE status
    read   AA 01 register length           answered by  BB length data...  or  EE status

There is no checksum. So an answer counts only whole, alone, and while its request waits. In mode IMU the sensor gives
turn rates without their offset at 100 Hz (tables 3-5 and 3-14), and no compass that a robot's motors disturb.
"""

import struct
from math import radians

from services.imu_driver.device import Reading, ReadingCounts

CHIP_ID, PAGE_ID, DATA, UNIT_SELECT, MODE = 0x00, 0x07, 0x08, 0x3B, 0x3D
BNO055 = 0xA0
CONFIG_MODE, IMU_MODE = 0x00, 0x08
DATA_LENGTH = 18  # accelerometer, magnetometer, gyro: three axes each
ACCELERATION_LSB, RATE_LSB = 100.0, 16.0  # 1 m/s^2, 1 degree/s: tables 3-17 and 3-22, units at reset
WRITTEN = 0x01
ANSWER_NS = 100_000_000
PERIOD_NS = 18_000_000  # between two readings: each tick of the service
N_TRIES = 5
STATUS = {
    0x02: "read failed", 0x03: "write failed", 0x04: "no such register", 0x05: "register is read-only",
    0x06: "wrong start byte", 0x07: "bus overrun", 0x08: "too long", 0x09: "too short", 0x0A: "a character was late",
}  # fmt: skip


def write_command(register: int, *values: int) -> bytes:
    """The command that writes registers from `register` on."""
    return bytes((0xAA, 0x00, register, len(values), *values))


def read_command(register: int, length: int) -> bytes:
    """The command that reads `length` registers from `register` on."""
    return bytes((0xAA, 0x01, register, length))


START = (
    write_command(PAGE_ID, 0),
    write_command(MODE, CONFIG_MODE),
    read_command(CHIP_ID, 1),
    write_command(UNIT_SELECT, 0),
    write_command(MODE, IMU_MODE),
)
READ = read_command(DATA, DATA_LENGTH)


MAX_IMPLAUSIBLE = 25  # readings in a row: half a second


class Bno055:
    """A BNO055: the start sequence, then one reading at a time."""

    def __init__(self, baud: int) -> None:
        self.counts = ReadingCounts()
        self.fault = ""
        self._answer_time = round((2 + DATA_LENGTH) * 10e9 / baud)  # ns
        self.start(0)

    def start(self, now: int) -> bytes:
        self._step = self._tries = self._n_implausible = 0
        self._buffer = b""
        return self._send(now)

    def _send(self, now: int) -> bytes:
        """The command of the present step; whatever came before it is no answer to it."""
        self._sent_at, self._waits, self._buffer = now, True, b""
        return START[self._step] if self._step < len(START) else READ

    def next_command(self, now: int) -> bytes:
        since = now - self._sent_at
        if self._waits and 0 <= since < ANSWER_NS:
            return b""
        if self._waits:
            self._tries += 1
            if self._tries >= N_TRIES:
                return self.start(now)
        elif self._step >= len(START) and 0 <= since < PERIOD_NS:
            return b""
        return self._send(now)

    def receive(self, data: bytes, now: int) -> list[Reading]:
        if not self._waits:
            return []
        self._buffer += data
        expected = self._expected_length()
        if len(self._buffer) < expected:
            return []
        answer, self._waits = self._buffer, False
        if len(answer) > expected or not self._is_answer(answer):
            self.counts.n_bad += 1
            return []
        self._tries = 0
        if self._step < len(START):
            self._step += 1
            return []
        return self._reading(answer, now)

    def _expected_length(self) -> int:
        """Bytes of the answer; of a refusal 2, whatever was asked."""
        if self._buffer[:1] == b"\xee":
            return 2
        command = START[self._step] if self._step < len(START) else READ
        return 2 + command[3] if command[1] == 0x01 else 2

    def _is_answer(self, answer: bytes) -> bool:
        """Whether it is what the command asked for. Sets the fault."""
        command = START[self._step] if self._step < len(START) else READ
        if answer[0] == 0xEE:
            is_written = command[1] == 0x00 and answer[1] == WRITTEN
            # bus overruns come now and then, and the next try helps: no fault
            self.fault = "" if is_written or answer[1] == 0x07 else STATUS.get(answer[1], "an unknown error")
            return is_written
        if command[1] != 0x01 or answer[:2] != bytes((0xBB, command[3])):
            return False
        is_known = command[2] != CHIP_ID or answer[2] == BNO055
        self.fault = "" if is_known else f"the chip is no BNO055: its id is {answer[2]:#04x}"
        return is_known

    def _reading(self, answer: bytes, now: int) -> list[Reading]:
        x, y, z = (value / ACCELERATION_LSB for value in struct.unpack_from("<3h", answer, 2))
        (rate,) = struct.unpack_from("<h", answer, 2 + 16)
        reading = Reading(max(now - self._answer_time, 0), radians(rate / RATE_LSB), x, y, z)
        if not reading.is_plausible:
            self.counts.n_bad += 1
            self._n_implausible += 1
            if self._n_implausible >= MAX_IMPLAUSIBLE:  # it was reset, and its mode measures nothing
                self._step = self._n_implausible = 0
            return []
        self.counts.n_good += 1
        self._n_implausible = 0
        return [reading]
