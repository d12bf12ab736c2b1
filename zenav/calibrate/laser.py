# SPDX-License-Identifier: Apache-2.0
"""`zenav calibrate laser`: the laser's pose on the robot, from a drive."""

import numpy as np

from shared.config import Robot
from shared.messages import LaserScan
from shared.types import Float64s
from zenav.calibrate.hand_eye import HandEyeSolution, MotionIntervals, residuals
from zenav.calibrate.log import CalibrationLog
from zenav.calibrate.odometry import mount_of
from zenav.calibrate.rolling import WheelGeometry, composed_poses
from zenav.render.chart import AFTER, BEFORE, Chart

SHOWN = 25  # scans whose points are drawn
TURNING = 1.5  # rad that these scans turn by, if the drive has it: a wrong mount shows when the robot turns


def rms(off: Float64s) -> tuple[float, float]:
    """m and rad, root mean square of residuals (n, 3); what the worst twentieth does (a slip) is left out."""
    distances, turns = np.sort(np.hypot(off[:, 0], off[:, 1])), np.sort(np.abs(off[:, 2]))
    n = max(1, round(0.95 * len(off)))
    return float(np.sqrt(np.mean(distances[:n] ** 2))), float(np.sqrt(np.mean(turns[:n] ** 2)))


def charts(log: CalibrationLog, robot: Robot, solution: HandEyeSolution, pieces: MotionIntervals) -> list[Chart]:
    """How far off each piece of the drive was, and the walls as the robot saw them, with the old mount and the new."""
    before = residuals(pieces, solution.wheels, mount_of(robot))
    spread = Chart("Each piece of the way: scans less wheels", "forward of the laser, mm", "to its left, mm", True)
    spread.dots(1e3 * before[:, 0], 1e3 * before[:, 1], BEFORE, "mount before")
    spread.dots(1e3 * solution.residuals[:, 0], 1e3 * solution.residuals[:, 1], AFTER, "mount after")
    scans = scans_while_turning(log, solution.wheels)
    walls = Chart("The walls while the robot turns", "x, m", "y, m", True)
    for mount, colour, name in ((mount_of(robot), BEFORE, "mount before"), (solution.mount, AFTER, "mount after")):
        points = scan_points(scans, log, solution.wheels, mount)
        walls.dots(points[:, 0], points[:, 1], colour, name)
    return [spread, walls]


def scans_while_turning(log: CalibrationLog, wheels: WheelGeometry) -> list[LaserScan]:
    """Some scans in a row, while the robot turns most."""
    stamps = np.array([scan.stamp for scan in log.scans], np.int64)
    poses = log.rolled.with_samples(stamps)
    yaws = poses.poses(wheels)[np.searchsorted(poses.stamps, stamps), 2]
    n = min(SHOWN, len(stamps))
    turned = np.abs(yaws[n - 1 :] - yaws[: len(yaws) - n + 1])
    enough = np.flatnonzero(turned > TURNING)
    first = int(enough[0]) if len(enough) else int(np.argmax(turned))
    return log.scans[first : first + n]


def scan_points(scans: list[LaserScan], log: CalibrationLog, wheels: WheelGeometry, mount: Float64s) -> Float64s:
    """(n, 2) m: the scans' points where wheels and mount put them, each beam at its own time."""
    points = []
    stamps = [s.stamp + np.linspace(0, s.scan_time * 1e9, len(s.ranges)).astype(np.int64) for s in scans]
    path = log.rolled.with_samples(np.unique(np.concatenate(stamps)))
    poses = path.poses(wheels)
    for scan, times in zip(scans, stamps):
        laser = composed_poses(poses[np.searchsorted(path.stamps, times)], mount)
        ranges = np.where((scan.ranges > scan.range_min) & (scan.ranges < scan.range_max), scan.ranges, np.nan)
        angles = scan.angle_min + scan.angle_increment * np.arange(len(ranges)) + laser[:, 2]
        points.append(laser[:, :2] + ranges[:, None] * np.column_stack((np.cos(angles), np.sin(angles))))
    stacked = np.concatenate(points)
    return np.asarray(stacked[np.isfinite(stacked).all(axis=1)])
