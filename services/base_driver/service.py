# SPDX-License-Identifier: Apache-2.0
"""Base driver: `cmd/vel` to motor commands, board reports to wheel angles, ranges and status; the last watchdog."""

from services.base_driver.body_sensors import BodySensors
from services.base_driver.config import BaseDriverConfig
from services.base_driver.diagnosis import LATCHED_FAULTS, SEPARATOR, Diagnosis
from services.base_driver.encoders import Encoders
from services.base_driver.kinematics import board_counts, wheel_speeds
from services.base_driver.serial_board import SerialBoard
from services.base_driver.velocity_base import VelocityBase
from services.base_driver.watchdog import Watchdog
from shared import reasons, topics
from shared.config import Robot
from shared.messages import (
    BaseOdometry,
    BaseStatus,
    BoardReport,
    EmergencyStop,
    MotorCommand,
    PortState,
    SerialData,
    Velocity,
)
from shared.ports import PortConfig
from shared.rejections import RejectionCause
from shared.service import Out, Service, every, on
from shared.stamps import FUTURE, precedes, supersedes
from shared.stop_button import latched_press
from shared.topics import Publication

PORT = "board"
MAX_PAUSE_NS = 200_000_000  # between two ticks of 50 Hz: after a longer one the process was frozen


class BaseDriverService(Service):
    """Drives the motors while the last command is recent and no fault is present; otherwise commands zero."""

    config_type = BaseDriverConfig
    config: BaseDriverConfig

    def __init__(self, config: BaseDriverConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self.serial = SerialBoard(config.board, robot, config.board_silent) if config.port.given else None
        self.watchdog = Watchdog(config.watchdog)
        self.encoders = Encoders(config.encoders, robot.drive)
        self.diagnosis = Diagnosis(config, robot, self.serial)
        self.body_sensors = BodySensors(robot, config.board.gyro, config.board.latency)
        self.velocity_base = VelocityBase(config.encoders, robot.drive) if robot.drive.kind == "velocity" else None
        self.report_key = topics.BOARD.key if self.velocity_base is None else topics.BASE_MOTION.key
        self.report: BoardReport | BaseOdometry | None = None
        self.awake_since, self.drove_at = 0, -MAX_PAUSE_NS - 1  # ns: of ticks without a pause the first and the last
        self.is_linked = False
        self.pressed_stop: EmergencyStop | None = None
        self.wheel_command = (0.0, 0.0)  # left, right, rad/s, as last sent to the board
        self.published: tuple[str, bool, bool] | None = None  # fault, is_linked, waits of the last status
        self.ranges_stamp = 0  # ns, of the last report with published ranges

    def warm_up(self) -> None:
        if self.serial is not None:
            self.serial.warm_up()

    @property
    def ports(self) -> dict[str, PortConfig]:
        return {PORT: self.config.port}

    @property
    def fault(self) -> str:
        """Code of the present fault, a row of shared/reasons.py; empty without a fault."""
        if self.pressed_stop is not None:
            return reasons.ESTOP.code
        has_waited = self.now - self._awake_since > self.config.board_silent * 1e9
        is_port_closed = self.serial is not None and not self.serial.open
        return self.diagnosis.fault(
            self.now,
            bad_stamps=self._bad_stamps(),
            is_port_closed=is_port_closed and (has_waited or self.report is not None),
            is_silent=has_waited and not self.is_linked,
        )

    def state(self) -> str:
        return self.fault or ("driving" if any(self.wheel_command) else "standing")

    @on(topics.CMD_VEL)
    def command(self, command: Velocity) -> Out:
        if self.published is not None and self.published[0]:
            yield from self._status_if_changed()  # if the fault has ended since the tick, this command waits for zero
        if self.watchdog.offer(command, self.now):
            yield from self._motor_commands()  # no command waits for the tick

    @on(topics.ESTOP)
    def estop(self, stop: EmergencyStop) -> Out:
        """Stops the motors, independently of the guard. A release also ends a latched fault, and never moves the robot.

        A release counts only if it is newer than the stop and the fault.
        """
        if stop.pressed:
            self.pressed_stop = latched_press(stop, self.pressed_stop, self.now)
            yield from self._motor_commands()
        elif self.pressed_stop is None or not precedes(stop.stamp, self.pressed_stop.stamp, self.now):
            self.pressed_stop = None
            if supersedes(stop.stamp, self.diagnosis.wheel_faults.at, self.now):
                self.diagnosis.release()
        yield from self._status_if_changed()

    @on(topics.BASE_STATUS)
    def restore_faults(self, status: BaseStatus) -> Out:
        """Restores e-stop and latched faults from the previous process's status: only a newer release ends them."""
        if status.fault == reasons.ESTOP.code:
            self.pressed_stop = EmergencyStop(status.stamp, True, "from before a restart")
            yield self._status()
        if status.fault in LATCHED_FAULTS:
            detail = status.detail.split(SEPARATOR)[0]
            self.diagnosis.wheel_faults.latch(status.fault, detail, status.stamp)
            yield self._status()

    @on(topics.PORT)
    def port(self, state: PortState) -> Out:
        """Handles a board port that opened or closed: the robot waits for a new command."""
        if self.serial is None or state.port != PORT:
            return
        self.watchdog.disarm(self.now)
        yield from self._send(self.serial.update_port(state, self.now))
        yield from self._motor_commands()
        yield from self._status_if_changed()

    @on(topics.RX)
    def receive_bytes(self, data: SerialData) -> Out:
        """Decodes bytes of the board's port, and answers the board."""
        if self.serial is None or data.port != PORT:
            return
        received = self.serial.receive(data, self.now)
        yield from self._send(received.answer)
        if received.restarted:
            self._restart_angles()
        yield from self.body_sensors.publications(received, data.stamp)
        if received.report is not None:
            yield topics.REPORT(received.report)
            yield from self._process_report(received.report)
        if received.odometry is not None:
            yield from self._process_report(received.odometry)

    @on(topics.BOARD)
    def board(self, report: BoardReport) -> Out:
        """Handles the report of a board that sends messages."""
        return self._process_report(report) if self.serial is None else ()

    @on(topics.BASE_MOTION)
    def base_motion(self, report: BaseOdometry) -> Out:
        """Handles the odometry of a base that controls its own speed and sends messages."""
        return self._process_report(report) if self.serial is None else ()

    def _process_report(self, report: BoardReport | BaseOdometry) -> Out:
        if isinstance(report, BoardReport) == (self.velocity_base is not None):
            return  # of the other kind of drive
        last, key = self.report, self.report_key
        if not self.rejections.judge(key, report.stamp, last.stamp if last else None, self.now, self.config.board_age):
            return
        if last is not None and report.stamp <= last.stamp:
            self._restart_angles()  # the stack's clock was set back: a new epoch
        self.report = report
        if isinstance(report, BoardReport):
            range_sensors = self.diagnosis.range_sensors
            range_sensors.update(report)
            if range_sensors.mismatch:
                self.rejections.count(key, RejectionCause.CONTENT, range_sensors.mismatch)
            yield from (topics.WHEELS(state) for state in self.encoders.update(report, self.now))
        elif self.velocity_base is not None:
            yield topics.BASE_ODOMETRY(self.velocity_base.update(report, self.now))
        if self._awake_since == self.now:  # the clock was set, or the process slept: the wheels had no time to turn
            self.diagnosis.wheel_faults.restart()
        self.diagnosis.update(report, self.velocity_base or self.encoders, self.wheel_command, self.now)
        self._update_link()
        yield from self._status_if_changed()

    @property
    def _awake_since(self) -> int:
        """ns since when this process works without a pause: it does not know whether the board was silent before."""
        return self.awake_since if 0 <= self.now - self.drove_at <= MAX_PAUSE_NS else self.now

    @every(hz=50)
    def drive(self) -> Out:
        self.awake_since, self.drove_at = self._awake_since, self.now
        self._update_link()
        yield from self._status_if_changed()
        yield from self._motor_commands()

    @every(hz=10)
    def publish_ranges(self) -> Out:
        report, range_sensors = self.report, self.diagnosis.range_sensors
        if isinstance(report, BoardReport) and not range_sensors.mismatch and report.stamp != self.ranges_stamp:
            self.ranges_stamp = report.stamp
            yield topics.RANGES(range_sensors.readings(report))

    @every(hz=2)
    def publish_status(self) -> Out:
        yield self._status()
        if self.serial is not None:
            yield topics.BOARD_IS(self.serial.status(self.now))

    def on_shutdown(self) -> Out:
        """Stops the motors; on a serial board, also switches off their power."""
        self.watchdog.disarm(self.now)
        yield from self._motor_commands()
        if self.serial is not None:
            yield from self._send(self.serial.stop_bytes())

    def _motor_commands(self) -> Out:
        is_stopped = bool(self.fault) or not self.is_linked
        v, w = (0.0, 0.0) if is_stopped else self.robot.drive.clamped(*self.watchdog.velocity(self.now))
        self.wheel_command = wheel_speeds(v, w, self.robot.drive)
        left, right = board_counts(*self.wheel_command, self.robot.drive)
        if self.velocity_base is None:
            yield topics.MOTORS(MotorCommand(self.now, left, right))
        else:
            yield topics.VELOCITY(Velocity(self.now, v, w, ""))
        if self.serial is not None and self.serial.open:
            yield from self._send(self.serial.command(left, right, self.now))

    def _send(self, data: bytes) -> Out:
        if data:
            yield topics.TX(SerialData(self.now, PORT, data))

    def _restart_angles(self) -> None:
        (self.velocity_base or self.encoders).restart()
        self.diagnosis.wheel_faults.restart()

    def _update_link(self) -> None:
        silent = round(self.config.board_silent * 1e9)
        self.is_linked = self.report is not None and -FUTURE <= self.now - self.report.stamp <= silent

    def _bad_stamps(self) -> str:
        """What is wrong with the reports' stamps, when no recent report can be used; else empty."""
        is_recent = self.report is not None and self.now - self.report.stamp <= self.config.board_age * 1e9
        return "" if is_recent else self.rejections.stamp_problem(self.report_key, self.now)

    def _status_if_changed(self) -> Out:
        fault = self.fault
        if self.published != (fault, self.is_linked, not self.watchdog.armed):
            yield self._status()
        if fault and any(self.wheel_command):
            yield from self._motor_commands()

    def _status(self) -> Publication:
        if self.published is not None and self.published[0] and not self.fault:
            self.watchdog.disarm(self.now)  # the first command after a fault is zero
        self.published = state = self.fault, self.is_linked, not self.watchdog.armed
        refused = self.watchdog.refused
        return topics.BASE_STATUS(self.diagnosis.status(self.now, self.report, state, self._bad_stamps(), refused))
