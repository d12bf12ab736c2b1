# SPDX-License-Identifier: Apache-2.0
"""Warm-up of local control: a short drive on made-up messages compiles all kernels before the robot moves."""

from typing import TYPE_CHECKING

import numpy as np

from services.local_ctrl.config import CONTROLLERS, LocalCtrlConfig
from shared import sample_messages as sample
from shared.config import Robot
from shared.geometry import Pose2
from shared.messages import TILE_CELLS, Recovery, RecoveryKind

if TYPE_CHECKING:
    from services.local_ctrl.service import LocalCtrlService

NOW = 10**10  # ns


def drive_all(service: type["LocalCtrlService"], config: LocalCtrlConfig, robot: Robot) -> None:
    """Lets a service with each controller drive."""
    for controller in CONTROLLERS:
        drive(service(config.model_copy(update={"controller": controller}), robot))


def drive(service: "LocalCtrlService") -> None:
    """Gives a service one message of each kind, and lets it follow, turn and back up."""
    service.now = NOW
    cells = np.zeros((TILE_CELLS, TILE_CELLS), np.int8)
    cells[40] = 100  # a wall
    list(service.odometry(sample.odometry(NOW - 10**8)))
    list(service.odometry(sample.odometry(NOW)))
    list(service.scan(sample.scan(NOW, service.robot.laser)))
    list(service.ranges(sample.range_readings(NOW, len(service.robot.ranges))))
    list(service.pose(sample.pose_estimate(NOW)))
    list(service.map(sample.map_update(NOW, cells)))
    list(service.new_zones(sample.zones(NOW, -1.0, 1.0)))
    for goal_id, x in enumerate((1.0, -1.0)):  # ahead: follow; behind: turn in place
        list(service.new_goal(sample.goal(NOW, goal_id, Pose2(1.0))))
        list(service.new_plan(sample.path(NOW, goal_id, x)))
        list(service.tick())
    for order_id, kind in enumerate((RecoveryKind.BACK_UP, RecoveryKind.TURN), 2):
        list(service.new_recovery(Recovery(NOW, order_id, kind, 0.3)))
        list(service.tick())
