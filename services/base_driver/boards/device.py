# SPDX-License-Identifier: Apache-2.0
"""Interface of all motion boards: wheel commands to bytes, bytes to reports."""

from collections import deque
from dataclasses import dataclass
from math import nan
from typing import NamedTuple, Protocol

import numpy as np

from services.base_driver.boards.board_config import SerialBoardConfig
from services.base_driver.kinematics import count_difference, wheel_angles
from shared.board_framing import LineCounts
from shared.config import Robot, UserError
from shared.messages import BaseOdometry, BoardReport
from shared.robot import MAX_COUNTS_PER_S

NO_RANGES = np.empty(0, np.float32)
MIN_SPEED_STEP_S = 0.06  # s; counts over a shorter time give a coarse speed
MAX_SPEED_STEP_S = 0.5  # s; after a longer pause the speed is not known


class BoardContacts(NamedTuple):
    """Names of the pressed bumpers and of the cliff sensors without floor, and whether the e-stop is pressed."""

    bumpers: tuple[str, ...] = ()
    cliffs: tuple[str, ...] = ()
    estop: bool = False


@dataclass(slots=True)
class BoardInput:
    """Content of received bytes.

    report: the newest report, None without one.  odometry: instead of it, of a board that does its own.
    n_reports: how many there were.  answer: bytes to send.
    ends_with_answer: the last packet wants the answer alone, unless start bytes are overdue.
    restarted: the board was restarted, so its counters began again.  yaw_rate: rad/s by a gyro, None without one.
    contacts: pressed bumpers, cliff sensors without floor, and the e-stop input; None where the board has none.
    """

    report: BoardReport | None = None
    odometry: BaseOdometry | None = None
    n_reports: int = 0
    answer: bytes = b""
    ends_with_answer: bool = False
    restarted: bool = False
    yaw_rate: float | None = None
    contacts: BoardContacts | None = None


class BoardDevice(Protocol):
    """A board's protocol as a state machine. It opens no port and reads no clock.

    - counts: counters of the line.
    - fault: fault that the board reports, for people; empty without one.
    - starts_again: whether a silent board must get `start_command` again before it reports.
    - supplies: V of board, motors and servos, degrees C of left, right motor driver and board; NaN unknown.
    """

    fault: str
    starts_again: bool

    @property
    def counts(self) -> LineCounts: ...

    @property
    def supplies(self) -> tuple[float, ...]: ...

    def warm_up(self) -> None:
        """Compiles the kernels."""

    def forget(self) -> None:
        """The port opened or closed: bytes and measurements from before do not count."""

    def start_command(self) -> bytes:
        """The bytes that configure the board, and let it report."""

    def receive(self, data: bytes, stamp: int, now: int) -> BoardInput:
        """Decodes bytes that arrived at `now` (ns). stamp: of their report, ns."""

    def command(self, left: float, right: float, now: int) -> bytes:
        """The bytes that command the wheels' speeds at `now` (ns), counts/s with the signs of BoardReport."""

    def stop_command(self) -> bytes:
        """The last bytes: the wheels stop, their power is switched off where the board can."""

    def dead_sensors(self, now: int) -> str:
        """Text of the range sensors that do not answer; empty if all do."""


class WheelDevice:
    """Base of boards with counters that rise when the robot drives forward, and without range sensors.

    WRAP: counts at which the board's counters return to 0.  NAME: of the board, for people.
    INVERTIBLE: whether the board commands each wheel by itself, so that `inverted` applies.
    """

    NAME = ""
    WRAP = 1 << 31
    INVERTIBLE = False
    starts_again = True

    def __init__(self, config: SerialBoardConfig, robot: Robot) -> None:
        self.config, self.drive = config, robot.drive
        if self.WRAP % self.drive.encoder_wrap:
            raise UserError(
                f"robot.drive.encoder_wrap: {self.drive.encoder_wrap} does not fit the board {self.NAME}",
                f"its counters return to 0 at {self.WRAP}: set robot.drive.encoder_wrap: {self.WRAP}",
            )
        if config.inverted and not self.INVERTIBLE:
            raise UserError(
                f"base_driver.board.inverted: the board {self.NAME} has no such setting",
                "exchange the wires of the motor, or set the direction in the board",
            )
        self.counts = LineCounts()
        self.fault = ""
        self.battery, self.currents = nan, np.zeros(2, np.float32)
        self._history: deque[tuple[float, int, int]] = deque()  # s on any clock, counts of left and right

    @property
    def supplies(self) -> tuple[float, ...]:
        return nan, self.battery, nan, nan, nan, nan

    def warm_up(self) -> None:
        """No kernel."""

    def forget(self) -> None:
        self._history.clear()
        self.fault = ""

    def dead_sensors(self, now: int) -> str:
        return ""

    def rim_speeds(self, left: float, right: float) -> tuple[float, float]:
        """m/s of the rims, positive forward, from the command's counts/s."""
        left_rad, right_rad = wheel_angles(left, right, self.drive)
        return left_rad * self.drive.left_radius, right_rad * self.drive.right_radius

    def body_velocity(self, left: float, right: float) -> tuple[float, float]:
        """v (m/s) and w (rad/s) from the command's counts/s."""
        left_rim, right_rim = self.rim_speeds(left, right)
        return (left_rim + right_rim) / 2, (right_rim - left_rim) / self.drive.wheel_distance

    def forward_counts(self, left: float, right: float) -> tuple[float, float]:
        """The command's counts/s as the board counts: positive forward, but for `inverted` wheels."""
        return -left * self._sign("left"), right * self._sign("right")

    def report(self, stamp: int, left: int, right: int, seconds: float) -> BoardReport:
        """A report from the board's counters. seconds: when they were read, on the board's clock or the stack's."""
        left, right = -left * self._sign("left"), right * self._sign("right")
        wrap = self.drive.encoder_wrap
        left, right = left % wrap, right % wrap
        left_speed, right_speed = self._speeds(seconds, left, right)
        return BoardReport(
            stamp=stamp,
            left_counts=left,
            right_counts=right,
            left_speed=left_speed,
            right_speed=right_speed,
            ultrasonic=NO_RANGES,
            infrared=NO_RANGES,
            battery=self.battery,
            currents=self.currents.copy(),
        )

    def _sign(self, wheel: str) -> int:
        return -1 if wheel in self.config.inverted else 1

    def _speeds(self, seconds: float, left: int, right: int) -> tuple[float, float]:
        """Counts/s over the last MIN_SPEED_STEP_S at least; 0 after a pause."""
        history = self._history
        if history and not 0 <= seconds - history[-1][0] <= MAX_SPEED_STEP_S:
            history.clear()
        history.append((seconds, left, right))
        while len(history) > 2 and seconds - history[1][0] >= MIN_SPEED_STEP_S:
            history.popleft()
        elapsed = seconds - history[0][0]
        if elapsed <= 0:
            return 0.0, 0.0
        wrap = self.drive.encoder_wrap
        steps = count_difference(history[0][1], left, wrap), count_difference(history[0][2], right, wrap)
        left_speed, right_speed = (min(max(n / elapsed, -MAX_COUNTS_PER_S), MAX_COUNTS_PER_S) for n in steps)
        return left_speed, right_speed


def bit_names(bits: int, names: dict[str, int]) -> tuple[str, ...]:
    """The names whose bit is set."""
    return tuple(name for name, bit in names.items() if bits & bit)
