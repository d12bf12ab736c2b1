# SPDX-License-Identifier: Apache-2.0
"""Emulated lasers: the simulator's sweeps as bytes of each protocol."""

from collections.abc import Callable
from typing import Protocol

from services.sim.hardware.ld06 import LD08_SAMPLES, Ld06Emulator
from services.sim.hardware.rplidar import RplidarEmulator
from services.sim.hardware.scip import ScipEmulator
from services.sim.hardware.xv11 import Xv11Emulator
from services.sim.hardware.ydlidar import YdlidarEmulator
from shared.config import Laser, UserError, nearest
from shared.messages import LaserScan

Chunks = list[tuple[int, bytes]]
"""(ns when the last of the bytes leaves, bytes)"""


class LaserEmulator(Protocol):
    """A laser's end of its line. turning: clear it, and the laser stops turning, as that model shows it."""

    turning: bool

    def receive(self, data: bytes, now: int) -> bytes:
        """Handles the driver's bytes at `now` (ns). Returns the answer."""

    def sweep_chunks(self, scan: LaserScan, now: int) -> Chunks:
        """The bytes of one sweep, in order, with times within the sweep. Bytes of the past are sent at once."""


def make_emulator(model: str, laser: Laser) -> LaserEmulator:
    """The emulator of a model. Raises UserError where there is none of that name."""
    if model not in MODELS:
        raise UserError(f"there is no emulated laser {model}", nearest(model, tuple(MODELS)))
    return MODELS[model](laser)


MODELS: dict[str, Callable[[Laser], LaserEmulator]] = {
    "ld06": Ld06Emulator,
    "ld08": lambda laser: Ld06Emulator(laser, LD08_SAMPLES),
    "ld14": lambda laser: Ld06Emulator(laser, samples=2304, baud=115200),
    "stl27l": lambda laser: Ld06Emulator(laser, samples=21600, baud=921600),
    "rplidar": lambda laser: RplidarEmulator(laser, model=0x18),
    "rplidar_a2": lambda laser: RplidarEmulator(laser, model=0x28),  # scans in express mode
    "rplidar_c1": lambda laser: RplidarEmulator(laser, model=0x41, baud=460800),
    "rplidar_s1": lambda laser: RplidarEmulator(laser, model=0x61, baud=256000),
    "rplidar_s2": lambda laser: RplidarEmulator(laser, model=0x71, baud=1000000),  # an S3 speaks as it does
    "scip": ScipEmulator,
    "xv11": Xv11Emulator,
    "ydlidar_x2": lambda laser: YdlidarEmulator(laser, samples=3000, baud=115200, answers=False),
    "ydlidar_x4": lambda laser: YdlidarEmulator(laser, samples=5000, baud=128000),
    "ydlidar_g2": lambda laser: YdlidarEmulator(laser, samples=5000, baud=230400, intensity=True),
}
