# SPDX-License-Identifier: Apache-2.0
"""`zenav bench gyro`: the heading with and without gyro, over 100 m of simulated and of recorded drives.

The gyro is that of services/sim/imu.py. In a recorded log it measures the turns of the log's corrected trajectory, and
the wheels are those of its raw odometry. Between two scans both are taken as steady. The robot stands before the drive
only, so the bias is measured once: the worst case.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import ceil, degrees
from pathlib import Path
from typing import Any

import numpy as np

from services.base_driver.config import BaseDriverConfig
from services.base_driver.service import BaseDriverService
from services.odometry.dead_reckoning import DeadReckoningConfig
from services.odometry.service import OdometryService
from services.sim.config import SimConfig
from services.sim.imu import ImuNoise, SimulatedImu
from services.sim.service import SimService
from shared import topics
from shared.config import Robot, UserError, configured
from shared.geometry import Pose2, wrapped
from shared.messages import Imu, Truth, Velocity, WheelState
from shared.runners.lockstep import Lockstep
from zenav.bench.ground_truth_driver import GroundTruthDriver
from zenav.console.json_report import check_writable, write_report
from zenav.console.table import show_table
from zenav.convert.carmen import read_carmen
from zenav.convert.records import LoggedScan
from zenav.scenario.path_finder import PathFinder
from zenav.slam.slam_error import read_tum

LOGS = "intel-sparse", "aces-sparse", "fhw", "edmonton", "belgioioso"
"""Of slam/ in the data: those with a corrected trajectory."""
WINDOW_M, SPACING_M = 100.0, 5.0
MIN_IMPROVEMENT = 2.0  # factor by which the gyro lowers the mean error of all drives
COLUMNS = "drive", "driven, m", "by wheels, deg", "by gyro, deg", "slips"
STEP_S = 0.02
STAND_S = 5.0  # before a drive
MIN_SPEED, MAX_SPEED, MAX_TURN_RATE = 0.02, 1.0, 2.0  # m/s, m/s, rad/s: stamps that say otherwise are wrong
SIM_DRIVES = {
    "simulated x80sv": (),
    "the same, calibrated": ("sim.drive.radius_error=0", "sim.drive.distance_error=0"),
    "the same, calibrated, 5 times the slip": (
        "sim.drive.radius_error=0", "sim.drive.distance_error=0", "sim.drive.slip=0.1",
    ),
}  # fmt: skip
"""Name: settings. The wheels' errors are those of an uncalibrated robot otherwise."""
SIM_LENGTH_M = 250.0
SIM_COMMAND_S = 0.05
MAX_SIM_S = 1500.0


@dataclass(slots=True)
class Headings:
    """Travel (m), true heading, and headings by wheels and by gyro (rad), at each moment; the count of slips."""

    travel: list[float]
    truth: list[float]
    wheels: list[float]
    gyro: list[float]
    n_slips: int = 0

    def error(self, headings: list[float]) -> float:
        """Mean error of the turn over `WINDOW_M` m, degrees; NaN for a shorter drive."""
        travel = np.array(self.travel)
        starts = np.searchsorted(travel, np.arange(0.0, travel[-1] - WINDOW_M, SPACING_M))
        ends = np.searchsorted(travel, travel[starts] + WINDOW_M)
        differences = np.array(headings) - np.array(self.truth)
        pairs = [(i, j) for i, j in zip(starts, ends, strict=True) if j < len(travel)]
        errors = [degrees(abs(wrapped(float(differences[j] - differences[i])))) for i, j in pairs]
        return float(np.mean(errors)) if errors else float("nan")


def gyro(directory: Path | None, out: Path | None) -> int:
    """Shows the table, writes the JSON; 0 when the gyro lowers the mean error by `MIN_IMPROVEMENT`. Raises UserError.

    directory: of the logs; None: the simulated drives alone.
    """
    check_writable(out)
    report = gyro_errors(directory)
    show_table(f"heading, mean error over {WINDOW_M:.0f} m", COLUMNS, table_rows(report))
    write_report(out, report)
    return 0 if report["summary"]["kept"] else 1


def table_rows(report: dict[str, Any]) -> list[tuple[str, ...]]:
    """A line a drive."""
    return [
        (name, f"{r['driven_m']:.0f}", f"{r['wheels_deg']:.1f}", f"{r['gyro_deg']:.1f}", str(r["n_slips"]))
        for name, r in report["rows"].items()
    ]


def gyro_errors(logs: Path | None) -> dict[str, Any]:
    """Degrees over 100 m by the wheels and by the gyro, of each drive. Raises UserError."""
    robot = configured("x80sv", []).robot
    drives = {} if logs is None else {name: logged_drive(logs, name, robot) for name in LOGS}
    drives |= {name: simulated_drive(settings) for name, settings in SIM_DRIVES.items()}
    rows = {
        name: {
            "driven_m": round(drive.travel[-1], 1),
            "wheels_deg": drive.error(drive.wheels),
            "gyro_deg": drive.error(drive.gyro),
            "n_slips": drive.n_slips,
        }
        for name, drive in drives.items()
    }
    wheels, by_gyro = (float(np.mean([row[key] for row in rows.values()])) for key in ("wheels_deg", "gyro_deg"))
    kept = wheels >= MIN_IMPROVEMENT * by_gyro
    return {"summary": {"wheels_deg": wheels, "gyro_deg": by_gyro, "kept": kept}, "rows": rows}


def logged_drive(folder: Path, name: str, robot: Robot) -> Headings:
    """A recorded log with a corrected trajectory. Raises UserError where a file cannot be read."""
    scans = [r for r in read_carmen(folder / f"{name}.log.gz").records if isinstance(r, LoggedScan)]
    stamps, truth = read_tum(folder / f"{name}.ref.tum")
    at = {round(scan.stamp * 1e-9, 3): scan.odom_from_base for scan in scans}
    known = [(t, Pose2(*row), at[round(t, 3)]) for t, row in zip(stamps.tolist(), truth.tolist()) if round(t, 3) in at]
    if len(known) < 0.9 * len(stamps):
        raise UserError(f"{name}: {len(known)} of {len(stamps)} corrected poses are of a scan", "check the data folder")
    pair = Twins(robot)
    imu = SimulatedImu(ImuNoise(), np.random.default_rng([1, 10]))
    pair.go(imu, STAND_S, 0.0, 0.0, 0.0)
    for (t0, true0, odom0), (t1, true1, odom1) in pairwise(known):
        true_turn, moved = wrapped(true1.yaw - true0.yaw), odom0.inverse() @ odom1
        forward = np.copysign(np.hypot(moved.x, moved.y), moved.x)
        quickest = max(abs(forward) / MAX_SPEED, abs(moved.yaw) / MAX_TURN_RATE, 2 * STEP_S)
        seconds = min(max(t1 - t0, quickest), max(abs(forward) / MIN_SPEED, quickest))
        pair.go(imu, seconds, forward, moved.yaw, true_turn)
        pair.note(abs(forward))
    return pair.headings()


class Twins:
    """Odometry by the wheels and by the gyro, of one drive."""

    def __init__(self, robot: Robot) -> None:
        self.drive = robot.drive
        self.by_wheels, self.by_gyro = (
            OdometryService(DeadReckoningConfig.model_validate({"gyro": {"use": use}}), robot) for use in (False, True)
        )
        self.now, self.true_yaw, self.travelled = 10**9, 0.0, 0.0
        self.angles = [0.0, 0.0]
        self.noted = Headings([], [], [], [])

    def go(self, imu: SimulatedImu, seconds: float, forward: float, turn: float, true_turn: float) -> None:
        """Drives steadily: the wheels roll `forward` m and turn by `turn` rad, the robot turns by `true_turn` rad."""
        n = ceil(seconds / STEP_S)
        rolled = forward / n, turn / n * self.drive.wheel_distance / 2
        for _ in range(n):
            self.now += round(seconds / n * 1e9)
            self.true_yaw += true_turn / n
            self.angles[0] += (rolled[0] - rolled[1]) / self.drive.left_radius
            self.angles[1] += (rolled[0] + rolled[1]) / self.drive.right_radius
            self.take(imu.measure(self.now, self.true_yaw, forward / seconds))
            self.take(
                WheelState(
                    stamp=self.now, epoch=1, left=self.angles[0], right=self.angles[1], left_speed=0.0, right_speed=0.0
                )
            )

    def take(self, message: Imu | WheelState | None) -> None:
        """Gives a message to both."""
        for service in (self.by_wheels, self.by_gyro):
            if message is not None:
                service.now = message.stamp
                list(service.imu(message) if isinstance(message, Imu) else service.wheels(message))

    def note(self, travelled: float) -> None:
        """Notes the headings, `travelled` m after the last time."""
        self.travelled += travelled
        for column, value in (
            (self.noted.travel, self.travelled), (self.noted.truth, self.true_yaw),
            (self.noted.wheels, self.by_wheels.odom_from_base.yaw), (self.noted.gyro, self.by_gyro.odom_from_base.yaw),
        ):  # fmt: skip
            column.append(value)

    def headings(self) -> Headings:
        """All that was noted."""
        self.noted.n_slips = self.by_gyro.n_slips
        return self.noted


def simulated_drive(settings: Sequence[str]) -> Headings:
    """The simulated robot in the office, from room to room."""
    file = configured("x80sv", ["robot.imu={}", "sim.world=office", *settings])
    sim = SimService(file.section("sim", SimConfig), file.robot)
    services = {"sim": sim, "base_driver": BaseDriverService(BaseDriverConfig(), file.robot)}
    lockstep, pair = Lockstep(services), Twins(file.robot)
    newest: list[Truth] = []
    lockstep.watch(topics.TRUTH.key, lambda message: newest.append(message))
    lockstep.watch(topics.IMU.key, pair.take)
    lockstep.watch(topics.WHEELS.key, pair.take)
    driver, rng = GroundTruthDriver(PathFinder(sim.world, file.robot)), np.random.default_rng(1)

    def step(v: float, w: float) -> None:
        lockstep.publish(topics.CMD_VEL(Velocity(lockstep.now, v, w, "")), "guard")
        lockstep.run(SIM_COMMAND_S)
        truth = newest[-1]
        pair.true_yaw += wrapped(truth.world_from_base.yaw - pair.true_yaw)
        pair.note(truth.distance - pair.travelled)
        newest.clear()

    for _ in range(round(STAND_S / SIM_COMMAND_S)):
        step(0.0, 0.0)
    begun = lockstep.now
    while pair.travelled < SIM_LENGTH_M and lockstep.now - begun < MAX_SIM_S * 1e9:
        lockstep.run(STEP_S)
        if driver.go(driver.paths.random_pose(rng), newest[-1]):
            while newest and (command := driver.command(newest[-1], SIM_COMMAND_S)) is not None:
                step(*command)
                lockstep.run(STEP_S)
    return pair.headings()
