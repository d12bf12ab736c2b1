# SPDX-License-Identifier: Apache-2.0
"""Emulated inertial sensors: the simulator's readings as bytes of each protocol, in the sensor's own axes."""

import struct
from collections.abc import Callable
from math import cos, degrees, sin
from typing import Protocol

from shared.config import UserError, nearest
from shared.messages import Imu
from shared.robot import ImuMount

GRAVITY = 9.80665


class ImuEmulator(Protocol):
    """A sensor's end of its line."""

    def receive(self, data: bytes) -> bytes:
        """Handles the driver's bytes. Returns the answer."""

    def measure(self, imu: Imu) -> bytes:
        """Takes a reading of the simulator, in `base`. Returns what a sensor that streams sends of it."""


def in_sensor(imu: Imu, mount: ImuMount) -> tuple[float, float, float, float]:
    """Rate rad/s about the sensor's z axis, and specific force m/s^2 along its axes."""
    c, s = cos(mount.yaw), sin(mount.yaw)
    x, y = c * imu.acceleration_x + s * imu.acceleration_y, c * imu.acceleration_y - s * imu.acceleration_x
    up = -1.0 if mount.upside_down else 1.0
    return up * imu.yaw_rate, x, up * y, up * imu.acceleration_z


class Bno055Emulator:
    """A BNO055 with 128 registers. It measures in mode IMU only, and is in mode CONFIG at first."""

    def __init__(self, mount: ImuMount) -> None:
        self.mount = mount
        self.registers = bytearray(128)
        self.registers[0x00], self.registers[0x3D] = 0xA0, 0x10
        self._buffer = b""

    def receive(self, data: bytes) -> bytes:
        self._buffer += data
        out = b""
        while len(self._buffer) >= 4:
            start, kind, register, length = self._buffer[:4]
            if start != 0xAA or kind > 1:
                self._buffer = self._buffer[1:]
                out += b"\xee\x06"
                continue
            if kind == 1:
                self._buffer = self._buffer[4:]
                fits = length > 0 and register + length <= len(self.registers)
                out += bytes((0xBB, length)) + self.registers[register : register + length] if fits else b"\xee\x04"
            elif len(self._buffer) < 4 + length:
                break
            else:
                values, self._buffer = self._buffer[4 : 4 + length], self._buffer[4 + length :]
                fits = register + length <= len(self.registers)
                if fits:
                    self.registers[register : register + length] = values
                out += b"\xee\x01" if fits else b"\xee\x04"
        return out

    def measure(self, imu: Imu) -> bytes:
        if self.registers[0x3D] & 0x0F == 0x08:
            rate, *force = in_sensor(imu, self.mount)
            struct.pack_into("<3h", self.registers, 0x08, *(round(value * 100) for value in force))
            struct.pack_into("<3h", self.registers, 0x14, 0, 0, round(degrees(rate) * 16))
        return b""


class Bno085Emulator:
    """A BNO085 in mode UART-RVC: two packets a reading of the simulator, as it sends 100 a second."""

    def __init__(self, mount: ImuMount) -> None:
        self.mount = mount
        self.index = 0
        self.yaw = 0.0  # degrees, as its own fusion has it
        self._last: int | None = None

    def receive(self, data: bytes) -> bytes:
        return b""

    def measure(self, imu: Imu) -> bytes:
        rate, *force = in_sensor(imu, self.mount)
        seconds = (imu.stamp - self._last) * 1e-9 if self._last is not None else 0.0
        self._last = imu.stamp
        out = b""
        for _ in range(2):
            self.yaw += degrees(rate) * seconds / 2
            out += self._packet(force)
        return out

    def _packet(self, force: list[float]) -> bytes:
        yaw = (round(self.yaw * 100) + 18000) % 36000 - 18000
        body = struct.pack("<B6h3x", self.index, yaw, 0, 0, *(round(value / GRAVITY * 1000) for value in force))
        self.index = (self.index + 1) % 256
        return b"\xaa\xaa" + body + bytes([sum(body) & 0xFF])


def make_imu_emulator(model: str, mount: ImuMount) -> ImuEmulator:
    """The emulator of a model. Raises UserError where there is none of that name."""
    if model not in MODELS:
        raise UserError(f"there is no emulated inertial sensor {model}", nearest(model, tuple(MODELS)))
    return MODELS[model](mount)


MODELS: dict[str, Callable[[ImuMount], ImuEmulator]] = {"bno055": Bno055Emulator, "bno085": Bno085Emulator}
