# SPDX-License-Identifier: Apache-2.0
"""The one interface behind every name of `local_ctrl.controller`: what a controller is given, and what it answers."""

from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from services.local_ctrl.footprint import Footprint
from services.local_ctrl.rollout import Limits

Bools = NDArray[np.bool_]
Float32s = NDArray[np.float32]
Float64s = NDArray[np.float64]

APPROACH_BRAKING_SHARE = 0.5  # share of the drive's braking that stopping at the goal counts on: the rest is for delay
NO_DYNAMIC_OBSTACLES = np.zeros((0, 6))


class ControlScene(NamedTuple):
    """What a controller meets. Positions are m from the centre of the costmap's lower left cell, as its start is."""

    field: Float32s  # (n, n) m to the nearest occupied cell
    occupied: Bools  # (n, n)
    resolution: float
    to_go: Float32s  # (n / 2, n / 2) m, see distance_to_go
    end_x: float
    end_y: float
    ends: bool  # the path's end is in the window
    x: float
    y: float
    yaw: float
    v: float
    w: float
    path: Float64s  # (k, 2) m, k > 0: the plan from beside the robot to (end_x, end_y)
    dynamic_obstacles: Float64s = NO_DYNAMIC_OBSTACLES  # (k, 6) of what moves, as the plan begins: see Movers.discs


class ControlSolution(NamedTuple):
    """velocities: (steps, 2) float64 m/s and rad/s, from the first step on; cost m; how much nearer it comes, m.

    Of a solution that collides nothing is driven: the robot brakes.
    """

    velocities: Float64s
    cost: float
    collides: bool
    gain: float


class EvaluatedRollouts(NamedTuple):
    """What the last call weighed up: velocities (k, steps, 2), of which the first were chosen, and costs (k,), m."""

    velocities: Float64s
    costs: Float64s


class Controller(Protocol):
    """Follows the path in a scene. Its velocities keep the drive's limits and accelerations from (v, w) on."""

    n_solved: int  # calls since the last reset
    limits: Limits  # of the next call: the speed may be less than the drive's, as in a speed zone

    def reset(self) -> None:
        """Forgets what it did: the next call starts from a stand."""

    def solve(self, scene: ControlScene, footprint: Footprint, n_elapsed: int) -> ControlSolution:
        """The velocities from now on. n_elapsed: steps of DT since the last call. Same calls, same bytes."""

    def ahead(self, scene: ControlScene, look: float) -> tuple[float, float]:
        """The point `look` m down the way that it drives: where a standing robot turns to."""

    def evaluated_rollouts(self) -> EvaluatedRollouts:
        """For people: what the last call weighed up."""
