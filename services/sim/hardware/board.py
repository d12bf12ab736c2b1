# SPDX-License-Identifier: Apache-2.0
"""Emulates the motion board: decodes the driver's bytes, encodes the board's, with the active faults."""

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
from services.sim.hardware.faults import ActiveFaults, Fault
from shared.drrobot import BOARD, Deframer, Type
from shared.messages import BoardReport

LEFT, RIGHT = 0, 1
SENSOR_PERIOD = 100_000_000  # ns between custom and standard sensor packets; motor sensor packets come with each report
PING_PERIOD = 1_000_000_000  # ns
LOW_BATTERY_V = 5.5  # V of a failed battery
MIN_SONAR_CM = 2  # cm, minimum reading of a working sonar
TEMPERATURE_C = 30.0
I_DEAD_SONAR = 1  # the one that looks ahead


class BoardEmulator:
    """State of the board after the driver's commands. Deterministic: noise on the line comes from `seed`.

    A motor that was disabled has power again with the next velocity command.
    """

    def __init__(self, faults: ActiveFaults, seed: int) -> None:
        self.faults = faults
        self.gains: dict[int, GainsCommand] = {}
        self.n_acknowledged = 0
        self._deframer = Deframer(BOARD)
        self._noise = np.random.default_rng([seed, 7])
        self._speeds = {LEFT: 0, RIGHT: 0}  # counts/s
        self._until: dict[int, int | None] = {LEFT: None, RIGHT: None}  # ns when a channel's command ends
        self._stuck_count: int | None = None  # what the stuck counter shows
        self._sensors_at: int | None = None
        self._pinged_at: int | None = None

    def receive(self, data: bytes, now: int) -> bytes:
        """Handles the driver's bytes at `now` (ns). Returns the board's answer."""
        if Fault.STALLED in self.faults:
            return b""
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
        return self._line_bytes(answer)

    def motors(self, now: int) -> tuple[int, int, int | None]:
        """Counts/s, board's signs, that the left and the right motor are driven with, and for how many ns; None: on."""
        for channel, until in self._until.items():
            if until is not None and now >= until:
                self._speeds[channel], self._until[channel] = 0, None
        left = -self._speeds[LEFT] if Fault.SWAPPED_MOTOR in self.faults else self._speeds[LEFT]
        ends = [until for until in self._until.values() if until is not None]
        return left, self._speeds[RIGHT], min(ends) - now if ends else None

    def report_bytes(self, truth: BoardReport, now: int) -> bytes:
        """What the board sends when it has measured `truth`: each packet when it is due."""
        packets = [self._motor_sensor(truth)]
        if self._sensors_at is None or not 0 <= now - self._sensors_at < SENSOR_PERIOD:
            self._sensors_at = now
            infrared = [float(metres) for metres in truth.infrared] + [np.nan] * 7
            battery = LOW_BATTERY_V if Fault.LOW_BATTERY in self.faults else truth.battery
            sonars = self._sonars(truth)
            packets.append(drrobot.standard_sensor(sonars, infrared[0], battery, TEMPERATURE_C))
            packets.append(drrobot.custom_sensor(tuple(infrared[1:7])))
        if self._pinged_at is None or not 0 <= now - self._pinged_at < PING_PERIOD:
            self._pinged_at = now
            packets.append(drrobot.system(PING))
        return b"".join(self._line_bytes(packet) for packet in packets)

    def _drive(self, order: VelocityCommand, now: int) -> None:
        for channel, speed in order.channels.items():
            if channel in self._speeds and speed != NO_CHANGE:
                self._speeds[channel] = speed
                self._until[channel] = None if order.life is None else now + round(order.life * 1e9)

    def _motor_sensor(self, truth: BoardReport) -> bytes:
        left, speed = truth.left_counts, truth.left_speed
        if Fault.STUCK_ENCODER in self.faults:
            self._stuck_count = left if self._stuck_count is None else self._stuck_count
            left, speed = self._stuck_count, 0.0
        else:
            self._stuck_count = None
        currents = float(truth.currents[LEFT]), float(truth.currents[RIGHT])
        return drrobot.motor_sensor((left, truth.right_counts), (speed, truth.right_speed), currents)

    def _sonars(self, truth: BoardReport) -> tuple[int, ...]:
        """Six readings, cm: those that the robot does not have hear nothing."""
        readings = [NO_ECHO] * 6
        for i, metres in enumerate(truth.ultrasonic[:6]):
            if np.isfinite(metres):
                readings[i] = min(max(round(float(metres) * 100), MIN_SONAR_CM), NO_ECHO)
        if Fault.DEAD_SONAR in self.faults:
            readings[I_DEAD_SONAR] = 0
        return tuple(readings)

    def _line_bytes(self, packet: bytes) -> bytes:
        """What arrives of a packet."""
        if Fault.STALLED in self.faults:
            return b""
        if Fault.GARBAGE in self.faults:
            return self._noise.bytes(len(packet))
        if Fault.HALF_PACKETS in self.faults:
            return packet[: len(packet) // 2]
        if Fault.BAD_CRC in self.faults and packet:
            return packet[:-3] + bytes((packet[-3] ^ 0x10,)) + packet[-2:]
        return packet
