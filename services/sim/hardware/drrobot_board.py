# SPDX-License-Identifier: Apache-2.0
"""The emulated DrRobot board: decodes the driver's packets, and encodes its sensors' at their rates."""

from typing import ClassVar

import numpy as np

from services.sim.hardware import drrobot
from services.sim.hardware.drrobot import (
    ACKNOWLEDGE,
    NO_CHANGE,
    NO_ECHO,
    PING,
    DisableCommand,
    GainsCommand,
    VelocityCommand,
)
from services.sim.hardware.electronics import BodyTruth
from services.sim.hardware.faults import ActiveFaults, Fault
from shared.drrobot import BOARD, Deframer, Type
from shared.messages import BoardReport

LEFT, RIGHT = 0, 1
SENSOR_PERIOD = 100_000_000  # ns between custom and standard sensor packets; motor sensor packets come with each report
PING_PERIOD = 1_000_000_000  # ns
MIN_SONAR_CM = 2  # cm, minimum reading of a working sonar
TEMPERATURE_C = 30.0
I_DEAD_SONAR = 1  # the one that looks ahead


class DrRobotElectronics:
    """State of the board after the driver's commands.

    A motor that was disabled has power again with the next velocity command.
    """

    HAS_GYRO: ClassVar[bool] = False
    HAS_CONTACTS: ClassVar[bool] = False

    def __init__(self, faults: ActiveFaults) -> None:
        self.faults = faults
        self.gains: dict[int, GainsCommand] = {}
        self.n_acknowledged = 0
        self._deframer = Deframer(BOARD)
        self._speeds = {LEFT: 0, RIGHT: 0}  # counts/s
        self._until: dict[int, int | None] = {LEFT: None, RIGHT: None}  # ns when a channel's command ends
        self._sensors_at: int | None = None
        self._pinged_at: int | None = None

    def receive(self, data: bytes, now: int) -> bytes:
        answer = b""
        for packet in self._deframer.packets(data):
            if packet.type == Type.SYSTEM:
                self.n_acknowledged += 1
                continue
            order = drrobot.decode_command(packet)
            if isinstance(order, VelocityCommand):
                self._drive(order, now)
            elif isinstance(order, GainsCommand):
                self.gains[order.channel] = order
                answer += drrobot.system(ACKNOWLEDGE)
            elif isinstance(order, DisableCommand) and order.channel in self._speeds:
                self._speeds[order.channel] = 0
                answer += drrobot.system(ACKNOWLEDGE)
        return answer

    def speeds(self, now: int) -> tuple[float, float, int | None]:
        for channel, until in self._until.items():
            if until is not None and now >= until:
                self._speeds[channel], self._until[channel] = 0, None
        ends = [until for until in self._until.values() if until is not None]
        return self._speeds[LEFT], self._speeds[RIGHT], min(ends) - now if ends else None

    def packets(self, truth: BoardReport, body: BodyTruth, now: int) -> list[bytes]:
        packets = [self._motor_sensor(truth)]
        if self._sensors_at is None or not 0 <= now - self._sensors_at < SENSOR_PERIOD:
            self._sensors_at = now
            infrared = [float(metres) for metres in truth.infrared] + [np.nan] * 7
            packets.append(drrobot.standard_sensor(self._sonars(truth), infrared[0], truth.battery, TEMPERATURE_C))
            packets.append(drrobot.custom_sensor(tuple(infrared[1:7])))
        if self._pinged_at is None or not 0 <= now - self._pinged_at < PING_PERIOD:
            self._pinged_at = now
            packets.append(drrobot.system(PING))
        return packets

    def _drive(self, order: VelocityCommand, now: int) -> None:
        for channel, speed in order.channels.items():
            if channel in self._speeds and speed != NO_CHANGE:
                self._speeds[channel] = speed
                self._until[channel] = None if order.life is None else now + round(order.life * 1e9)

    def _motor_sensor(self, truth: BoardReport) -> bytes:
        currents = float(truth.currents[LEFT]), float(truth.currents[RIGHT])
        counts, speeds = (truth.left_counts, truth.right_counts), (truth.left_speed, truth.right_speed)
        return drrobot.motor_sensor(counts, speeds, currents)

    def _sonars(self, truth: BoardReport) -> tuple[int, ...]:
        """Six readings, cm: those that the robot does not have hear nothing."""
        readings = [NO_ECHO] * 6
        for i, metres in enumerate(truth.ultrasonic[:6]):
            if np.isfinite(metres):
                readings[i] = min(max(round(float(metres) * 100), MIN_SONAR_CM), NO_ECHO)
        if Fault.DEAD_SONAR in self.faults:
            readings[I_DEAD_SONAR] = 0
        return tuple(readings)
