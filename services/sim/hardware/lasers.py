# SPDX-License-Identifier: Apache-2.0
"""Lasers as they sound on their serial line: made from what the simulator measured, in each protocol's own bytes."""

from collections.abc import Callable
from typing import Protocol

import numpy as np
from pydantic import Field

from services.sim.hardware.ld06 import Ld06
from services.sim.hardware.rplidar import Rplidar
from services.sim.hardware.scip import Scip
from services.sim.hardware.xv11 import Xv11
from shared.config import Laser, Section, UserError, nearest
from shared.messages import LaserScan

Chunks = list[tuple[int, bytes]]
"""(ns when the last of the bytes leaves, bytes)"""


class LaserEmulator(Protocol):
    """A laser's end of its line. turning: clear it, and the laser stops turning, as that model shows it."""

    turning: bool

    def received(self, data: bytes, now: int) -> bytes:
        """Takes what the driver says; its answer."""

    def swept(self, scan: LaserScan, now: int) -> Chunks:
        """The stream of one sweep, in order. Times lie within the sweep: what is already past leaves at once."""


class LineFaults(Section):
    """What goes wrong on a line, as shares of the chunks (a packet or an answer each)."""

    garbage: float = Field(0.0, ge=0, le=1, description="share before which random bytes come")
    half: float = Field(0.0, ge=0, le=1, description="share that breaks off in the middle")
    bad_sum: float = Field(0.0, ge=0, le=1, description="share with one wrong bit")


class Faulty:
    """A laser behind a bad line."""

    def __init__(self, laser: LaserEmulator, faults: LineFaults, seed: int) -> None:
        self.laser, self.faults = laser, faults
        self.rng = np.random.default_rng(seed)

    @property
    def turning(self) -> bool:
        return self.laser.turning

    @turning.setter
    def turning(self, turning: bool) -> None:
        self.laser.turning = turning

    def received(self, data: bytes, now: int) -> bytes:
        return self.laser.received(data, now)

    def swept(self, scan: LaserScan, now: int) -> Chunks:
        return [(at, self._spoiled(data)) for at, data in self.laser.swept(scan, now)]

    def _spoiled(self, data: bytes) -> bytes:
        faults, draws = self.faults, self.rng.random(3)
        if draws[0] < faults.half:
            data = data[: len(data) // 2]
        if draws[1] < faults.bad_sum and data:
            wrong = bytearray(data)
            wrong[int(self.rng.integers(len(data)))] ^= 1 << int(self.rng.integers(8))
            data = bytes(wrong)
        if draws[2] < faults.garbage:
            data = self.rng.bytes(int(self.rng.integers(1, 60))) + data
        return data


def emulator(model: str, laser: Laser) -> LaserEmulator:
    """The emulator of a model. Raises UserError where there is none of that name."""
    if model not in MODELS:
        raise UserError(f"there is no emulated laser {model}", nearest(model, tuple(MODELS)))
    return MODELS[model](laser)


MODELS: dict[str, Callable[[Laser], LaserEmulator]] = {
    "ld06": Ld06,
    "rplidar": lambda laser: Rplidar(laser, model=0x18),
    "rplidar_a2": lambda laser: Rplidar(laser, model=0x28),  # scans in express mode
    "scip": Scip,
    "xv11": Xv11,
}
