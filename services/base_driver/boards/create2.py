# SPDX-License-Identifier: Apache-2.0
"""iRobot Create 2 and Roomba by the Open Interface: streams the asked sensor packets, takes the speed of each wheel.

Stream: 13 (hex), length, (packet id, data) for each packet, checksum: all bytes together are 0 modulo 256. Big-endian.
The numbers are those of "iRobot Create 2 Open Interface (OI) Specification based on the iRobot Roomba 600", 2015.
"""

from struct import Struct

import numpy as np

from services.base_driver.boards.board_config import SerialBoardConfig
from services.base_driver.boards.device import BoardContacts, BoardInput, WheelDevice, bit_names
from shared.board_framing import PacketReader
from shared.config import Robot

START, SAFE, DRIVE_DIRECT, STREAM, STREAM_PAUSE = 128, 131, 145, 148, 150  # opcodes
PASSIVE_MODE, DRIVING_MODES = 1, (2, 3)  # of packet 35: safe and full
MAX_SPEED_MM = 500  # mm/s of a wheel
BUMPS = {"right": 1, "left": 2}
WHEEL_DROPS = {"right_wheel_drop": 4, "left_wheel_drop": 8}
CLIFFS = ("left", "front_left", "front_right", "right")
OVERCURRENTS = {"right": 8, "left": 16}

PACKETS = {
    7: "B", 9: "B", 10: "B", 11: "B", 12: "B", 14: "B", 22: "H", 35: "B", 43: "H", 44: "H", 54: "h", 55: "h",
}  # fmt: skip
"""Packet id -> type: bumps, cliffs, overcurrents, voltage (mV), mode, encoder counts, motor currents (mA)."""
_CONTENT = Struct(">" + "".join("B" + kind for kind in PACKETS.values()))


class Create2Board(WheelDevice):
    """Starts the interface in safe mode: the robot then stops by itself at a cliff, and when a wheel drops.

    It has no watchdog: without a computer it drives on until something stops it.
    """

    NAME = "create2"
    WRAP = 65536

    def __init__(self, config: SerialBoardConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        size = range(_CONTENT.size, _CONTENT.size + 1)
        self._reader = PacketReader(b"\x13", size, lambda packet: sum(packet) % 256 == 0, self.counts)
        self._may_resume = False  # it left safe mode, and no wheel has dropped

    def forget(self) -> None:
        super().forget()
        self._reader.forget()

    def start_command(self) -> bytes:
        return bytes((START, SAFE, STREAM, len(PACKETS), *PACKETS)) + drive_direct(0.0, 0.0)

    def stop_command(self) -> bytes:
        return drive_direct(0.0, 0.0) + bytes((STREAM_PAUSE, 0, START))

    def command(self, left: float, right: float, now: int) -> bytes:
        resumption = bytes((SAFE,)) if self._may_resume and left == right == 0 else b""
        return resumption + drive_direct(*self.rim_speeds(left, right))

    def receive(self, data: bytes, stamp: int, now: int) -> BoardInput:
        received = BoardInput()
        for content in self._reader.packets(data):
            fields = _CONTENT.unpack(content)
            if fields[::2] == tuple(PACKETS):
                self._decode(dict(zip(PACKETS, fields[1::2])), stamp, received)
        return received

    def _decode(self, values: dict[int, int], stamp: int, received: BoardInput) -> None:
        drops = bit_names(values[7], WHEEL_DROPS)
        cliffs = tuple(name for name, packet in zip(CLIFFS, (9, 10, 11, 12)) if values[packet])
        received.contacts = BoardContacts(bit_names(values[7], BUMPS), cliffs + drops)
        self.battery = values[22] * 1e-3
        self.currents = np.array((values[54] * 1e-3, values[55] * 1e-3), np.float32)
        is_driving = values[35] in DRIVING_MODES
        self._may_resume = not is_driving and values[35] == PASSIVE_MODE and not drops
        overcurrents = " and ".join(bit_names(values[14], OVERCURRENTS))
        self.fault = f"the robot reports too much current of the {overcurrents} wheel" if overcurrents else ""
        if not is_driving:
            self.fault = "the robot has left safe mode: a cliff, a dropped wheel, its button or its charger"
        received.report = self.report(stamp, values[43], values[44], stamp * 1e-9)
        received.n_reports += 1


def drive_direct(left: float, right: float) -> bytes:
    """The command of both wheels' speeds, m/s."""
    mm = [min(max(round(speed * 1e3), -MAX_SPEED_MM), MAX_SPEED_MM) for speed in (right, left)]
    return Struct(">Bhh").pack(DRIVE_DIRECT, *mm)
