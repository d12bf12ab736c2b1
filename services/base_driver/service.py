# SPDX-License-Identifier: Apache-2.0
"""Between cmd/vel and the board: the document's equations, the last watchdog, and what the board reports."""

from dataclasses import replace
from math import nan

import numpy as np
from pydantic import Field

from services.base_driver.battery import BatteryConfig, BatteryWatch
from services.base_driver.encoders import EncoderConfig, Encoders
from services.base_driver.following import FollowingConfig
from services.base_driver.jumps import JumpWatch
from services.base_driver.kinematics import board_counts, wheel_speeds
from services.base_driver.range_sensors import RangeSensors
from services.base_driver.serial_board import SerialBoard, SerialBoardConfig
from services.base_driver.stuck import StuckConfig
from services.base_driver.watchdog import Watchdog, WatchdogConfig
from services.base_driver.wheel_faults import WheelFaults
from shared import reasons, topics
from shared.config import Robot, Section
from shared.messages import (
    BaseStatus,
    BoardReport,
    EmergencyStop,
    Float32s,
    MotorCommand,
    PortState,
    RangeReadings,
    SerialData,
    Velocity,
)
from shared.ports import PortConfig
from shared.rejections import Kind
from shared.service import Out, Service, every, on
from shared.stamps import FUTURE, precedes, supersedes
from shared.topics import Publication

SEPARATOR = "; "  # between the parts of a status's detail; the fault's words come first
PORT = "board"
JUMPING = "the encoders' counts jump again and again"
LATCHED = (reasons.WHEEL_STUCK.code, reasons.WHEEL_ASTRAY.code, reasons.ENCODERS_BROKEN.code)
"""Faults that a person must look at."""


class BaseDriverConfig(Section):
    """The base driver."""

    port: PortConfig = Field(PortConfig(), description="of the motion board; no device: `hardware/board` and `motors`")
    board: SerialBoardConfig = SerialBoardConfig()
    board_silent: float = Field(0.5, gt=0.05, le=5, description="s without a report after which the link is lost")
    board_age: float = Field(
        0.2, gt=0.02, le=1, description="s after its stamp that a report is too old to be used; with others, a fault"
    )
    battery: BatteryConfig = BatteryConfig()
    watchdog: WatchdogConfig = WatchdogConfig()
    encoders: EncoderConfig = EncoderConfig()
    stuck: StuckConfig = StuckConfig()
    following: FollowingConfig = FollowingConfig()


class BaseDriverService(Service):
    """Drives the motors while a young command stands and nothing speaks against it; else they stand."""

    config_type = BaseDriverConfig
    config: BaseDriverConfig

    def __init__(self, config: BaseDriverConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self.serial = SerialBoard(config.board, robot, config.board_silent) if config.port.given else None
        self.watchdog = Watchdog(config.watchdog)
        self.encoders = Encoders(config.encoders, robot.drive)
        self.jumps = JumpWatch()
        self.range_sensors = RangeSensors(robot)
        self.wheel_faults = WheelFaults(config.stuck, config.following, robot.drive)
        self.battery = BatteryWatch(config.battery)
        self.report: BoardReport | None = None
        self.started: int | None = None
        self.link = False
        self.pressed: EmergencyStop | None = None
        self.wheels = (0.0, 0.0)  # rad/s, as last sent to the board
        self.told: tuple[str, bool, bool] | None = None  # fault, link, waits
        self.ranges_told = 0
        self.sensors = _sensor_columns(robot)

    def warm(self) -> None:
        if self.serial is not None:
            self.serial.warm()

    @property
    def ports(self) -> dict[str, PortConfig]:
        return {PORT: self.config.port}

    @property
    def fault(self) -> str:
        """A reason's code, empty when there is none."""
        if self.pressed is not None:
            return reasons.ESTOP.code
        if self.wheel_faults.code:
            return self.wheel_faults.code
        if self.jumps.holds(self.now):
            return reasons.ENCODERS_JUMP.code
        if self.wheel_faults.pausing(self.now):
            return reasons.NOT_OBEYED.code
        if self._bad_stamps():
            return reasons.BAD_STAMPS.code
        started = self.now if self.started is None else self.started
        waited = self.now - started > self.config.board_silent * 1e9
        if self.serial is not None and not self.serial.open and (waited or self.report is not None):
            return reasons.PORT_CLOSED.code
        if waited and not self.link:
            return reasons.BOARD_SILENT.code
        if self.battery.is_empty:
            return reasons.BATTERY_EMPTY.code
        if self.range_sensors.mismatch:
            return reasons.WRONG_RANGES.code
        return reasons.SENSOR_DEAD.code if self._dead_sensors() else ""

    def _bad_stamps(self) -> str:
        """What is wrong with the reports that come, in words, where none of them can be used any more."""
        fresh = self.report is not None and self.now - self.report.stamp <= self.config.board_age * 1e9
        return "" if fresh else self.rejections.refused(topics.BOARD.key, self.now)

    def _dead_sensors(self) -> str:
        """Which range sensors do not answer, in words."""
        return self.serial.dead_sensors(self.now) if self.serial else self.range_sensors.dead

    def state(self) -> str:
        return self.fault or ("driving" if any(self.wheels) else "standing")

    @on(topics.CMD_VEL)
    def command(self, command: Velocity) -> Out:
        if self.watchdog.offer(command, self.now):
            yield from self._motors()  # no command waits for the tick

    @on(topics.ESTOP)
    def estop(self, stop: EmergencyStop) -> Out:
        """The second line behind the guard; a release also ends a latched fault, and never moves the robot."""
        if stop.pressed:  # its clock may be ahead: nothing from before it came releases it
            self.pressed = replace(stop, stamp=min(stop.stamp, self.now))
        elif self.pressed is None or not precedes(stop.stamp, self.pressed.stamp, self.now):
            if self.pressed is not None or self.wheel_faults.code:
                self.watchdog.disarm(self.now)
            self.pressed = None
            if supersedes(stop.stamp, self.wheel_faults.at, self.now):
                self.wheel_faults.release()
                self.jumps.release()
        yield from self._motors()
        yield from self._changed_status()

    @on(topics.BASE)
    def before_the_restart(self, status: BaseStatus) -> Out:
        """A wheel's fault and STOP outlive this process: only a release later than our last word ends them."""
        if status.fault == reasons.ESTOP.code:
            self.pressed = EmergencyStop(status.stamp, True, "from before a restart")
            yield self._status()
        if status.fault in LATCHED:
            self.wheel_faults.latch(status.fault, status.detail.split(SEPARATOR)[0], status.stamp)
            yield self._status()

    @on(topics.PORT)
    def port(self, state: PortState) -> Out:
        """The board's port was opened or went away; whichever, nothing moves until it is commanded anew."""
        if self.serial is None or state.port != PORT:
            return
        greeting = self.serial.port(state)
        self.watchdog.disarm(self.now)
        if greeting:
            yield topics.TX(SerialData(self.now, PORT, greeting))
        yield from self._motors()
        yield from self._changed_status()

    @on(topics.RX)
    def bytes_came(self, data: SerialData) -> Out:
        """What the board says over its port."""
        if self.serial is None or data.port != PORT:
            return
        report, answer = self.serial.heard(data, self.now)
        if answer:
            yield topics.TX(SerialData(self.now, PORT, answer))
        if report is not None:
            yield topics.REPORT(report)
            yield from self._take(report)

    @on(topics.BOARD)
    def board(self, report: BoardReport) -> Out:
        """What a board says that speaks in messages."""
        if self.serial is None:
            yield from self._take(report)

    def _take(self, report: BoardReport) -> Out:
        last = self.report
        before = last.stamp if last is not None else None
        if not self.rejections.judge(topics.BOARD.key, report.stamp, before, self.now, self.config.board_age):
            return
        if last is not None and report.stamp <= last.stamp:
            self.encoders.restart()  # the stack's clock was set back: a new epoch
        self.report = report
        self.range_sensors.take(report)
        if self.range_sensors.mismatch:
            self.rejections.count(topics.BOARD.key, Kind.CONTENT, self.range_sensors.mismatch)
        n_jumps = self.encoders.n_jumps
        for state in self.encoders.turned(report, self.now):
            yield topics.WHEELS(state)
        if self.encoders.n_jumps > n_jumps and self.jumps.jumped(self.now) and not self.wheel_faults.code:
            self.wheel_faults.latch(reasons.ENCODERS_BROKEN.code, JUMPING, self.now)
        self.wheel_faults.look(report.stamp, self.encoders, self.wheels, self.now)
        self.battery.take(report.stamp, report.battery)
        self._look_at_link()
        yield from self._changed_status()

    @every(hz=50)
    def drive(self) -> Out:
        self.started = self.now if self.started is None else min(self.started, self.now)
        self._look_at_link()
        yield from self._changed_status()
        yield from self._motors()

    @every(hz=10)
    def measure(self) -> Out:
        if self.range_sensors.mismatch:
            return
        if self.report is not None and self.report.stamp != self.ranges_told:
            self.ranges_told = self.report.stamp
            yield topics.RANGES(self._ranges(self.report))

    @every(hz=2)
    def tell(self) -> Out:
        yield self._status()
        if self.serial is not None:
            yield topics.BOARD_IS(self.serial.status(self.now))

    def farewell(self) -> Out:
        """Whatever comes next, it finds motors that stand, and on a serial board without power."""
        self.wheels = 0.0, 0.0
        yield topics.MOTORS(MotorCommand(self.now, 0.0, 0.0))
        if self.serial is not None:
            yield topics.TX(SerialData(self.now, PORT, self.serial.farewell()))

    def _motors(self) -> Out:
        stands = bool(self.fault) or not self.link
        v, w = (0.0, 0.0) if stands else self.robot.drive.clamped(*self.watchdog.velocity(self.now))
        self.wheels = wheel_speeds(v, w, self.robot.drive)
        command = MotorCommand(self.now, *board_counts(*self.wheels, self.robot.drive))
        yield topics.MOTORS(command)
        if self.serial is not None and self.serial.open:
            yield topics.TX(SerialData(self.now, PORT, self.serial.command(command.left, command.right)))

    def _look_at_link(self) -> None:
        silent = round(self.config.board_silent * 1e9)
        self.link = self.report is not None and -FUTURE <= self.now - self.report.stamp <= silent

    def _changed_status(self) -> Out:
        fault = self.fault
        if self.told is not None and self.told[0] and not fault:
            self.watchdog.disarm(self.now)  # the first command after a fault is zero
        if self.told != (fault, self.link, not self.watchdog.armed):
            yield self._status()
        if fault and any(self.wheels):
            yield from self._motors()

    def _status(self) -> Publication:
        fault, report = self.fault, self.report
        waits = not self.watchdog.armed
        self.told = fault, self.link, waits
        battery = report.battery if report else nan
        left_current, right_current = (float(a) for a in report.currents) if report else (0.0, 0.0)
        serial, jumps = self.serial, self.jumps.told(self.now)
        details = (
            self.wheel_faults.told(self.now),
            jumps if self.jumps.holds(self.now) else "",
            self._bad_stamps(),
            serial.silence(self.now) if serial and (not serial.open or not self.link) else "",
            f"battery low: {battery:.1f} V" if self.battery.is_low(battery) else "",
            self.range_sensors.mismatch,
            self._dead_sensors(),
            jumps,
            self.watchdog.refused,
        )
        detail = SEPARATOR.join(dict.fromkeys(text for text in details if text))
        return topics.BASE(BaseStatus(self.now, battery, left_current, right_current, self.link, fault, detail, waits))

    def _ranges(self, report: BoardReport) -> RangeReadings:
        """The board's ranges in the robot's order of sensors; outside a sensor's own limits is no measurement."""
        left_over = {"ultrasonic": list(report.ultrasonic), "infrared": list(report.infrared)}
        ranges = np.full(len(self.robot.ranges), np.nan, np.float32)
        for i, sensor in enumerate(self.robot.ranges):
            value = left_over[sensor.kind].pop(0) if left_over[sensor.kind] else np.nan
            if np.float32(sensor.range_min) <= value <= np.float32(sensor.range_max):
                ranges[i] = value
        return RangeReadings(report.stamp, *self.sensors, ranges)


def _sensor_columns(robot: Robot) -> tuple[Float32s, Float32s, Float32s, Float32s]:
    """x, y, yaw and field of view of the range sensors: float32 arrays of one length."""
    rows = [(s.mount.x, s.mount.y, s.mount.yaw, s.field_of_view) for s in robot.ranges]
    x, y, yaw, field_of_view = np.array(rows, np.float32).reshape(-1, 4).T
    return x.copy(), y.copy(), yaw.copy(), field_of_view.copy()
