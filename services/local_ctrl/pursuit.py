# SPDX-License-Identifier: Apache-2.0
"""Regulated pure pursuit (Macenski, Singh, Martin, Gines 2023), with the settings of Nav2's controller of that name.

The robot drives the arc to a point of the plan ahead, slower in tight bends, near obstacles and before the end. It
never leaves the plan: before an obstacle on it the robot slows down, stops and waits for another plan.
"""

from math import cos, hypot, sin

import numpy as np
from numba import njit
from pydantic import Field

from services.local_ctrl.arcs import Arc, max_speed_to_end, simulated_arc
from services.local_ctrl.controller import Controller, ControlScene, ControlSolution, EvaluatedRollouts
from services.local_ctrl.cost_to_go import to_go_at
from services.local_ctrl.footprint import Footprint, clearance
from services.local_ctrl.rollout import DT, Limits, fill_rollout, speed_after
from shared.config import Section
from shared.types import Float64s

N_SPEEDS = 10  # tested on a blocked arc, from the wanted one down to zero
MIN_SPEED = 1e-3  # m/s, for the time that an arc takes
MIN_LOOKAHEAD_M = 0.02  # a nearer point has no direction


class PursuitConfig(Section):
    """Regulated pure pursuit, its settings named as in Nav2."""

    lookahead_time: float = Field(1.5, ge=0.1, le=10, description="s at the present speed to the lookahead point")
    min_lookahead_dist: float = Field(0.3, ge=0.05, le=5, description="minimum m to it")
    max_lookahead_dist: float = Field(0.9, ge=0.05, le=20, description="maximum m to it")
    regulated_linear_scaling_min_radius: float = Field(
        0.9, ge=0, le=20, description="m: in bends tighter than this the speed falls with the radius"
    )
    cost_scaling_dist: float = Field(
        0.3, ge=0.01, le=5, description="m beyond the outline: with an obstacle nearer than this the speed falls"
    )
    cost_scaling_gain: float = Field(1.0, gt=0, le=1, description="1: speed there, over the distance; less is slower")
    regulated_linear_scaling_min_speed: float = Field(
        0.25, ge=0.01, le=5, description="m/s that bends and obstacles beside the path leave at least"
    )
    max_allowed_time_to_collision_up_to_carrot: float = Field(
        1.5, ge=0.2, le=10, description="s that the arc must be free ahead, or the robot slows down"
    )
    stop_time_buffer: float = Field(
        0.25, ge=0, le=2, description="s before contact at which the robot must be able to begin braking"
    )


class Pursuit:
    """The pure pursuit controller. Between ticks it keeps only the driven velocities, for the debug topics."""

    def __init__(self, config: PursuitConfig, limits: Limits) -> None:
        self.config, self.limits = config, limits
        self.n_solved, self.cost = 0, 0.0
        self.velocities = np.zeros((max(1, round(config.max_allowed_time_to_collision_up_to_carrot / DT)), 2))

    def reset(self) -> None:
        """Restarts the count of calls."""
        self.n_solved = 0

    def resume(self, before: Controller) -> None:
        """Continues the count of calls: it keeps no solution."""
        self.n_solved = before.n_solved

    def solve(self, scene: ControlScene, footprint: Footprint, n_elapsed: int) -> ControlSolution:
        self.n_solved += 1
        c = self.config
        looks = c.lookahead_time, c.min_lookahead_dist, max(c.min_lookahead_dist, c.max_lookahead_dist)
        regulation = (
            c.regulated_linear_scaling_min_radius,
            c.cost_scaling_dist,
            c.cost_scaling_gain,
            c.regulated_linear_scaling_min_speed,
        )
        stops = c.max_allowed_time_to_collision_up_to_carrot, c.stop_time_buffer
        v, w, arc = _pursue(scene, self.limits, footprint, looks, regulation, stops)
        self.velocities = np.empty_like(self.velocities)
        fill_rollout(v, w, scene.v, scene.w, self.limits, self.velocities)
        left = to_go_at(scene.to_go, arc.x, arc.y, scene.resolution)
        gain = to_go_at(scene.to_go, scene.x, scene.y, scene.resolution) - left
        self.cost = float(left)
        return ControlSolution(self.velocities, self.cost, not arc.stops, float(gain))

    def ahead(self, scene: ControlScene, look: float) -> tuple[float, float]:
        x, y = lookahead_point(scene.path, scene.x, scene.y, look)
        return float(x), float(y)

    def evaluated_rollouts(self) -> EvaluatedRollouts:
        return EvaluatedRollouts(self.velocities[None], np.array([self.cost]))


@njit(cache=True, nogil=True)
def _pursue(
    scene: ControlScene,
    limits: Limits,
    shape: Footprint,
    looks: tuple[float, float, float],
    regulation: tuple[float, float, float, float],
    stops: tuple[float, float],
) -> tuple[float, float, Arc]:
    """The target velocities, m/s and rad/s, and their arc."""
    seconds, buffer = stops
    c, s = cos(scene.yaw), sin(scene.yaw)
    look = min(max(abs(scene.v) * looks[0], looks[1]), looks[2])
    x, y = lookahead_point(scene.path, scene.x, scene.y, look)
    ahead, aside = c * (x - scene.x) + s * (y - scene.y), c * (y - scene.y) - s * (x - scene.x)
    away = hypot(ahead, aside)
    if away < MIN_LOOKAHEAD_M or (ahead < 0.0 and limits.v_min == 0.0):
        stand = simulated_arc(0.0, 0.0, seconds, buffer, scene, limits, shape)
        return 0.0, 0.0, stand
    curvature = min(max(2.0 * aside / (away * away), -limits.curvature), limits.curvature)
    room = clearance(scene.field, scene.resolution, scene.x, scene.y, c, s, shape)
    speed = _regulated_speed(curvature, room, limits, regulation)
    if ahead < 0.0:
        # the point lies behind without room to turn: the robot backs up to it
        speed = min(speed, -limits.v_min)
    speed = min(speed, max_speed_to_end(scene, limits))
    if abs(curvature) * speed > limits.w_max:
        speed = limits.w_max / abs(curvature)
    way = 1.0 if ahead >= 0.0 else -1.0
    for i in range(N_SPEEDS):
        # the curvature is kept while the speed changes, so the next step's speed is tested
        v = speed_after(scene.v, way * speed * (1.0 - i / N_SPEEDS), limits, DT)
        w = v * curvature
        arc = simulated_arc(v, w, min(seconds, away / max(abs(v), MIN_SPEED)), buffer, scene, limits, shape)
        if arc.stops:
            return v, w, arc
    return 0.0, 0.0, simulated_arc(0.0, 0.0, seconds, buffer, scene, limits, shape)


@njit(cache=True, nogil=True)
def _regulated_speed(
    curvature: float, room: float, limits: Limits, regulation: tuple[float, float, float, float]
) -> float:
    """The lower of the two regulated speeds, m/s: curvature and proximity, equations 4 and 5 of the article."""
    radius, distance, gain, least = regulation
    speed = limits.v_max
    if abs(curvature) * radius > 1.0:
        speed = min(speed, limits.v_max / (abs(curvature) * radius))
    if room < distance:
        speed = min(speed, limits.v_max * gain * max(room, 0.0) / distance)
    return min(limits.v_max, max(speed, least))


@njit(cache=True, nogil=True)
def lookahead_point(path: Float64s, x: float, y: float, look: float) -> tuple[float, float]:
    """Where the path (k, 2) m first is `look` m away from (x, y) m, between its points; its end where it never is."""
    before = hypot(path[0, 0] - x, path[0, 1] - y)
    if before >= look:
        return path[0, 0], path[0, 1]
    for k in range(1, len(path)):
        away = hypot(path[k, 0] - x, path[k, 1] - y)
        if away >= look:
            # between close points the distance grows linearly
            share = (look - before) / max(away - before, 1e-9)
            px = path[k - 1, 0] + share * (path[k, 0] - path[k - 1, 0])
            return px, path[k - 1, 1] + share * (path[k, 1] - path[k - 1, 1])
        before = away
    return path[-1, 0], path[-1, 1]
