# SPDX-License-Identifier: Apache-2.0
"""The DrRobot board of the X80SV: gains and commands to packets, packets to reports."""

from math import nan

import numpy as np

from services.base_driver import drrobot
from services.base_driver.boards.board_config import SerialBoardConfig
from services.base_driver.boards.device import BoardInput
from services.base_driver.drrobot import BoardMessage, CustomSensor, MotorSensor, StandardSensor, System
from shared.board_framing import LineCounts
from shared.config import Robot
from shared.drrobot import PC, Deframer, Type
from shared.messages import BoardReport

LEFT, RIGHT = 0, 1  # the wheels' channels
NO_ECHO_CM = 255
N_DEAD_SONAR_PACKETS = 2  # packets in a row with a reading of 0 cm; a working sonar never reads 0


class DrRobotBoard:
    """Encodes wheel commands and decodes the board's packets. Bytes in, bytes out."""

    starts_again = False  # it reports by itself, and gets its gains with the first report after silence

    def __init__(self, config: SerialBoardConfig, robot: Robot) -> None:
        self.config = config
        self.fault = ""
        kinds = [sensor.kind for sensor in robot.ranges]
        self.n_ultrasonic = kinds.count("ultrasonic")  # may be more than the board has
        self.n_infrared = kinds.count("infrared")
        self.deframer = Deframer(PC)
        self.standard: StandardSensor | None = None
        self.custom: CustomSensor | None = None
        self._last_at: dict[type, int] = {}  # ns when a packet of a class came last
        self._first_at: int | None = None  # ns of the first bytes since the port opened
        self._n_zeros = np.zeros(drrobot.N_CHANNELS, np.int64)  # in a row, by sonar

    @property
    def counts(self) -> LineCounts:
        line = self.deframer
        return LineCounts(line.n_good, line.n_bad_crc, line.n_resyncs, line.n_skipped)

    @property
    def supplies(self) -> tuple[float, ...]:
        s = self.standard
        if s is None:
            return (nan,) * 6
        return s.board_supply, s.motor_supply, s.servo_supply, *s.motor_temperatures, s.temperature

    def warm_up(self) -> None:
        Deframer(PC).packets(drrobot.acknowledgement())

    def forget(self) -> None:
        self.deframer.forget()
        self._last_at.clear()
        self._first_at = None
        self._n_zeros[:] = 0

    def start_command(self) -> bytes:
        """Bytes that set the gains of both wheels and command zero."""
        config = self.config
        gains = [drrobot.set_gains("velocity", wheel, config.kp, config.kd, config.ki) for wheel in (LEFT, RIGHT)]
        return b"".join(gains) + self._velocity(0.0, 0.0)

    def receive(self, data: bytes, stamp: int, now: int) -> BoardInput:
        """The newest report in these bytes, and the bytes to answer.

        Of several reports only the last is used: the counts continue, and all would have the same stamp.
        """
        packets = self.deframer.packets(data)
        self._first_at = now if self._first_at is None else self._first_at
        received = BoardInput()
        motors: MotorSensor | None = None
        for packet in packets:
            message = drrobot.decode(packet)
            if isinstance(message, System):
                received.answer = drrobot.acknowledgement()  # one for all of them
                received.ends_with_answer = motors is not None
            elif isinstance(message, MotorSensor):
                received.n_reports += 1
                received.ends_with_answer = False
                motors = message
            else:
                self._store(message, now)
        received.report = self._report(motors, stamp, now) if motors is not None else None
        return received

    def command(self, left: float, right: float, now: int) -> bytes:
        return self._velocity(left, right)

    def _velocity(self, left: float, right: float) -> bytes:
        return drrobot.command_all(Type.VELOCITY_ALL, left, right, round(self.config.command_life * 1e3))

    def stop_command(self) -> bytes:
        return self._velocity(0.0, 0.0) + drrobot.disable_motor(LEFT) + drrobot.disable_motor(RIGHT)

    def dead_sensors(self, now: int) -> str:
        since = now - (now if self._first_at is None else self._first_at)
        has_waited = since > self.config.sensors_silent * 1e9
        sonar = has_waited and not self._is_recent(StandardSensor, now)
        zero = [
            str(i)
            for i in range(min(self.n_ultrasonic, drrobot.N_CHANNELS))
            if self._n_zeros[i] >= N_DEAD_SONAR_PACKETS
        ]
        infrared = has_waited and not self._is_recent(CustomSensor, now)
        parts = (
            "the board sends no ultrasonic ranges" if self.n_ultrasonic and sonar else "",
            f"ultrasonic {' and '.join(zero)} does not answer" if zero and not sonar else "",
            "the board sends no infrared ranges" if self.n_infrared > 1 and infrared else "",
        )
        return ", ".join(part for part in parts if part)

    def _store(self, message: BoardMessage | None, now: int) -> None:
        if isinstance(message, StandardSensor):
            self.standard = message
            self._n_zeros = np.where(np.array(message.ultrasonic) == 0, self._n_zeros + 1, 0)
        elif isinstance(message, CustomSensor):
            self.custom = message
        if message is not None:
            self._last_at[type(message)] = now

    def _report(self, motors: MotorSensor, stamp: int, now: int) -> BoardReport:
        standard = self.standard if self._is_recent(StandardSensor, now) else None
        custom = self.custom if self._is_recent(CustomSensor, now) else None
        centimetres = np.array(standard.ultrasonic if standard else [NO_ECHO_CM] * 6, np.float32)
        ultrasonic = np.where(centimetres < NO_ECHO_CM, centimetres / 100, np.nan).astype(np.float32)
        infrared = (standard.infrared if standard else nan, *(custom.infrared if custom else (nan,) * 6))
        return BoardReport(
            stamp=stamp,
            left_counts=motors.counts[LEFT],
            right_counts=motors.counts[RIGHT],
            left_speed=float(motors.speeds[LEFT]),
            right_speed=float(motors.speeds[RIGHT]),
            ultrasonic=ultrasonic[: self.n_ultrasonic],
            infrared=np.array(infrared[: self.n_infrared], np.float32),
            battery=standard.motor_supply if standard else nan,
            currents=np.array(motors.currents[:2], np.float32),
        )

    def _is_recent(self, kind: type, now: int) -> bool:
        """Whether a packet of this class arrived within `sensors_silent`."""
        return kind in self._last_at and 0 <= now - self._last_at[kind] <= self.config.sensors_silent * 1e9
