# SPDX-License-Identifier: Apache-2.0
"""The emulated electronics behind their ports: motion board and laser, with their faults."""

import numpy as np
from pydantic import Field

from services.sim.hardware.board import make_board
from services.sim.hardware.electronics import BodyTruth
from services.sim.hardware.faults import LASER_FAULTS, UNPLUGGED_PORTS, ActiveFaults, Fault
from services.sim.hardware.imus import ImuEmulator, make_imu_emulator
from services.sim.hardware.lasers import LaserEmulator, make_emulator
from shared import topics
from shared.config import Robot, Section
from shared.messages import BoardReport, Contacts, Imu, LaserScan, PortState, SerialData
from shared.ports import PortConfig
from shared.service import Out

BOARD, LASER, IMU = "board", "laser", "imu"
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


class Emulation:
    """Bytes in and out of both devices. `board` holds the motor command."""

    def __init__(self, config: EmulationConfig, robot: Robot, seed: int) -> None:
        self.config = config
        self.faults = ActiveFaults()
        self.board = make_board(config.board_model, self.faults, seed, robot) if config.board_model else None
        self.laser: LaserEmulator | None = (
            make_emulator(config.laser_model, robot.laser) if config.laser_model else None
        )
        self.imu: ImuEmulator | None = None
        if config.imu_model and robot.imu is not None:
            self.imu = make_imu_emulator(config.imu_model, robot.imu)
        self._imu_noise = np.random.default_rng([seed, 12])  # on the inertial sensor's line
        self._noise = np.random.default_rng([seed, 8])  # on the laser's line
        self._queue: list[tuple[int, bytes]] = []  # bytes that the laser sends later, and when (ns)
        self._unplugged: set[str] = set()  # ports with an unplugged adapter

    @property
    def ports(self) -> dict[str, PortConfig]:
        """The robot's side of the ports."""
        emulated = (
            (BOARD, self.board, self.config.board),
            (LASER, self.laser, self.config.laser),
            (IMU, self.imu, self.config.imu),
        )
        return {name: port for name, device, port in emulated if device is not None}

    def receive(self, data: SerialData, now: int) -> Out:
        """Passes a driver's bytes to their device, and sends its answer."""
        if data.port == BOARD and self.board is not None:
            yield from _send(BOARD, self.board.receive(data.data, now), now)
        elif data.port == LASER and self.laser is not None:
            received = b"" if Fault.LASER_STALLED in self.faults else data.data
            yield from _send(LASER, self._laser_line_bytes(self.laser.receive(received, now)), now)
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

    def send_sweeps(self, scans: list[LaserScan], now: int) -> Out:
        """Sends the laser's bytes that are due, and queues those of these sweeps; without a model, sends the scans."""
        if self.laser is None:
            if not any(fault in self.faults for fault in LASER_FAULTS):
                yield from (topics.SCAN(scan) for scan in scans)
            return
        self.laser.turning = Fault.LASER_STOPPED not in self.faults
        self._queue += [chunk for scan in scans for chunk in self.laser.sweep_chunks(scan, now)]
        due = [data for when, data in self._queue if when <= now]
        self._queue = [(when, data) for when, data in self._queue if now < when <= now + 1_000_000_000]
        yield from _send(LASER, self._laser_line_bytes(b"".join(due)), now)

    def update_plugs(self, now: int) -> Out:
        """Faults end when their time is over; adapters are pulled out and plugged in."""
        self.faults.expire(now)
        unplugged = {port for fault, port in UNPLUGGED_PORTS.items() if fault in self.faults and port in self.ports}
        for port in sorted(unplugged ^ self._unplugged):
            yield topics.PLUG(PortState(now, port, port not in unplugged, ""))
        self._unplugged = unplugged

    def _laser_line_bytes(self, data: bytes) -> bytes:
        """What arrives of what the laser says."""
        if Fault.LASER_STALLED in self.faults:
            return b""
        return self._noise.bytes(len(data)) if Fault.LASER_GARBAGE in self.faults else data


def _send(port: str, data: bytes, now: int) -> Out:
    if data:
        yield topics.TX(SerialData(now, port, data))
