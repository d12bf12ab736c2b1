# SPDX-License-Identifier: Apache-2.0
"""The simulated robot's electronics behind their ports: a motion board, a laser, and whatever is broken of them."""

import numpy as np
from pydantic import Field

from services.sim.hardware.board import BoardEmulator
from services.sim.hardware.faults import OF_LASER, UNPLUGS, Fault, Faults
from services.sim.hardware.lasers import LaserEmulator, emulator
from shared import topics
from shared.config import Robot, Section
from shared.messages import BoardReport, LaserScan, PortState, SerialData
from shared.ports import PortConfig
from shared.service import Out

BOARD, LASER = "board", "laser"
"""The ports' names."""


class EmulationConfig(Section):
    """The emulated hardware's ports."""

    board: PortConfig = Field(PortConfig(device="pty:/tmp/zenav-board"), description="where the board is plugged in")
    laser: PortConfig = Field(PortConfig(device="pty:/tmp/zenav-laser"), description="where the laser is plugged in")
    laser_model: str = Field("", description="whose bytes the laser speaks; empty: the scan stays a message")


class Emulation:
    """Bytes in and out of both devices. `board` holds what the motors were told."""

    def __init__(self, config: EmulationConfig, robot: Robot, seed: int) -> None:
        self.config = config
        self.faults = Faults()
        self.board = BoardEmulator(self.faults, seed)
        self.laser: LaserEmulator | None = emulator(config.laser_model, robot.laser) if config.laser_model else None
        self._noise = np.random.default_rng([seed, 8])  # on the laser's line
        self._leaving: list[tuple[int, bytes]] = []  # what the laser will say, ns when
        self._away: set[str] = set()  # ports that are pulled out

    @property
    def ports(self) -> dict[str, PortConfig]:
        """The robot's side of the ports."""
        return {BOARD: self.config.board, **({LASER: self.config.laser} if self.laser is not None else {})}

    def receive(self, data: SerialData, now: int) -> Out:
        """What a driver wrote, and the device's answer."""
        if data.port == BOARD:
            yield from _said(BOARD, self.board.receive(data.data, now), now)
        elif data.port == LASER and self.laser is not None:
            heard = b"" if Fault.LASER_STALLED in self.faults else data.data
            yield from _said(LASER, self._on_the_lasers_line(self.laser.receive(heard, now)), now)

    def measured(self, report: BoardReport, now: int) -> Out:
        """What the board says of a report."""
        yield from _said(BOARD, self.board.reported(report, now), now)

    def sweep_chunks(self, scans: list[LaserScan], now: int) -> Out:
        """What the laser says by now, and of these sweeps soon; the scans themselves where it speaks in messages."""
        if self.laser is None:
            if not any(fault in self.faults for fault in OF_LASER):
                yield from (topics.SCAN(scan) for scan in scans)
            return
        self.laser.turning = Fault.LASER_STOPPED not in self.faults
        self._leaving += [chunk for scan in scans for chunk in self.laser.sweep_chunks(scan, now)]
        due = [data for when, data in self._leaving if when <= now]
        self._leaving = [(when, data) for when, data in self._leaving if now < when <= now + 1_000_000_000]
        yield from _said(LASER, self._on_the_lasers_line(b"".join(due)), now)

    def plugs(self, now: int) -> Out:
        """Faults end when their time is over; adapters are pulled out and plugged in."""
        self.faults.pass_to(now)
        away = {port for fault, port in UNPLUGS.items() if fault in self.faults and port in self.ports}
        for port in sorted(away ^ self._away):
            yield topics.PLUG(PortState(now, port, port not in away, ""))
        self._away = away

    def _on_the_lasers_line(self, data: bytes) -> bytes:
        """What arrives of what the laser says."""
        if Fault.LASER_STALLED in self.faults:
            return b""
        return self._noise.bytes(len(data)) if Fault.LASER_GARBAGE in self.faults else data


def _said(port: str, data: bytes, now: int) -> Out:
    if data:
        yield topics.TX(SerialData(now, port, data))
