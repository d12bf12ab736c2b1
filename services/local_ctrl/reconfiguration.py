# SPDX-License-Identifier: Apache-2.0
"""What local control makes from its settings: at its start, and again where they change while the robot runs."""

from typing import TYPE_CHECKING

from services.local_ctrl.config import CONTROLLERS, LocalCtrlConfig
from services.local_ctrl.footprint import Footprint
from services.local_ctrl.inputs import sensors_in_use
from services.local_ctrl.rollout import DT, Limits, limits_of

if TYPE_CHECKING:
    from services.local_ctrl.service import LocalCtrlService

WINDOW_MARGIN_M = 1.0  # of the costmap beyond the robot's centre at the end of the longest rollout, at least
OUTLINE_MARGIN_M = 0.5  # of the costmap beyond the robot's outline there, at least


def costmap_reach(config: LocalCtrlConfig, limits: Limits, footprint: Footprint) -> float:
    """m around the robot that the costmap must hold."""
    horizon = max(config.mppi.steps * DT, config.dwa.sim_time if config.controller == "dwa" else 0.0)
    travelled = limits.v_max * max(horizon, 0.5 * limits.v_max / limits.braking)
    return travelled + max(WINDOW_MARGIN_M, footprint.circumscribed + OUTLINE_MARGIN_M)


def reconfigure(service: "LocalCtrlService") -> None:
    """Takes the present settings of a service into its parts.

    The costmap keeps its size, because limits only fall, and its content. A new controller continues from the last
    solution of the one before, so the robot drives on without a stop.
    """
    config, robot = service.config, service.robot
    limits = service.limits = limits_of(robot.drive, config.max_speed, config.max_reverse_speed)
    service.estimate.limits, service.estimate.settling_time = limits, config.speed_settling
    service.costmap.configure(config.tracked_costmap)
    service.ranges_wanted, _ = sensors_in_use(robot, config.costmap)
    controller = CONTROLLERS[config.controller](config, limits)
    controller.resume(service.path_follower.controller)
    service.path_follower.configure(config.path_following, config.cost_to_go, controller, limits)
    if service.manoeuvre is not None:
        service.manoeuvre.config = config.manoeuvres
