# SPDX-License-Identifier: Apache-2.0
"""The emulated `velocity` board: takes velocities, sends its ticks in lines of text (docs/velocity_board.md)."""

from math import pi

from services.sim.hardware.electronics import BodyTruth, WheelElectronics
from services.sim.velocity_base import BaseOdometer
from shared.board_framing import LineFramer
from shared.config import Robot
from shared.messages import BoardReport
from shared.velocity_board import (
    COMMAND,
    POSE,
    SEQUENCES,
    TICK_WRAP,
    TICKS,
    BoardFlags,
    framed_line,
    is_newer,
    line_fields,
)

MS = 1_000_000
PERIOD_S = 0.02  # s between two lines


class VelocityElectronics(WheelElectronics):
    """Stands 200 ms after the last command. Drops a command that is not newer than the last one."""

    HAS_GYRO = HAS_CONTACTS = True
    LIFE_NS = 200 * MS
    WRAP = TICK_WRAP

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot)
        self._reader = LineFramer()
        self._sequence = 0
        self._accepted: int | None = None
        self._started_at: int | None = None  # ns
        self._odometer, self._angles = BaseOdometer(self.drive), (0.0, 0.0)  # rad of both wheels
        self._last_counts: tuple[int, int] | None = None

    def restart(self) -> None:
        super().restart()
        self._sequence, self._accepted, self._started_at = 0, None, None
        self._odometer, self._angles, self._last_counts = BaseOdometer(self.drive), (0.0, 0.0), None

    def receive(self, data: bytes, now: int) -> bytes:
        for line in self._reader.lines(data):
            fields = line_fields(line)
            if fields is not None and fields[0] == COMMAND and len(fields) == 4:
                sequence, v, w = (int(field) for field in fields[1:])
                is_first = self._accepted is None or self._until is None
                if is_first or is_newer(sequence, self._accepted or 0):
                    self._accepted = sequence
                    half = w * 1e-3 * self.drive.wheel_distance / 2
                    self.drive_wheels(v * 1e-3 - half, v * 1e-3 + half, now)
        return b""

    def packets(self, truth: BoardReport, body: BodyTruth, now: int) -> list[bytes]:
        self._started_at = now if self._started_at is None else self._started_at
        self._sequence = (self._sequence + 1) % SEQUENCES
        flags = BoardFlags(0) if self._until is not None else BoardFlags.WATCHDOG
        flags |= BoardFlags.ESTOP if body.estop else BoardFlags(0)
        for kind, names in (("BUMPER", body.bumpers), ("CLIFF", body.cliffs)):
            for name in names:
                flags |= BoardFlags.__members__.get(f"{kind}_{name.upper()}", BoardFlags(0))
        counts = self.counters(truth)
        values = self._pose(counts) if self.drive.kind == "velocity" else counts
        return [
            framed_line(
                POSE if self.drive.kind == "velocity" else TICKS,
                self._sequence,
                (now - self._started_at) // MS,
                self._accepted or 0,
                f"{flags:X}",
                round(truth.battery * 1e3) if truth.battery >= 0 else "",
                "" if body.yaw_rate is None else round(body.yaw_rate * 1e3),
                *values,
            )
        ]

    def _pose(self, counts: tuple[int, int]) -> tuple[int, ...]:
        """x, y (0.1 mm), yaw (0.1 mrad), v (mm/s) and w (mrad/s) by the board's own odometry, PERIOD_S apart."""
        before, self._last_counts = self._last_counts or counts, counts
        half = self.WRAP // 2
        rad = 2 * pi / self.drive.counts_per_turn
        left, right = (((now - last + half) % self.WRAP - half) * rad for now, last in zip(counts, before))
        self._angles = self._angles[0] + left, self._angles[1] + right
        speeds = left / PERIOD_S, right / PERIOD_S
        odometry = self._odometer.odometry(0, 0, self._angles, speeds)
        pose = odometry.odom_from_base
        return (
            round(pose.x * 1e4),
            round(pose.y * 1e4),
            round(pose.yaw * 1e4),
            round(odometry.v * 1e3),
            round(odometry.w * 1e3),
        )
