# SPDX-License-Identifier: Apache-2.0
"""Lasers as they sound on their serial line: made from what the simulator measured, in each protocol's own bytes."""

from collections.abc import Callable
from typing import Protocol

from services.sim.hardware.ld06 import Ld06
from services.sim.hardware.rplidar import Rplidar
from services.sim.hardware.scip import Scip
from services.sim.hardware.xv11 import Xv11
from shared.config import Laser, UserError, nearest
from shared.messages import LaserScan

Chunks = list[tuple[int, bytes]]
"""(ns when the last of the bytes leaves, bytes)"""


class LaserEmulator(Protocol):
    """A laser's end of its line. turning: clear it, and the laser stops turning, as that model shows it."""

    turning: bool

    def receive(self, data: bytes, now: int) -> bytes:
        """Takes what the driver says; its answer."""

    def sweep_chunks(self, scan: LaserScan, now: int) -> Chunks:
        """The stream of one sweep, in order. Times lie within the sweep: what is already past leaves at once."""


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
