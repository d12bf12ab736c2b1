# SPDX-License-Identifier: Apache-2.0
"""The interface of all controllers (`local_ctrl.controller`): the scene that they get, and the solution that they
return.

Its role is that of Nav2's `nav2_core::Controller`. Unlike there, a scene holds all inputs, so that a replay repeats
each solution.
"""

from typing import NamedTuple, Protocol

import numpy as np

from services.local_ctrl.footprint import Footprint
from services.local_ctrl.rollout import Limits
from shared.types import Bools, Float32s, Float64s

APPROACH_BRAKING_SHARE = 0.5  # of the drive's braking that stopping at the goal uses: the rest is reserve for delay
NO_DYNAMIC_OBSTACLES = np.zeros((0, 6))
NO_ROBOTS = np.zeros((1, 0, 3))


class ControlScene(NamedTuple):
    """Input of a controller. Positions are m from the centre of the costmap's lower left cell."""

    field: Float32s  # (n, n) m to the nearest occupied cell
    occupied: Bools  # (n, n)
    resolution: float  # m a cell
    to_go: Float32s  # (n / 2, n / 2) m, see cost_to_go
    end_x: float  # m, end of the path that the field leads to
    end_y: float
    ends: bool  # whether the path's end lies in the window
    x: float  # m, of the robot
    y: float
    yaw: float  # rad, in `odom`
    v: float  # m/s
    w: float  # rad/s
    path: Float64s  # (k, 2) m, k > 0: the plan from beside the robot to (end_x, end_y)
    dynamic_obstacles: Float64s = NO_DYNAMIC_OBSTACLES  # (k, 6) at the begin of the plan, see DynamicObstacles.discs
    robots: Float64s = NO_ROBOTS  # (t, k, 3) x, y, radius m of other robots after 1, 2, ... steps of DT


class ControlSolution(NamedTuple):
    """Planned velocities (steps, 2) float64 m/s and rad/s, their cost in m, and the reduction of the cost to go in m.

    Where `collides` is set, the robot brakes instead.
    """

    velocities: Float64s
    cost: float
    collides: bool
    gain: float


class EvaluatedRollouts(NamedTuple):
    """Rollouts of the last call: velocities (k, steps, 2), the chosen ones first, and costs (k,), m."""

    velocities: Float64s
    costs: Float64s


class Controller(Protocol):
    """Follows the path in a scene. Its velocities keep the drive's limits and accelerations from (v, w) on."""

    n_solved: int  # calls since the last reset
    limits: Limits  # of the next call; in a speed zone the speed is lower than the drive's

    def reset(self) -> None:
        """Forgets the last solution: the next call starts from standstill."""

    def resume(self, before: "Controller") -> None:
        """Continues from the last solution of a controller of the same class and size, with other settings."""

    def solve(self, scene: ControlScene, footprint: Footprint, n_elapsed: int) -> ControlSolution:
        """The velocities from now on. n_elapsed: steps of DT since the last call. Deterministic in the sequence of
        calls.
        """

    def ahead(self, scene: ControlScene, look: float) -> tuple[float, float]:
        """The point (x, y) m `look` m ahead on the controller's path, in the scene: a standing robot turns to it."""

    def evaluated_rollouts(self) -> EvaluatedRollouts:
        """The rollouts of the last call, for the debug topics."""
