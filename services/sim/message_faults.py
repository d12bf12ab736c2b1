# SPDX-License-Identifier: Apache-2.0
"""Faults of laser, board or clock in the messages `scan` and `hardware/board`: the table, and the changed messages."""

from collections.abc import Callable
from dataclasses import replace
from enum import StrEnum
from math import inf, nan, pi

import numpy as np
from numpy.typing import NDArray

from services.sim.hardware.faults import ActiveFaults
from shared.config import Mount, Robot
from shared.geometry import wrapped_all
from shared.lasers import lasers_by_topic
from shared.messages import BoardReport, Contacts, Imu, LaserScan
from shared.types import NS_PER_S, Float64s

DARK_HALF_ANGLE_RAD = pi / 6  # rad to either side of straight ahead that a dark sector covers
RETURN_SHARE = 0.05  # share of the beams that return while most do not
BODY_INSET_M = 0.02  # m inside the outline at which a part of the robot's own body is seen


class MessageFault(StrEnum):
    """What breaks, while the simulated hardware is messages (`sim.hardware: messages`)."""

    SCAN_NAN = "scan_nan"
    SCAN_MOSTLY_NAN = "scan_mostly_nan"
    SCAN_INF = "scan_inf"
    SCAN_DARK_AHEAD = "scan_dark_ahead"
    SCAN_BODY = "scan_body"
    SCAN_FROZEN = "scan_frozen"
    SCAN_BEAMS = "scan_beams"
    SCAN_SILENT = "scan_silent"
    SCAN_SECONDS = "scan_seconds"
    SCAN_1970 = "scan_1970"
    SCAN_LATE = "scan_late"
    SCAN_OLD = "scan_old"
    SCAN_AHEAD = "scan_ahead"
    SCAN_FUTURE = "scan_future"
    SCAN_2_NAN = "scan_2_nan"
    SCAN_2_FROZEN = "scan_2_frozen"
    SCAN_2_BEAMS = "scan_2_beams"
    SCAN_2_SILENT = "scan_2_silent"
    SCAN_2_OLD = "scan_2_old"
    ENCODER_JUMPS = "encoder_jumps"
    SONAR_DEAD = "sonar_dead"
    RANGES_MISSING = "ranges_missing"
    BUMPER = "bumper"
    CLIFF = "cliff"
    ESTOP_INPUT = "estop_input"
    CONTACTS_SILENT = "contacts_silent"
    IMU_SILENT = "imu_silent"
    IMU_OLD = "imu_old"
    BOARD_SECONDS = "board_seconds"
    BOARD_1970 = "board_1970"
    BOARD_LATE = "board_late"
    BOARD_OLD = "board_old"
    BOARD_AHEAD = "board_ahead"
    BOARD_FUTURE = "board_future"


MESSAGE_FAULT_DESCRIPTIONS: dict[MessageFault, str] = {
    MessageFault.SCAN_NAN: "no beam of the laser returns anything (NaN)",
    MessageFault.SCAN_MOSTLY_NAN: "19 of 20 beams return nothing (NaN)",
    MessageFault.SCAN_INF: "no beam returns anything, and the laser says +inf",
    MessageFault.SCAN_DARK_AHEAD: "60 degrees ahead return nothing (NaN)",
    MessageFault.SCAN_BODY: "the laser sees the robot's own body all around, as under a cover",
    MessageFault.SCAN_FROZEN: "the laser repeats its last ranges with fresh stamps",
    MessageFault.SCAN_BEAMS: "the laser sends every second beam only",
    MessageFault.SCAN_SILENT: "no scan comes",
    MessageFault.SCAN_SECONDS: "the scans' stamps are seconds, not nanoseconds",
    MessageFault.SCAN_1970: "the scans' stamps count from when the simulator started",
    MessageFault.SCAN_LATE: "the scans' stamps are 0.5 s old",
    MessageFault.SCAN_OLD: "the scans' stamps are 10 s old",
    MessageFault.SCAN_AHEAD: "the scans' stamps are 1 s ahead",
    MessageFault.SCAN_FUTURE: "the scans' stamps are 1 h ahead",
    MessageFault.SCAN_2_NAN: "no beam of the second laser returns anything (NaN)",
    MessageFault.SCAN_2_FROZEN: "the second laser repeats its last ranges with fresh stamps",
    MessageFault.SCAN_2_BEAMS: "the second laser sends every second beam only",
    MessageFault.SCAN_2_SILENT: "no scan of the second laser comes",
    MessageFault.SCAN_2_OLD: "the second laser's stamps are 10 s old",
    MessageFault.ENCODER_JUMPS: "the encoders count at random",
    MessageFault.SONAR_DEAD: "all ultrasonic sensors read 0",
    MessageFault.RANGES_MISSING: "the board sends one ultrasonic range fewer",
    MessageFault.BUMPER: "the first bumper of robot.bumpers is pressed",
    MessageFault.CLIFF: "the first cliff sensor of robot.cliffs sees no floor",
    MessageFault.ESTOP_INPUT: "the board's e-stop button is pressed",
    MessageFault.CONTACTS_SILENT: "bumpers, cliff sensors and e-stop input are not reported",
    MessageFault.IMU_SILENT: "the inertial sensor sends nothing",
    MessageFault.IMU_OLD: "the inertial sensor's stamps are 10 s old",
    MessageFault.BOARD_SECONDS: "the board's stamps are seconds, not nanoseconds",
    MessageFault.BOARD_1970: "the board's stamps count from when the simulator started",
    MessageFault.BOARD_LATE: "the board's stamps are 0.5 s old",
    MessageFault.BOARD_OLD: "the board's stamps are 10 s old",
    MessageFault.BOARD_AHEAD: "the board's stamps are 1 s ahead",
    MessageFault.BOARD_FUTURE: "the board's stamps are 1 h ahead",
}
"""Fault -> description."""

Restamp = Callable[[int, int], int]
"""(stamp, ns when the simulator started) -> the stamp that is sent."""


def _shift(seconds: float) -> Restamp:
    return lambda stamp, start: max(stamp + round(seconds * NS_PER_S), 0)


STAMPS: dict[str, Restamp] = {
    "seconds": lambda stamp, start: stamp // NS_PER_S,
    "1970": lambda stamp, start: max(stamp - start, 0),
    "late": _shift(-0.5),
    "old": _shift(-10.0),
    "ahead": _shift(1.0),
    "future": _shift(3600.0),
}
"""By the end of a fault's name."""


SECOND_LASER_FAULTS = frozenset(fault for fault in MessageFault if fault.startswith("scan_2_"))


class MessageFaults:
    """The active faults, and the messages changed by them. Random only by `seed`."""

    def __init__(self, robot: Robot, seed: int) -> None:
        self.robot = robot
        self.active = ActiveFaults()
        self._random = np.random.default_rng([seed, 9])
        self._last: dict[str, LaserScan] = {}  # by the topic's key
        self._lasers = {topic.key: laser for topic, laser in lasers_by_topic(robot).items()}
        self._start: int | None = None

    def scan(self, scan: LaserScan, key: str) -> LaserScan | None:
        """The scan as it is sent, or None where none is. key: of its topic, with which its faults begin."""
        self._start = scan.stamp if self._start is None else self._start
        if f"{key}_frozen" not in self.active:
            self._last[key] = scan
        if f"{key}_silent" in self.active:
            return None
        ranges = self._ranges(scan, key)
        stamp = self._stamp(key, scan.stamp)
        if f"{key}_beams" in self.active:
            increment = 2 * scan.angle_increment
            return replace(scan, stamp=stamp, angle_increment=increment, ranges=np.ascontiguousarray(ranges[::2]))
        return scan if ranges is scan.ranges and stamp == scan.stamp else replace(scan, stamp=stamp, ranges=ranges)

    def board(self, report: BoardReport) -> BoardReport:
        """The report as it is sent."""
        self._start = report.stamp if self._start is None else self._start
        stamp = self._stamp("board", report.stamp)
        if stamp != report.stamp:
            report = replace(report, stamp=stamp)
        if MessageFault.ENCODER_JUMPS in self.active:
            left, right = (int(n) for n in self._random.integers(self.robot.drive.encoder_wrap, size=2))
            report = replace(report, left_counts=left, right_counts=right)
        if MessageFault.SONAR_DEAD in self.active:
            report = replace(report, ultrasonic=np.zeros_like(report.ultrasonic))
        if MessageFault.RANGES_MISSING in self.active:
            report = replace(report, ultrasonic=report.ultrasonic[:-1].copy())
        return report

    def imu(self, imu: Imu | None) -> Imu | None:
        """The reading of the inertial sensor as it is sent, or None where none is."""
        if imu is None or MessageFault.IMU_SILENT in self.active:
            return None
        self._start = imu.stamp if self._start is None else self._start
        return replace(imu, stamp=self._stamp("imu", imu.stamp))

    def contacts(self, contacts: Contacts) -> Contacts | None:
        """The contacts as they are sent, or None where they are not."""
        if MessageFault.CONTACTS_SILENT in self.active:
            return None
        bumpers = self._with_first(MessageFault.BUMPER, contacts.bumpers, [b.name for b in self.robot.bumpers])
        cliffs = self._with_first(MessageFault.CLIFF, contacts.cliffs, [c.name for c in self.robot.cliffs])
        return replace(contacts, bumpers=bumpers, cliffs=cliffs, estop=MessageFault.ESTOP_INPUT in self.active)

    def _with_first(self, fault: MessageFault, names: tuple[str, ...], all_names: list[str]) -> tuple[str, ...]:
        """Names of triggered sensors, with the first of all while the fault is active."""
        return tuple(dict.fromkeys((*names, *all_names[:1]))) if fault in self.active else names

    def _ranges(self, scan: LaserScan, key: str) -> NDArray[np.float32]:
        """(n,) m: what the beams of a scan read under the faults."""
        n = len(scan.ranges)
        laser = self._lasers[key]
        if f"{key}_nan" in self.active:
            return np.full(n, nan, np.float32)
        if f"{key}_inf" in self.active:
            return np.full(n, inf, np.float32)
        if f"{key}_body" in self.active:
            return _own_body(scan, self.robot, laser.mount)
        if f"{key}_frozen" in self.active and key in self._last:
            return self._last[key].ranges
        if f"{key}_mostly_nan" in self.active:
            return np.where(self._random.random(n) < RETURN_SHARE, scan.ranges, np.float32(nan)).astype(np.float32)
        if f"{key}_dark_ahead" in self.active:
            ahead = np.abs(wrapped_all(_angles(scan) + laser.mount.yaw)) <= DARK_HALF_ANGLE_RAD
            return np.where(ahead, np.float32(nan), scan.ranges).astype(np.float32)
        return scan.ranges

    def _stamp(self, source: str, stamp: int) -> int:
        for name, restamp in STAMPS.items():
            if f"{source}_{name}" in self.active:
                return restamp(stamp, self._start or 0)
        return stamp


def _angles(scan: LaserScan) -> Float64s:
    """(n,) rad in `laser`."""
    return np.asarray(scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges)), np.float64)


def _own_body(scan: LaserScan, robot: Robot, mount: Mount) -> NDArray[np.float32]:
    """(n,) m from the laser to just inside the robot's outline; no nearer than the laser measures."""
    directions = _angles(scan) + mount.yaw
    dx, dy = np.cos(directions), np.sin(directions)
    nearest = np.full(len(directions), inf)
    for (x0, y0), (x1, y1) in zip(robot.corners, np.roll(robot.corners, -1, axis=0)):
        ex, ey = x1 - x0, y1 - y0
        crossing = dx * ey - dy * ex
        with np.errstate(divide="ignore", invalid="ignore"):
            along = ((x0 - mount.x) * ey - (y0 - mount.y) * ex) / crossing
            share = ((x0 - mount.x) * dy - (y0 - mount.y) * dx) / crossing
        hits = (np.abs(crossing) > 1e-12) & (along > 0) & (share >= 0) & (share <= 1)
        nearest = np.where(hits & (along < nearest), along, nearest)
    ranges = np.clip(nearest - BODY_INSET_M, scan.range_min, scan.range_max)
    return ranges.astype(np.float32)
