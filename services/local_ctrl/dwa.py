# SPDX-License-Identifier: Apache-2.0
"""The dynamic window approach (Fox, Burgard, Thrun 1997), with the settings and scores of move_base's DWA.

Each velocity that the drive reaches within the window is simulated for `sim_time`. Velocities without room to stop
before contact are dropped (equation 14). Of the rest the cheapest is driven: near the plan, far along it, with
clearance.
"""

from math import hypot, inf

import numpy as np
from numba import njit
from pydantic import Field

from services.local_ctrl.arcs import max_speed_to_end, simulated_arc
from services.local_ctrl.controller import Controller, ControlScene, ControlSolution, EvaluatedRollouts
from services.local_ctrl.cost_to_go import carrot, to_go_at
from services.local_ctrl.footprint import Footprint
from services.local_ctrl.rollout import DT, Limits, fill_rollout, speed_after, turn_rate_after
from shared.config import Section
from shared.types import Float64s


class DwaConfig(Section):
    """The dynamic window approach, its settings named as in move_base's dwa_local_planner."""

    sim_time: float = Field(1.7, ge=0.3, le=5, description="s of each simulated pair of velocities")
    window: float = Field(0.25, ge=0.05, le=2, description="s within which velocities must be reachable")
    vx_samples: int = Field(9, ge=2, le=100, description="1: number of sampled speeds")
    vth_samples: int = Field(25, ge=3, le=200, description="1: number of sampled turn rates")
    path_distance_bias: float = Field(32.0, ge=0, le=1000, description="1/m: distance from the plan")
    goal_distance_bias: float = Field(24.0, ge=0, le=1000, description="1/m: remaining distance")
    occdist_scale: float = Field(4.0, ge=0, le=1000, description="1: least allowed distance to an obstacle")
    clearance: float = Field(0.3, ge=0.02, le=3, description="m beyond the outline at which obstacles cost nothing")
    forward_point_distance: float = Field(
        0.325, ge=0, le=2, description="m ahead of the robot's origin: a point that should lie on the plan too"
    )
    stop_time_buffer: float = Field(
        0.25, ge=0, le=2, description="s before contact at which the robot must be able to begin braking"
    )
    reverse: float = Field(24.0, ge=0, le=1000, description="1/m: driving backward, where that is allowed")


class Dwa:
    """The dynamic window controller. Between ticks it keeps only the samples, for the debug topics."""

    def __init__(self, config: DwaConfig, limits: Limits) -> None:
        self.config, self.limits = config, limits
        self.samples = np.zeros((config.vx_samples * config.vth_samples + 1, 2))
        self.costs, self.gains = np.full(len(self.samples), inf), np.zeros(len(self.samples))
        self.n_solved, self.best = 0, 0
        self.before = 0.0, 0.0  # m/s, rad/s at the last call

    def reset(self) -> None:
        """Restarts the count of calls."""
        self.n_solved = 0

    def resume(self, before: Controller) -> None:
        """Continues the count of calls: it keeps no solution."""
        self.n_solved = before.n_solved

    def solve(self, scene: ControlScene, footprint: Footprint, n_elapsed: int) -> ControlSolution:
        self.n_solved += 1
        self.before = scene.v, scene.w
        c = self.config
        _window(scene, self.limits, c.window, (c.vx_samples, c.vth_samples), self.samples)
        biases = c.path_distance_bias, c.goal_distance_bias, c.occdist_scale, c.reverse
        lengths = c.sim_time, c.stop_time_buffer, c.clearance, c.forward_point_distance
        _score(self.samples, scene, self.limits, footprint, biases, lengths, self.costs, self.gains)
        self.best = int(np.argmin(self.costs))
        cost = float(self.costs[self.best])
        return ControlSolution(self._run(self.best), cost, cost == inf, float(self.gains[self.best]))

    def ahead(self, scene: ControlScene, look: float) -> tuple[float, float]:
        x, y = carrot(scene.to_go, scene.x, scene.y, look, scene.resolution)
        return float(x), float(y)

    def evaluated_rollouts(self) -> EvaluatedRollouts:
        free = [i for i in range(len(self.samples)) if np.isfinite(self.costs[i]) and i != self.best]
        chosen = [self.best, *free]
        return EvaluatedRollouts(np.array([self._run(i) for i in chosen]), self.costs[chosen])

    def _run(self, i: int) -> Float64s:
        velocities = np.empty((max(1, round(self.config.sim_time / DT)), 2))
        (v, w), (v_before, w_before) = self.samples[i], self.before
        fill_rollout(v, w, v_before, w_before, self.limits, velocities)
        return velocities


@njit(cache=True, nogil=True)
def _window(scene: ControlScene, limits: Limits, window: float, counts: tuple[int, int], samples: Float64s) -> None:
    """Fills samples (n, 2) with velocities reachable within `window` s, straight ahead among them; the last is zero."""
    n_v, n_w = counts
    low, high = speed_after(scene.v, limits.v_min, limits, window), speed_after(scene.v, limits.v_max, limits, window)
    high = min(high, max(low, max_speed_to_end(scene, limits)))
    left, right = (
        turn_rate_after(scene.w, limits.w_max, limits, window),
        turn_rate_after(scene.w, -limits.w_max, limits, window),
    )
    for i in range(n_v):
        for j in range(n_w):
            w = right + (left - right) * j / (n_w - 1)
            samples[i * n_w + j, 0] = low + (high - low) * i / (n_v - 1)
            samples[i * n_w + j, 1] = w
        # no grid over a moving window holds zero turn rate, so the nearest column takes it
        if right < 0.0 < left:
            nearest = round(-right / (left - right) * (n_w - 1))
            samples[i * n_w + nearest, 1] = 0.0
    samples[-1] = 0.0


@njit(cache=True, nogil=True)
def _score(
    samples: Float64s,
    scene: ControlScene,
    limits: Limits,
    shape: Footprint,
    biases: tuple[float, float, float, float],
    lengths: tuple[float, float, float, float],
    costs: Float64s,
    gains: Float64s,
) -> None:
    """Fills costs (n,), inf without room to stop before contact, and gains (n,), reduction of the cost to go, m."""
    path_bias, goal_bias, obstacle, reverse = biases
    seconds, buffer, clearance, forward = lengths
    first = to_go_at(scene.to_go, scene.x, scene.y, scene.resolution)
    # beside the path's end a point ahead of the robot lies beyond it
    looks_ahead = forward > 0.0 and not (
        scene.ends and hypot(scene.end_x - scene.x, scene.end_y - scene.y) < 2.0 * forward
    )
    for i in range(len(samples)):
        arc = simulated_arc(samples[i, 0], samples[i, 1], seconds, buffer, scene, limits, shape)
        if not arc.stops:
            costs[i], gains[i] = inf, 0.0
            continue
        to_go = to_go_at(scene.to_go, arc.x, arc.y, scene.resolution)
        beside, left = _distance_to_path(scene.path, arc.x, arc.y), to_go
        if looks_ahead:
            x, y = arc.x + forward * arc.c, arc.y + forward * arc.s
            beside = 0.5 * (beside + _distance_to_path(scene.path, x, y))
            left = 0.5 * (left + to_go_at(scene.to_go, x, y, scene.resolution))
        if arc.contact == inf:  # it came to the path's end early: the faster, the better
            left -= abs(samples[i, 0]) * (seconds - arc.seconds)
        near = 0.0 if arc.contact == inf and arc.room >= clearance else 1.0 - max(arc.room, 0.0) / clearance
        costs[i] = path_bias * beside + goal_bias * left + obstacle * near
        costs[i] += reverse * max(0.0, -samples[i, 0]) * seconds
        gains[i] = first - to_go


@njit(cache=True, nogil=True)
def _distance_to_path(path: Float64s, x: float, y: float) -> float:
    """m from (x, y) to the nearest of the path's points."""
    least = inf
    for k in range(len(path)):
        least = min(least, hypot(path[k, 0] - x, path[k, 1] - y))
    return least
