# SPDX-License-Identifier: Apache-2.0
"""The emulated electronics behind their ports: motion board and laser, with their faults."""

import numpy as np
from pydantic import Field

from services.sim.hardware.board import make_board
from services.sim.hardware.electronics import BodyTruth
from services.sim.hardware.faults import UNPLUGGED_PORTS, ActiveFaults, Fault
from services.sim.hardware.imus import ImuEmulator, make_imu_emulator
from services.sim.hardware.laser_line import LaserLine
from services.sim.hardware.lasers import make_emulator
from shared import topics
from shared.config import Robot, Section
from shared.lasers import lasers_by_topic
from shared.messages import BoardReport, Contacts, Imu, LaserScan, PortState, SerialData
from shared.ports import PortConfig
from shared.service import Out

BOARD, LASER, LASER_2, IMU = "board", "laser", "laser_2", "imu"
"""The ports' names."""


class EmulationConfig(Section):
    """The emulated hardware's ports."""

    board: PortConfig = Field(PortConfig(device="pty:/tmp/zenav-board"), description="where the board is plugged in")
    laser: PortConfig = Field(PortConfig(device="pty:/tmp/zenav-laser"), description="where the laser is plugged in")
    board_model: str = Field(
        "drrobot", description="model of the emulated board, as base_driver.board.model; empty: the base stays messages"
    )
    imu: PortConfig = Field(PortConfig(device="pty:/tmp/zenav-imu"), description="where the inertial sensor is")
    imu_model: str = Field("", description="model of the emulated inertial sensor; empty: `imu` stays a message")
    laser_model: str = Field("", description="model of the emulated laser; empty: the scan stays a message")
    laser_2: PortConfig = Field(
        PortConfig(device="pty:/tmp/zenav-laser-2"), description="where the second laser is plugged in"
    )
    laser_2_model: str = Field("", description="model of the emulated second laser; empty: its scan stays a message")


class Emulation:
    """Bytes in and out of both devices. `board` holds the motor command."""

    def __init__(self, config: EmulationConfig, robot: Robot, seed: int) -> None:
        self.config = config
        self.faults = ActiveFaults()
        self.board = make_board(config.board_model, self.faults, seed, robot) if config.board_model else None
        lines = zip((LASER, LASER_2), (config.laser_model, config.laser_2_model), (8, 14), strict=True)
        self.lasers = {
            name: LaserLine(name, topic, make_emulator(model, laser) if model else None, self.faults, [seed, stream])
            for (name, model, stream), (topic, laser) in zip(lines, lasers_by_topic(robot).items(), strict=False)
        }
        self.imu: ImuEmulator | None = None
        if config.imu_model and robot.imu is not None:
            self.imu = make_imu_emulator(config.imu_model, robot.imu)
        self._imu_noise = np.random.default_rng([seed, 12])  # on the inertial sensor's line
        self._unplugged: set[str] = set()  # ports with an unplugged adapter

    @property
    def ports(self) -> dict[str, PortConfig]:
        """The robot's side of the ports."""
        emulated = (
            (BOARD, self.board, self.config.board),
            (LASER, self.lasers[LASER].emulator, self.config.laser),
            (LASER_2, self.lasers[LASER_2].emulator if LASER_2 in self.lasers else None, self.config.laser_2),
            (IMU, self.imu, self.config.imu),
        )
        return {name: port for name, device, port in emulated if device is not None}

    def receive(self, data: SerialData, now: int) -> Out:
        """Passes a driver's bytes to their device, and sends its answer."""
        if data.port == BOARD and self.board is not None:
            yield from _send(BOARD, self.board.receive(data.data, now), now)
        elif data.port in self.lasers:
            yield from _send(data.port, self.lasers[data.port].receive(data.data, now), now)
        elif data.port == IMU and self.imu is not None:
            received = b"" if Fault.IMU_STALLED in self.faults else data.data
            yield from _send(IMU, self._imu_line_bytes(self.imu.receive(received)), now)

    def send_body(self, imu: Imu | None, contacts: Contacts | None, now: int) -> Out:
        """Sends the inertial sensor's bytes, and as messages what neither it nor the board carries."""
        if imu is not None and self.imu is not None:
            yield from _send(IMU, self._imu_line_bytes(self.imu.measure(imu)), now)
        elif imu is not None and not (self.board is not None and self.board.electronics.HAS_GYRO):
            yield topics.IMU(imu)
        if contacts is not None and not (self.board is not None and self.board.electronics.HAS_CONTACTS):
            yield topics.CONTACTS(contacts)

    def _imu_line_bytes(self, data: bytes) -> bytes:
        """What arrives of what the inertial sensor says."""
        if Fault.IMU_STALLED in self.faults:
            return b""
        return self._imu_noise.bytes(len(data)) if Fault.IMU_GARBAGE in self.faults else data

    def send_report(self, report: BoardReport, imu: Imu | None, contacts: Contacts, now: int) -> Out:
        """What the board says of a report, of its contacts, and of its gyro where that is the inertial sensor."""
        rate = imu.yaw_rate if imu is not None and self.imu is None else None
        body = BodyTruth(rate, contacts.bumpers, contacts.cliffs, contacts.estop)
        if self.board is not None:
            yield from _send(BOARD, self.board.report_bytes(report, now, body), now)

    def send_sweeps(self, scans: list[LaserScan], scans_2: list[LaserScan], now: int) -> Out:
        """Sends the lasers' bytes that are due, and queues those of these sweeps; without a model, sends the scans."""
        for line, sweeps in zip(self.lasers.values(), (scans, scans_2), strict=False):
            yield from line.messages(sweeps)
            yield from _send(line.name, line.sweep_bytes(sweeps, now), now)

    def update_plugs(self, now: int) -> Out:
        """Faults end when their time is over; adapters are pulled out and plugged in."""
        self.faults.expire(now)
        unplugged = {port for fault, port in UNPLUGGED_PORTS.items() if fault in self.faults and port in self.ports}
        for port in sorted(unplugged ^ self._unplugged):
            yield topics.PLUG(PortState(now, port, port not in unplugged, ""))
        self._unplugged = unplugged


def _send(port: str, data: bytes, now: int) -> Out:
    if data:
        yield topics.TX(SerialData(now, port, data))
