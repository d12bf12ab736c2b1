# SPDX-License-Identifier: Apache-2.0
"""Which laser's bytes the simulator speaks."""

from typing import Protocol

from shared.config import Laser, UserError
from shared.messages import LaserScan


class LaserEmulator(Protocol):
    """A laser behind a port."""

    def received(self, data: bytes, now: int) -> bytes:
        """The answer to what the driver wrote."""

    def swept(self, scan: LaserScan, now: int) -> list[tuple[int, bytes]]:
        """The bytes that tell a sweep, in pieces, each with the time (ns) when it leaves."""


def emulator(model: str, laser: Laser) -> LaserEmulator:
    """The emulator of a model. Raises UserError where there is none of that name."""
    raise UserError(f"there is no emulated laser {model}", "leave sim.laser_model empty: the scan stays a message")
