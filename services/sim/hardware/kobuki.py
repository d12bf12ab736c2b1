# SPDX-License-Identifier: Apache-2.0
"""The emulated Kobuki: a packet with basic and inertial sensor data a period; takes a speed and a radius.

Its document promises no end of a command: it stands until the next one.
"""

from math import degrees
from struct import pack, unpack

from services.sim.hardware.electronics import BodyTruth, WheelElectronics
from shared.board_framing import LineCounts, PacketReader, xor
from shared.config import Robot
from shared.messages import BoardReport

HEADER = b"\xaa\x55"
HALF_BIAS_MM = 115.0  # mm, half of the wheel distance by which it converts speed and radius
MS = 1_000_000
BUMPER_BITS = CLIFF_BITS = {"right": 1, "front": 2, "left": 4}


class KobukiElectronics(WheelElectronics):
    """State of the base after the driver's commands."""

    HAS_GYRO = HAS_CONTACTS = True
    WRAP = 65536

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot)
        self._reader = PacketReader(HEADER, range(3, 256), lambda packet: xor(packet[2:]) == 0, LineCounts())
        self._started_at: int | None = None  # ns

    def restart(self) -> None:
        super().restart()
        self._started_at = None

    def receive(self, data: bytes, now: int) -> bytes:
        for payload in self._reader.packets(data):
            if payload[:2] == b"\x01\x04" and len(payload) >= 6:
                speed, radius = unpack("<hh", payload[2:6])
                self._drive(speed, radius, now)
        return b""

    def packets(self, truth: BoardReport, body: BodyTruth, now: int) -> list[bytes]:
        self._started_at = now if self._started_at is None else self._started_at
        ms = (now - self._started_at) // MS % 65536
        left, right = self.counters(truth)
        bumper = sum(bit for name, bit in BUMPER_BITS.items() if name in body.bumpers)
        cliff = sum(bit for name, bit in CLIFF_BITS.items() if name in body.cliffs)
        battery = round(truth.battery * 10) if truth.battery >= 0 else 0
        basic = pack("<HBBBHHbbBBBB", ms, bumper, 0, cliff, left, right, 0, 0, 0, 0, min(battery, 255), 0)
        rate = min(max(round(degrees(body.yaw_rate or 0.0) * 100), -32767), 32767)
        inertial = pack("<hhBBB", 0, rate, 0, 0, 0)
        payload = b"\x01" + bytes((len(basic),)) + basic + b"\x04" + bytes((len(inertial),)) + inertial
        content = bytes((len(payload),)) + payload
        return [HEADER + content + bytes((xor(content),))]

    def _drive(self, speed: int, radius: int, now: int) -> None:
        """Takes speed (mm/s) and radius (mm): 0 straight, 1 on the spot with the right wheel's speed."""
        if radius == 0:
            v, w = speed * 1e-3, 0.0
        elif radius == 1:
            v, w = 0.0, speed / HALF_BIAS_MM
        else:
            w = speed / (radius + (HALF_BIAS_MM if radius > 0 else -HALF_BIAS_MM))
            v = w * radius * 1e-3
        half = w * self.drive.wheel_distance / 2
        self.drive_wheels(v - half, v + half, now)
