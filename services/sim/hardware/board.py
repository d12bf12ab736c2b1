# SPDX-License-Identifier: Apache-2.0
"""Emulates a motion board behind its line, with the active faults of motors, encoders, battery and line."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from services.sim.hardware.create2 import Create2Electronics
from services.sim.hardware.drrobot_board import DrRobotElectronics
from services.sim.hardware.electronics import BoardElectronics, BodyTruth
from services.sim.hardware.faults import ActiveFaults, Fault
from services.sim.hardware.kobuki import KobukiElectronics
from services.sim.hardware.odrive import OdriveElectronics
from services.sim.hardware.roboclaw import RoboclawElectronics
from services.sim.hardware.ros_arduino_bridge import RosArduinoBridgeElectronics
from services.sim.hardware.velocity import VelocityElectronics
from shared.config import Robot, UserError, nearest
from shared.messages import BoardReport

LOW_BATTERY_V = 5.5  # V of a failed battery
NO_BODY_SENSORS = BodyTruth()


class BoardEmulator:
    """A board with its faults. Deterministic: noise on the line comes from `seed`."""

    def __init__(self, faults: ActiveFaults, seed: int, electronics: BoardElectronics) -> None:
        self.faults, self.electronics = faults, electronics
        self._noise = np.random.default_rng([seed, 7])
        self._stuck_count: int | None = None  # what the stuck counter shows

    def receive(self, data: bytes, now: int) -> bytes:
        """Handles the driver's bytes at `now` (ns). Returns the board's answer."""
        if Fault.STALLED in self.faults:
            return b""
        return self._line_bytes(self.electronics.receive(data, now))

    def motors(self, now: int) -> tuple[float, float, int | None]:
        """Counts/s, board's signs, that the left and the right motor are driven with, and for how many ns; None: on."""
        left, right, life = self.electronics.speeds(now)
        return -left if Fault.SWAPPED_MOTOR in self.faults else left, right, life

    def report_bytes(self, truth: BoardReport, now: int, body: BodyTruth = NO_BODY_SENSORS) -> bytes:
        """What the board sends when it has measured `truth` and `body`: each packet when it is due."""
        packets = self.electronics.packets(self._measured(truth), body, now)
        return b"".join(self._line_bytes(packet) for packet in packets)

    def _measured(self, truth: BoardReport) -> BoardReport:
        """The truth with the faults of encoder and battery."""
        if Fault.STUCK_ENCODER in self.faults:
            self._stuck_count = truth.left_counts if self._stuck_count is None else self._stuck_count
            truth = replace(truth, left_counts=self._stuck_count, left_speed=0.0)
        else:
            self._stuck_count = None
        return replace(truth, battery=LOW_BATTERY_V) if Fault.LOW_BATTERY in self.faults else truth

    def _line_bytes(self, packet: bytes) -> bytes:
        """What arrives of a packet."""
        if Fault.STALLED in self.faults:
            return b""
        if Fault.GARBAGE in self.faults:
            return self._noise.bytes(len(packet))
        if Fault.HALF_PACKETS in self.faults:
            return packet[: len(packet) // 2]
        if Fault.BAD_CRC in self.faults and packet:
            i = max(len(packet) - 3, 0)
            return packet[:i] + bytes((packet[i] ^ 0x10,)) + packet[i + 1 :]
        return packet


def make_board(model: str, faults: ActiveFaults, seed: int, robot: Robot) -> BoardEmulator:
    """The emulator of a model. Raises UserError where there is none of that name."""
    if model not in BOARD_MODELS:
        raise UserError(f"there is no emulated board {model}", nearest(model, tuple(BOARD_MODELS)))
    return BoardEmulator(faults, seed, BOARD_MODELS[model](faults, robot))


BOARD_MODELS: dict[str, Callable[[ActiveFaults, Robot], BoardElectronics]] = {
    "drrobot": lambda faults, robot: DrRobotElectronics(faults),
    "velocity": lambda faults, robot: VelocityElectronics(robot),
    "kobuki": lambda faults, robot: KobukiElectronics(robot),
    "create2": lambda faults, robot: Create2Electronics(robot),
    "ros_arduino_bridge": lambda faults, robot: RosArduinoBridgeElectronics(robot),
    "roboclaw": lambda faults, robot: RoboclawElectronics(robot),
    "odrive": lambda faults, robot: OdriveElectronics(robot),
}
