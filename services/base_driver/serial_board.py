# SPDX-License-Identifier: Apache-2.0
"""The motion board on a port: packets to reports, commands to bytes, state of the line."""

from math import nan

import numpy as np
from pydantic import Field

from services.base_driver import drrobot
from services.base_driver.drrobot import BoardMessage, CustomSensor, MotorSensor, StandardSensor, System
from shared.config import Robot, Section
from shared.drrobot import PC, Deframer, Type
from shared.messages import BoardReport, BoardStatus, PortState, SerialData

LEFT, RIGHT = 0, 1  # the wheels' channels
NO_ECHO_CM = 255
N_DEAD_SONAR_PACKETS = 2  # packets in a row with a reading of 0 cm; a working sonar never reads 0


class SerialBoardConfig(Section):
    """The DrRobot board, where `port` has a device."""

    kp: int = Field(15, ge=0, le=32767, description="velocity gain; an X80SV is shaky at 20, hardly stable at 25")
    ki: int = Field(0, ge=0, le=32767, description="velocity gain")
    kd: int = Field(0, ge=0, le=32767, description="velocity gain")
    command_life: float = Field(0.2, ge=0.05, le=5, description="lifetime of a command on the board, s")
    sensors_silent: float = Field(
        0.5, gt=0.05, le=10, description="s without its packet after which a range sensor is dead"
    )
    latency: float = Field(
        0.0,
        ge=0,
        le=0.2,
        description="s from the board's measurement to the reading of its bytes; subtracted from stamps",
    )


class SerialBoard:
    """Encodes wheel commands and decodes the board's packets. Bytes in, bytes out.

    silent: s without a report after which the board may have restarted: it gets its gains again.
    """

    def __init__(self, config: SerialBoardConfig, robot: Robot, silent: float) -> None:
        self.config, self.silent = config, round(silent * 1e9)
        kinds = [sensor.kind for sensor in robot.ranges]
        self.n_ultrasonic, self.n_infrared = kinds.count("ultrasonic"), kinds.count("infrared")
        self.open, self.detail = False, "its port has not been opened yet"
        self.deframer = Deframer(PC)
        self.standard: StandardSensor | None = None
        self.custom: CustomSensor | None = None
        self._last_at: dict[str, int] = {}  # ns when bytes, a packet, a bad CRC, or a packet of a class came last
        self._n_zeros = np.zeros(drrobot.N_CHANNELS, np.int64)  # in a row, by sonar
        self._n_reports = self._n_reports_at_status = 0
        self._status_at = 0

    def warm_up(self) -> None:
        """Compiles the kernels."""
        Deframer(PC).packets(drrobot.acknowledgement())

    def update_port(self, state: PortState) -> bytes:
        """Handles a port that opened or closed: drops earlier bytes, and returns the bytes to send now."""
        opened = state.open and not self.open
        self.open, self.detail = state.open, state.detail
        self.deframer.forget()
        self._last_at.clear()
        self._n_zeros[:] = 0
        return self._start_bytes() if opened else b""

    def receive(self, data: SerialData, now: int) -> tuple[BoardReport | None, bytes]:
        """The newest report in these bytes or None, and the bytes to answer.

        Of several reports only the last is used: the counts continue, and all would have the same stamp.
        """
        n_bad = self.deframer.n_bad_crc
        packets = self.deframer.packets(data.data)
        self._record_time("bytes", now)
        if self.deframer.n_bad_crc > n_bad:
            self._record_time("crc", now)
        motors: MotorSensor | None = None
        answer = b""
        for packet in packets:
            self._record_time("packet", now)
            message = drrobot.decode(packet)
            if isinstance(message, System):
                answer = drrobot.acknowledgement()  # one for all of them
            elif isinstance(message, MotorSensor):
                if not self._is_recent("MotorSensor", now):
                    answer = self._start_bytes() + answer
                self._record_time("MotorSensor", now)
                self._n_reports += 1
                motors = message
            else:
                self._store(message, now)
        return self._report(motors, data.stamp, now) if motors is not None else None, answer

    def command(self, left: float, right: float) -> bytes:
        """Bytes that command the wheels' speeds, counts/s with the board's signs, for `command_life`."""
        return drrobot.command_all(Type.VELOCITY_ALL, left, right, round(self.config.command_life * 1e3))

    def stop_bytes(self) -> bytes:
        """Bytes that stop both wheels and switch off their power."""
        return self.command(0.0, 0.0) + drrobot.disable_motor(LEFT) + drrobot.disable_motor(RIGHT)

    def dead_sensors(self, now: int) -> str:
        """Text of the range sensors that do not answer; empty if all do, or if the whole board is silent."""
        if not self._is_recent("MotorSensor", now):
            return ""
        since = now - self._last_at.get("first", now)
        has_waited = since > self.config.sensors_silent * 1e9
        sonar = has_waited and not self._is_recent("StandardSensor", now, self.config.sensors_silent)
        zero = [str(i) for i in range(self.n_ultrasonic) if self._n_zeros[i] >= N_DEAD_SONAR_PACKETS]
        infrared = has_waited and not self._is_recent("CustomSensor", now, self.config.sensors_silent)
        parts = (
            "the board sends no ultrasonic ranges" if self.n_ultrasonic and sonar else "",
            f"ultrasonic {' and '.join(zero)} does not answer" if zero and not sonar else "",
            "the board sends no infrared ranges" if self.n_infrared > 1 and infrared else "",
        )
        return ", ".join(part for part in parts if part)

    def silence_cause(self, now: int) -> str:
        """Text of the cause why no report arrives."""
        if not self.open:
            return self.detail
        if not self._is_recent("bytes", now):
            return "no byte arrives"
        if self._is_recent("packet", now):
            return "packets arrive, but none of the motors"
        if self._is_recent("crc", now):
            return "packets arrive, but their checksums are wrong"
        return "bytes arrive, none make sense: check base_driver.port.baud and .device"

    def status(self, now: int) -> BoardStatus:
        """Counters, rate since the last call, supplies and temperatures."""
        elapsed = (now - self._status_at) * 1e-9
        rate = (self._n_reports - self._n_reports_at_status) / elapsed if self._status_at and elapsed > 0 else 0.0
        self._status_at, self._n_reports_at_status = now, self._n_reports
        age = max(now - self._last_at["packet"], 0) * 1e-9 if "packet" in self._last_at else nan
        standard, line = self.standard, self.deframer
        left_temperature, right_temperature = standard.motor_temperatures if standard else (nan, nan)
        return BoardStatus(
            stamp=now,
            good=line.n_good,
            bad_crc=line.n_bad_crc,
            resyncs=line.n_resyncs,
            skipped=line.n_skipped,
            last_heard=age,
            rate=rate,
            board_supply=standard.board_supply if standard else nan,
            motor_supply=standard.motor_supply if standard else nan,
            servo_supply=standard.servo_supply if standard else nan,
            left_temperature=left_temperature,
            right_temperature=right_temperature,
            temperature=standard.temperature if standard else nan,
        )

    def _start_bytes(self) -> bytes:
        """Bytes that set the gains of both wheels and command zero."""
        config = self.config
        gains = [drrobot.set_gains("velocity", wheel, config.kp, config.kd, config.ki) for wheel in (LEFT, RIGHT)]
        return b"".join(gains) + self.command(0.0, 0.0)

    def _store(self, message: BoardMessage | None, now: int) -> None:
        if isinstance(message, StandardSensor):
            self.standard = message
            self._n_zeros = np.where(np.array(message.ultrasonic) == 0, self._n_zeros + 1, 0)
        elif isinstance(message, CustomSensor):
            self.custom = message
        if message is not None:
            self._record_time(type(message).__name__, now)

    def _report(self, motors: MotorSensor, stamp: int, now: int) -> BoardReport:
        standard = self.standard if self._is_recent("StandardSensor", now, self.config.sensors_silent) else None
        custom = self.custom if self._is_recent("CustomSensor", now, self.config.sensors_silent) else None
        centimetres = np.array(standard.ultrasonic if standard else [NO_ECHO_CM] * 6, np.float32)
        ultrasonic = np.where(centimetres < NO_ECHO_CM, centimetres / 100, np.nan).astype(np.float32)
        infrared = (standard.infrared if standard else nan, *(custom.infrared if custom else (nan,) * 6))
        return BoardReport(
            stamp=max(stamp - round(self.config.latency * 1e9), 0),
            left_counts=motors.counts[LEFT],
            right_counts=motors.counts[RIGHT],
            left_speed=float(motors.speeds[LEFT]),
            right_speed=float(motors.speeds[RIGHT]),
            ultrasonic=ultrasonic[: self.n_ultrasonic],
            infrared=np.array(infrared[: self.n_infrared], np.float32),
            battery=standard.motor_supply if standard else nan,
            currents=np.array(motors.currents[:2], np.float32),
        )

    def _record_time(self, what: str, now: int) -> None:
        self._last_at[what] = now
        self._last_at.setdefault("first", now)

    def _is_recent(self, what: str, now: int, seconds: float | None = None) -> bool:
        """Whether such bytes or packets arrived within `seconds`, or within `silent`."""
        limit = self.silent if seconds is None else seconds * 1e9
        return what in self._last_at and 0 <= now - self._last_at[what] <= limit
