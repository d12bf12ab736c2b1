# SPDX-License-Identifier: Apache-2.0
"""Made-up messages of each kind, and a drive with them: all kernels compile before the robot moves."""

from math import pi
from typing import TYPE_CHECKING

import numpy as np

from shared import messages as m
from shared.config import Laser
from shared.geometry import Pose2
from shared.messages import TILE_CELLS, RecoveryKind

if TYPE_CHECKING:
    from services.local_ctrl.service import LocalCtrlService

NOW = 10**10  # ns


def odometry(stamp: int) -> m.Odometry:
    """Standing at the origin."""
    return m.Odometry(stamp, Pose2(), 0.0, 0.0, np.zeros(9))


def pose() -> m.PoseEstimate:
    """At the origin, with a good pose."""
    return m.PoseEstimate(NOW, Pose2(), Pose2(), np.zeros(9), 1.0, m.Localization.GOOD)


def scan(laser: Laser) -> m.LaserScan:
    """The laser's own number of beams, all ending 2 m away."""
    ranges = np.full(laser.n_beams, 2.0, np.float32)
    stamp = NOW - round(laser.scan_time * 1e9)
    return m.LaserScan(
        stamp, laser.angle_min, laser.angle_increment, laser.scan_time, laser.range_min, laser.range_max, ranges
    )


def readings(n: int) -> m.RangeReadings:
    """n sensors that look back and see 0.5 m: an obstacle ahead would keep the controllers from their kernels."""
    return m.RangeReadings(NOW, *(np.full(n, value, np.float32) for value in (-0.1, 0.0, pi, 0.5, 0.5)))


def map_update() -> m.MapUpdate:
    """One tile, free but for a wall."""
    cells = np.zeros((1, TILE_CELLS, TILE_CELLS), np.int8)
    cells[0, 40] = 100
    zero = np.zeros(1, np.int32)
    return m.MapUpdate(NOW, 1, 1, 0.05, zero, zero, cells.reshape(1, -1))


def zones() -> m.Zones:
    """A keep-out zone beside the robot, and a speed zone around it."""
    xs, ys = np.array([-1.0, -0.7, -0.7, -1.0]), np.array([1.0, 1.0, 1.3, 1.3])
    keep_out = m.Zone(0, "keep out", m.ZoneKind.KEEP_OUT, xs, ys)
    return m.Zones(NOW, (keep_out, m.Zone(0, "slow", m.ZoneKind.SLOW, 3.0 * xs + 2.0, 3.0 * ys - 3.5, 0.3)))


def goal(goal_id: int) -> m.Goal:
    """A metre ahead."""
    return m.Goal(NOW, goal_id, True, Pose2(1.0), 0.1, 0.1, False)


def path(goal_id: int, x: float) -> m.Path:
    """Straight to (x, 0)."""
    xs = np.linspace(0.0, x, 5)
    return m.Path(NOW, goal_id, 1, "", xs, np.zeros(5), np.zeros(5), abs(x), abs(x))


def drive(service: "LocalCtrlService") -> None:
    """Gives a service one message of each kind, and lets it follow, turn and back up."""
    service.now = NOW
    list(service.odometry(odometry(NOW - 10**8)))
    list(service.odometry(odometry(NOW)))
    list(service.scan(scan(service.robot.laser)))
    list(service.ranges(readings(len(service.robot.ranges))))
    list(service.pose(pose()))
    list(service.map(map_update()))
    list(service.new_zones(zones()))
    for goal_id, x in enumerate((1.0, -1.0)):  # ahead: follow; behind: turn in place
        list(service.new_goal(goal(goal_id)))
        list(service.new_plan(path(goal_id, x)))
        list(service.tick())
    for order_id, kind in enumerate((RecoveryKind.BACK_UP, RecoveryKind.TURN), 2):
        list(service.new_recovery(m.Recovery(NOW, order_id, kind, 0.3)))
        list(service.tick())
