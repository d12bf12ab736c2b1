# SPDX-License-Identifier: Apache-2.0
"""The `velocity` board: one line of text each way. docs/velocity_board.md has the protocol, firmware/ a board's side.

computer: $V,seq,v,w*CRC                                                  mm/s, mrad/s
board:    $T,seq,ms,ack,flags,battery,gyro,left,right*CRC                 mV, mrad/s, ticks
"""

from math import nan

import numpy as np

from services.base_driver.boards.board_config import SerialBoardConfig
from services.base_driver.boards.device import BoardContacts, BoardInput, WheelDevice
from shared.board_framing import LineFramer
from shared.config import Robot
from shared.geometry import Pose2, wrapped
from shared.messages import BaseOdometry
from shared.velocity_board import (
    COMMAND,
    POSE,
    SEQUENCES,
    TICK_WRAP,
    TICKS,
    BoardFlags,
    framed_line,
    line_fields,
)

N_FIELDS = {TICKS: 9, POSE: 12}
WRONG_KIND = "the board sends {}: set robot.drive.kind: {}"
SILENCE_NS = 1_000_000_000  # ns without a line after which any sequence number counts
MAX_OLD_LINES, MAX_OLD_MS = 50, 1000  # a line that is behind by less is old; by more, the board was restarted
MAX_VALUE = 1 << 31
MAX_YAW_RATE = 50.0  # rad/s; bound of Imu
BUMPERS = {"left": BoardFlags.BUMPER_LEFT, "front": BoardFlags.BUMPER_FRONT, "right": BoardFlags.BUMPER_RIGHT}
CLIFFS = {"left": BoardFlags.CLIFF_LEFT, "front": BoardFlags.CLIFF_FRONT, "right": BoardFlags.CLIFF_RIGHT}
MOTOR_FAULT = "the board reports a fault of its motor driver"


class VelocityBoard(WheelDevice):
    """Sends velocities; takes ticks. An old or repeated line is dropped."""

    NAME = "velocity"
    WRAP = TICK_WRAP
    starts_again = False  # it reports by itself

    def __init__(self, config: SerialBoardConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self._reader = LineFramer()
        self._sequence = 0
        self._last_sequence = 0  # of the last line
        self._last_at: int | None = None  # ns when it came; None: not since the port opened
        self._last_ms = 0  # of the last line, also from before the port closed: a smaller one is a restart

    def forget(self) -> None:
        super().forget()
        self._reader.forget()
        self._last_at = None

    def start_command(self) -> bytes:
        return self._velocity(0.0, 0.0)

    def command(self, left: float, right: float, now: int) -> bytes:
        return self._velocity(*self.body_velocity(left, right))

    def stop_command(self) -> bytes:
        return self._velocity(0.0, 0.0)

    def receive(self, data: bytes, stamp: int, now: int) -> BoardInput:
        received = BoardInput()
        for line in self._reader.lines(data):
            fields = line_fields(line)
            if fields is None or not self._decode(fields, stamp, now, received):
                self.counts.n_unreadable += fields is not None
                self.counts.n_bad += fields is None and b"*" in line
                self.counts.n_resyncs += 1
                self.counts.n_skipped += len(line)
        return received

    def _velocity(self, v: float, w: float) -> bytes:
        self._sequence = (self._sequence + 1) % SEQUENCES
        return framed_line(COMMAND, self._sequence, round(v * 1e3), round(w * 1e3))

    def _decode(self, fields: list[bytes], stamp: int, now: int, received: BoardInput) -> bool:
        """Adds a line's content; False where the line cannot be used."""
        try:
            kind, sequence, ms, flags = fields[0], int(fields[1]), int(fields[2]), BoardFlags(int(fields[4], 16))
            battery = int(fields[5]) * 1e-3 if fields[5] else nan
            yaw_rate = int(fields[6]) * 1e-3 if fields[6] else None
            values = [int(field) for field in fields[7:]]
        except (IndexError, ValueError):
            return False
        if len(fields) != N_FIELDS.get(kind, 0):
            return False
        self.counts.n_good += 1
        if self._is_old(sequence, ms, now):
            return True
        if ms < self._last_ms:
            received.restarted = True
            super().forget()
        self._last_sequence, self._last_ms, self._last_at = sequence, ms, now
        received.contacts = board_contacts(flags)
        received.yaw_rate = yaw_rate if yaw_rate is None or abs(yaw_rate) <= MAX_YAW_RATE else None
        self.battery = battery if 0 <= battery <= 100 else nan
        self.fault = MOTOR_FAULT if BoardFlags.MOTOR_FAULT in flags else ""
        if kind == TICKS:
            received.report = self.report(stamp, values[0], values[1], ms * 1e-3)
        else:
            received.odometry = base_odometry(stamp, values, self.battery)
        if (kind == POSE) != (self.drive.kind == "velocity"):
            self.fault = WRONG_KIND.format(*(("ticks", "differential") if kind == TICKS else ("poses", "velocity")))
        received.n_reports += 1
        return True

    def _is_old(self, sequence: int, ms: int, now: int) -> bool:
        """Whether a line at `now` (ns) repeats an earlier one: on a network datagrams come twice, and out of order."""
        if self._last_at is None or not 0 <= now - self._last_at < SILENCE_NS:
            return False
        return (self._last_sequence - sequence) % SEQUENCES < MAX_OLD_LINES and 0 <= self._last_ms - ms < MAX_OLD_MS


def board_contacts(flags: BoardFlags) -> BoardContacts:
    """The contacts that the flags of a line report."""
    bumpers, cliffs = (tuple(name for name, flag in table.items() if flag in flags) for table in (BUMPERS, CLIFFS))
    return BoardContacts(bumpers, cliffs, BoardFlags.ESTOP in flags)


def base_odometry(stamp: int, values: list[int], battery: float) -> BaseOdometry:
    """The odometry of a pose line: x, y (0.1 mm), yaw (0.1 mrad), v (mm/s), w (mrad/s). battery: V."""
    x, y, yaw, v, w = (min(max(value, -MAX_VALUE), MAX_VALUE) for value in values)
    twist = min(max(v * 1e-3, -20.0), 20.0), min(max(w * 1e-3, -50.0), 50.0)
    pose = Pose2(x * 1e-4, y * 1e-4, wrapped(yaw * 1e-4))
    return BaseOdometry(
        stamp=stamp,
        epoch=0,
        has_pose=True,
        odom_from_base=pose,
        has_twist=True,
        v=twist[0],
        vy=0.0,
        w=twist[1],
        covariance=np.zeros(9),
        twist_covariance=np.zeros(9),
        battery=battery,
    )
