# SPDX-License-Identifier: Apache-2.0
"""The motion board on a port: its device, and the state of the line."""

from math import nan

from services.base_driver.boards.board_config import SerialBoardConfig
from services.base_driver.boards.device import BoardInput
from services.base_driver.boards.models import BOARDS, MODELS_WITH_ODOMETRY
from shared.config import Robot, UserError
from shared.messages import BoardStatus, PortState, SerialData


class SerialBoard:
    """Bytes in, bytes out, through the device of `config.model`.

    silent: s without a report after which the board may have restarted: it is configured again.
    Raises UserError where the board does not fit the robot's drive.
    """

    def __init__(self, config: SerialBoardConfig, robot: Robot, silent: float) -> None:
        if robot.drive.kind == "velocity" and config.model not in MODELS_WITH_ODOMETRY:
            raise UserError(
                f"robot.drive.kind: velocity does not fit the board {config.model}, which only counts wheels",
                "set robot.drive.kind: differential, or base_driver.board.model: velocity",
            )
        self.config, self.silent = config, round(silent * 1e9)
        self.device = BOARDS[config.model](config, robot)
        self.open, self.detail = False, "its port has not been opened yet"
        self._last_at: dict[str, int] = {}  # ns when bytes, a packet, a report, or a bad one came last
        self._started_at = 0  # ns
        self._n_reports = self._n_reports_at_status = 0
        self._status_at = 0

    def warm_up(self) -> None:
        """Compiles the kernels."""
        self.device.warm_up()

    def update_port(self, state: PortState, now: int) -> bytes:
        """Handles a port that opened or closed: drops earlier bytes, and returns the bytes to send now."""
        opened = state.open and not self.open
        self.open, self.detail = state.open, state.detail
        self.device.forget()
        self._last_at.clear()
        return self._start(now) if opened else b""

    def receive(self, data: SerialData, now: int) -> BoardInput:
        """The newest report in these bytes, and the bytes to answer."""
        before = self.device.counts
        n_good, n_bad, n_unreadable = before.n_good, before.n_bad, before.n_unreadable
        received = self.device.receive(data.data, max(data.stamp - round(self.config.latency * 1e9), 0), now)
        self._last_at["bytes"] = now
        if self.device.counts.n_bad > n_bad:
            self._last_at["crc"] = now
        if self.device.counts.n_unreadable > n_unreadable:
            self._last_at["fields"] = now
        if self.device.counts.n_good > n_good:
            self._last_at["packet"] = now
        if received.n_reports:
            is_first = not self._is_recent("report", now)
            has_started = received.ends_with_answer and self._has_just_started(now)
            if is_first and not has_started and not self.device.starts_again:
                received.answer = self._start(now) + received.answer
            self._last_at["report"] = now
            self._n_reports += received.n_reports
        return received

    def command(self, left: float, right: float, now: int) -> bytes:
        """Bytes that command the wheels' speeds, counts/s with the signs of BoardReport."""
        must_start = self.device.starts_again and not self._is_recent("report", now)
        start = self._start(now) if must_start and not self._has_just_started(now) else b""
        return start + self.device.command(left, right, now)

    def stop_bytes(self) -> bytes:
        """Bytes that stop both wheels and switch off their power."""
        return self.device.stop_command()

    def dead_sensors(self, now: int) -> str:
        """Text of the range sensors that do not answer; empty if all do, or if the whole board is silent."""
        return self.device.dead_sensors(now) if self._is_recent("report", now) else ""

    def silence_cause(self, now: int) -> str:
        """Text of the cause why no report arrives."""
        if not self.open:
            return self.detail
        if not self._is_recent("bytes", now):
            return "no byte arrives"
        if self._is_recent("packet", now):
            return "packets arrive, but none of the motors"
        if self._is_recent("fields", now):
            return "lines arrive with right checksums, but their fields are wrong"
        if self._is_recent("crc", now):
            return "packets arrive, but their checksums are wrong"
        return "bytes arrive, none make sense: check base_driver.port.baud and .device, and .board.model"

    def status(self, now: int) -> BoardStatus:
        """Counters, rate since the last call, supplies and temperatures."""
        elapsed = (now - self._status_at) * 1e-9
        rate = (self._n_reports - self._n_reports_at_status) / elapsed if self._status_at and elapsed > 0 else 0.0
        self._status_at, self._n_reports_at_status = now, self._n_reports
        age = max(now - self._last_at["packet"], 0) * 1e-9 if "packet" in self._last_at else nan
        line = self.device.counts
        board_supply, motor_supply, servo_supply, *temperatures = self.device.supplies
        return BoardStatus(
            stamp=now,
            good=line.n_good,
            bad_crc=line.n_bad,
            resyncs=line.n_resyncs,
            skipped=line.n_skipped,
            last_heard=age,
            rate=rate,
            board_supply=board_supply,
            motor_supply=motor_supply,
            servo_supply=servo_supply,
            left_temperature=temperatures[0],
            right_temperature=temperatures[1],
            temperature=temperatures[2],
        )

    def _start(self, now: int) -> bytes:
        self._started_at = now
        return self.device.start_command()

    def _has_just_started(self, now: int) -> bool:
        """Whether the start bytes were sent within `silent`."""
        return 0 <= now - self._started_at < self.silent

    def _is_recent(self, what: str, now: int) -> bool:
        """Whether such bytes or packets arrived within `silent`."""
        return what in self._last_at and 0 <= now - self._last_at[what] <= self.silent
