# SPDX-License-Identifier: Apache-2.0
"""Which fault does the base have? Wheels, encoders, battery, range sensors and the link, in one order of priority."""

from math import nan

from services.base_driver.battery import BatteryMonitor
from services.base_driver.config import BaseDriverConfig
from services.base_driver.encoder_jumps import EncoderJumpDetector
from services.base_driver.encoders import WheelAngles
from services.base_driver.range_sensors import RangeSensorMonitor
from services.base_driver.serial_board import SerialBoard
from services.base_driver.wheel_faults import WheelFaults
from shared import reasons
from shared.config import Robot
from shared.messages import BaseOdometry, BaseStatus, BoardReport

SEPARATOR = "; "  # between the parts of a status's detail; the fault's text comes first
ENCODERS_BROKEN_DETAIL = "the encoders' counts jump again and again"
LATCHED_FAULTS = (reasons.WHEEL_STUCK.code, reasons.WHEEL_ASTRAY.code, reasons.ENCODERS_BROKEN.code)
"""Faults that only an e-stop release ends."""


class Diagnosis:
    """Monitors of the base, and the fault that follows from them. Stamps and `now` are ns."""

    def __init__(self, config: BaseDriverConfig, robot: Robot, serial: SerialBoard | None) -> None:
        self.wheel_faults = WheelFaults(config.stuck, config.following, robot.drive)
        self.range_sensors = RangeSensorMonitor(robot)
        self._jumps = EncoderJumpDetector()
        self._battery = BatteryMonitor(config.battery)
        self._serial = serial
        self._n_jumps = 0

    def update(
        self, report: BoardReport | BaseOdometry, encoders: WheelAngles, wheel_command: tuple[float, float], now: int
    ) -> None:
        """Judges a report after `encoders` has counted it; wheel_command: left and right, rad/s, as last sent."""
        n_jumps, self._n_jumps = self._n_jumps, encoders.n_jumps
        if encoders.n_jumps > n_jumps and self._jumps.add_jump(now) and not self.wheel_faults.code:
            self.wheel_faults.latch(reasons.ENCODERS_BROKEN.code, ENCODERS_BROKEN_DETAIL, now)
        self.wheel_faults.update(report.stamp, encoders, wheel_command, now)
        self._battery.update(report.stamp, report.battery)

    def release(self) -> None:
        """Ends the latched faults: an e-stop release says that the user has inspected the robot."""
        self.wheel_faults.release()
        self._jumps.release()

    def fault(self, now: int, *, bad_stamps: str, is_port_closed: bool, is_silent: bool) -> str:
        """The code of the most important fault, a row of shared/reasons.py; empty without a fault.

        bad_stamps: what is wrong with the stamps of all recent reports, or empty.
        """
        faults = (
            (bool(self.wheel_faults.code), self.wheel_faults.code),
            (self._jumps.is_active(now), reasons.ENCODERS_JUMP.code),
            (self.wheel_faults.is_pausing(now), reasons.NOT_OBEYED.code),
            (bool(bad_stamps), reasons.BAD_STAMPS.code),
            (is_port_closed, reasons.PORT_CLOSED.code),
            (bool(self._board_fault), reasons.FAULT.code),
            (is_silent, reasons.BOARD_SILENT.code),
            (self._battery.is_empty, reasons.BATTERY_EMPTY.code),
            (bool(self.range_sensors.mismatch), reasons.WRONG_RANGES.code),
            (bool(self._dead_sensors(now)), reasons.SENSOR_DEAD.code),
        )
        return next((code for is_present, code in faults if is_present), "")

    def detail(self, now: int, *, bad_stamps: str, is_linked: bool, battery: float, refused: str) -> str:
        """Everything that is wrong, for people; battery: V.  refused: why the watchdog refuses commands, or empty."""
        serial, jumps = self._serial, self._jumps.description(now)
        parts = (
            self.wheel_faults.description(now),
            jumps if self._jumps.is_active(now) else "",
            bad_stamps,
            self._board_fault,
            serial.silence_cause(now) if serial and (not serial.open or not is_linked) else "",
            f"battery low: {battery:.1f} V" if self._battery.is_low(battery) else "",
            self.range_sensors.mismatch,
            self._dead_sensors(now),
            jumps,
            refused,
        )
        return SEPARATOR.join(dict.fromkeys(text for text in parts if text))

    def status(
        self,
        now: int,
        report: BoardReport | BaseOdometry | None,
        state: tuple[str, bool, bool],
        bad_stamps: str,
        refused: str,
    ) -> BaseStatus:
        """The status after the last report. state: fault, is_linked, waits.  refused: as of `detail`."""
        fault, is_linked, waits = state
        battery = report.battery if report is not None else nan
        currents = report.currents if isinstance(report, BoardReport) else (0.0, 0.0)
        detail = self.detail(now, bad_stamps=bad_stamps, is_linked=is_linked, battery=battery, refused=refused)
        return BaseStatus(
            stamp=now,
            battery=battery,
            left_current=float(currents[0]),
            right_current=float(currents[1]),
            link=is_linked,
            fault=fault,
            detail=detail,
            waits=waits,
        )

    @property
    def _board_fault(self) -> str:
        """Fault that the board on the port reports; empty without one."""
        return self._serial.device.fault if self._serial else ""

    def _dead_sensors(self, now: int) -> str:
        """Which range sensors do not answer; empty when all do."""
        return self._serial.dead_sensors(now) if self._serial else self.range_sensors.dead
