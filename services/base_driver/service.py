# SPDX-License-Identifier: Apache-2.0
"""Between cmd/vel and the board: the document's equations, the last watchdog, and what the board reports."""

import numpy as np
from pydantic import Field

from services.base_driver.encoders import EncoderConfig, Encoders
from services.base_driver.kinematics import board_counts, wheel_speeds
from services.base_driver.stuck import StuckConfig, StuckWatch
from services.base_driver.watchdog import FUTURE, Watchdog, WatchdogConfig
from shared import reasons, topics
from shared.config import Robot, Section
from shared.messages import BaseStatus, BoardReport, EmergencyStop, Float32s, MotorCommand, RangeReadings, Velocity
from shared.service import Out, Service, every, on
from shared.topics import Publication

SEPARATOR = "; "  # between the parts of a status's detail; what is stuck comes first


class BaseDriverConfig(Section):
    """The base driver."""

    board_silent: float = Field(0.5, gt=0.05, le=5, description="s without a report after which the link is lost")
    battery_low: float = Field(6.6, ge=0, le=100, description="V under which the status says so; 0 never")
    watchdog: WatchdogConfig = WatchdogConfig()
    encoders: EncoderConfig = EncoderConfig()
    stuck: StuckConfig = StuckConfig()


class BaseDriverService(Service):
    """Drives the motors while a young command stands and nothing speaks against it; else they stand."""

    config_type = BaseDriverConfig
    config: BaseDriverConfig

    def __init__(self, config: BaseDriverConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self.watchdog = Watchdog(config.watchdog)
        self.encoders = Encoders(config.encoders, robot.drive)
        self.left_watch, self.right_watch = StuckWatch(config.stuck), StuckWatch(config.stuck)
        self.report: BoardReport | None = None
        self.started: int | None = None
        self.link = False
        self.stuck = ""  # what is stuck; latched
        self.stuck_at = 0
        self.pressed: EmergencyStop | None = None
        self.wheels = (0.0, 0.0)  # rad/s, as last sent to the board
        self.told: tuple[str, bool] | None = None
        self.ranges_told = 0
        self.sensors = _sensor_columns(robot)

    @property
    def fault(self) -> str:
        """A reason's code, empty when there is none."""
        if self.stuck:
            return reasons.WHEEL_STUCK.code
        started = self.now if self.started is None else self.started
        waited = self.now - started > self.config.board_silent * 1e9
        return reasons.BOARD_SILENT.code if waited and not self.link else ""

    def state(self) -> str:
        return self.fault or ("driving" if any(self.wheels) else "standing")

    @on(topics.CMD_VEL)
    def command(self, command: Velocity) -> Out:
        if self.watchdog.offer(command, self.now) and not (command.v or command.w):
            yield self._motors()  # stopping does not wait for the tick

    @on(topics.ESTOP)
    def estop(self, stop: EmergencyStop) -> Out:
        """The second line behind the guard; a release also ends a latched fault, and never moves the robot."""
        if stop.pressed:
            self.pressed = stop
        elif self.pressed is None or stop.stamp >= self.pressed.stamp:
            if self.pressed is not None or self.stuck:
                self.watchdog.disarm(self.now)
            self.pressed = None
            if stop.stamp > self.stuck_at:
                self.stuck = ""
        yield self._motors()
        yield from self._changed_status()

    @on(topics.BASE)
    def before_the_restart(self, status: BaseStatus) -> Out:
        """A wheel's fault outlives this process: only a release later than our last word ends it."""
        if status.fault == reasons.WHEEL_STUCK.code:
            self.stuck, self.stuck_at = status.detail.split(SEPARATOR)[0], status.stamp
            yield self._status()

    @on(topics.BOARD)
    def board(self, report: BoardReport) -> Out:
        last = self.report
        if last is not None and report.stamp <= last.stamp:
            if last.stamp <= self.now + FUTURE:
                return
            self.encoders.restart()  # the stack's clock was set back: a new epoch
        self.report = report
        for state in self.encoders.turned(report, self.now):
            yield topics.WHEELS(state)
        self._look_for_stuck_wheels(report.stamp)
        self._look_at_link()
        yield from self._changed_status()

    @every(hz=50)
    def drive(self) -> Out:
        self.started = self.now if self.started is None else min(self.started, self.now)
        self._look_at_link()
        yield self._motors()
        yield from self._changed_status()

    @every(hz=10)
    def measure(self) -> Out:
        if self.report is not None and self.report.stamp != self.ranges_told:
            self.ranges_told = self.report.stamp
            yield topics.RANGES(self._ranges(self.report))

    @every(hz=2)
    def tell(self) -> Out:
        yield self._status()

    def _motors(self) -> Publication:
        stands = self.pressed is not None or bool(self.fault) or not self.link
        v, w = (0.0, 0.0) if stands else self.robot.drive.clamped(*self.watchdog.velocity(self.now))
        self.wheels = wheel_speeds(v, w, self.robot.drive)
        return topics.MOTORS(MotorCommand(self.now, *board_counts(*self.wheels, self.robot.drive)))

    def _look_at_link(self) -> None:
        silent = round(self.config.board_silent * 1e9)
        link = self.report is not None and -FUTURE <= self.now - self.report.stamp <= silent
        if link and not self.link and self.fault:
            self.watchdog.disarm(self.now)  # the first command after a lost link is zero
        self.link = link

    def _look_for_stuck_wheels(self, stamp: int) -> None:
        drive = self.robot.drive
        left = self.left_watch.stuck(stamp, self.encoders.left, self.wheels[0], drive.left_radius)
        right = self.right_watch.stuck(stamp, self.encoders.right, self.wheels[1], drive.right_radius)
        if (left or right) and not self.stuck:
            wheels = " and ".join(name for name, holds in (("left", left), ("right", right)) if holds)
            self.stuck = f"the {wheels} wheel is commanded but does not turn"
            self.stuck_at = self.now

    def _changed_status(self) -> Out:
        if self.told != (self.fault, self.link):
            yield self._status()
        if self.fault and any(self.wheels):
            yield self._motors()

    def _status(self) -> Publication:
        self.told = self.fault, self.link
        report = self.report
        battery = report.battery if report else 0.0
        left_current, right_current = (float(a) for a in report.currents) if report else (0.0, 0.0)
        low = report is not None and battery < self.config.battery_low
        jumps = self.encoders.n_jumps
        details = (
            self.stuck,
            f"battery low: {battery:.1f} V" if low else "",
            f"the encoders jumped {jumps} times" if jumps else "",
            self.watchdog.refused,
        )
        detail = SEPARATOR.join(text for text in details if text)
        return topics.BASE(BaseStatus(self.now, battery, left_current, right_current, self.link, self.fault, detail))

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
