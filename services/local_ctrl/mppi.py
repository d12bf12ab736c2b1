# SPDX-License-Identifier: Apache-2.0
"""Model predictive path integral control (Williams et al. 2017, IT-MPC), with critics in the manner of Nav2's MPPI.

The rollouts are noise around the last solution, and some that descend the cost to go. Each is simulated within the
drive's limits, scored by the critics, and averaged with weight exp(-cost / temperature). The average is over executed
velocities: the limits are convex, so the average keeps them.
"""

from math import atan2, cos, hypot, inf, sin, sqrt
from typing import ClassVar

import numpy as np
from numba import njit
from pydantic import Field

from services.local_ctrl.controller import (
    APPROACH_BRAKING_SHARE,
    NO_DYNAMIC_OBSTACLES,
    Controller,
    ControlScene,
    ControlSolution,
    EvaluatedRollouts,
)
from services.local_ctrl.cost_to_go import carrot, to_go_at
from services.local_ctrl.critics import Critics, Weights, dynamic_clearance, obstacle_cost, stopping_distance
from services.local_ctrl.dynamic_obstacles import predicted_discs
from services.local_ctrl.footprint import Footprint, circles_clearance, clearance, touches
from services.local_ctrl.rollout import (
    DT,
    Limits,
    arc_step,
    fill_rollout,
    limited_turn_rate,
    speed_after,
    turn_rate_after,
)
from shared.config import Section
from shared.types import Float32s, Float64s


class MppiConfig(Section):
    """Model predictive path integral control."""

    RENAMED: ClassVar[dict[str, str]] = {"least_speed": "min_speed_share", "mover_clearance": "dynamic_clearance"}

    rollouts: int = Field(1200, ge=64, le=20000, description="1: rollouts a tick, half to explore and half to refine")
    steps: int = Field(50, ge=10, le=200, description="1: steps of 1/20 s; 50 are 2.5 s")
    temperature: float = Field(
        0.03, ge=0.001, le=100, description="m: cost difference that divides a rollout's weight by e"
    )
    speed_noise: float = Field(0.35, ge=0.01, le=2, description="1: standard deviation over the top speed")
    turn_noise: float = Field(0.35, ge=0.01, le=2, description="1: standard deviation over the top turn rate")
    polish: float = Field(
        0.1, ge=0, le=1, description="1: share of the noise in the second half, around the result of the first"
    )
    seed: int = Field(1, ge=0, description="1: of the noise, which is generated once")
    clearance: float = Field(0.3, ge=0.02, le=3, description="m beyond the outline at which obstacles cost nothing")
    critical_clearance: float = Field(
        0.1, ge=0.01, le=1, description="m beyond the outline within which clearance has a high cost at any speed"
    )
    full_speed_clearance: float = Field(0.3, ge=0.02, le=3, description="m beyond the outline that allows full speed")
    min_speed_share: float = Field(0.25, ge=0.05, le=1, description="1: share of the top speed allowed at no clearance")
    dynamic_clearance: float = Field(
        0.6, ge=0.02, le=5, description="m beyond the outline at which dynamic obstacles cost nothing"
    )
    critics: Critics = Critics()


MIN_TURNING_SPEED_SHARE = 0.4  # of the speed of a robot that turns only while it drives
MAX_EXCESS = 20.0  # temperatures of cost over the cheapest rollout, beyond which another one has no weight
END_DISTANCE_M = 0.5  # from the end, beyond which the `goal` critic grows no more
N_GUESSES = 9  # rollouts without noise: the last solution, standstill, seven that descend the cost to go


class Mppi:
    """The MPPI controller. Between ticks it keeps the noise, generated once, and the last solution."""

    def __init__(self, config: MppiConfig, limits: Limits) -> None:
        self.config, self.limits = config, limits
        critics = config.critics.model_dump()
        rest = {k: getattr(config, k) for k in Weights._fields if k not in critics}
        self.weights = Weights(**critics, **rest)
        self.noise = _noise(config, limits)
        n = config.rollouts // 2
        self.targets = np.zeros((n, config.steps, 2), np.float32)
        self.executed = np.zeros_like(self.targets)
        self.costs, self.gains = np.zeros(n), np.zeros(n)
        self.reset()

    def reset(self) -> None:
        """Forgets the last solution."""
        self.mean = np.zeros((self.config.steps, 2))
        self.n_solved = 0
        self.predicted_obstacles = predicted_discs(NO_DYNAMIC_OBSTACLES, self.config.steps)

    def resume(self, before: Controller) -> None:
        """Continues from the last solution of another one."""
        if isinstance(before, Mppi):
            self.mean, self.n_solved = before.mean, before.n_solved

    def solve(self, scene: ControlScene, footprint: Footprint, n_elapsed: int) -> ControlSolution:
        """The velocities from now on. n_elapsed: steps of DT since the last call. Deterministic in the sequence of
        calls.
        """
        shift = min(max(n_elapsed, 0), self.config.steps)
        self.mean = np.concatenate((self.mean[shift:], np.repeat(self.mean[-1:], shift, axis=0)))
        self.n_solved += 1
        robots = scene.robots[np.minimum(np.arange(self.config.steps), len(scene.robots) - 1)]
        discs = predicted_discs(scene.dynamic_obstacles, self.config.steps)
        self.predicted_obstacles = np.concatenate((discs, robots), axis=1) if robots.shape[1] else discs
        # a step that shares no factor with the pool's size visits every start before it repeats
        start = (self.n_solved * 7919) % len(self.noise)
        _explore(self.mean, self.noise, start, scene, self.limits, self.targets)
        coarse = self._best_solution(scene, footprint)
        _polish(coarse.velocities, self.noise, start + len(self.targets), self.config.polish, self.targets)
        fine = self._best_solution(scene, footprint)
        self.mean = fine.velocities
        return fine

    def ahead(self, scene: ControlScene, look: float) -> tuple[float, float]:
        """The point `look` m down the cost to go, around obstacles on the plan."""
        x, y = carrot(scene.to_go, scene.x, scene.y, look, scene.resolution)
        return float(x), float(y)

    def evaluated_rollouts(self) -> EvaluatedRollouts:
        """The last solution, and the rollouts of the second half."""
        return EvaluatedRollouts(
            np.concatenate((self.mean[None], self.executed.astype(float))), np.append(self.costs.min(), self.costs)
        )

    def _best_solution(self, scene: ControlScene, footprint: Footprint) -> ControlSolution:
        """The weighted average of `targets`, or their best one: two paths around an obstacle may average into it."""
        excess = 1.001 * MAX_EXCESS * self.config.temperature
        outputs = self.executed, self.costs, self.gains
        _evaluate(self.targets, scene, self.predicted_obstacles, footprint, self.limits, self.weights, excess, *outputs)
        best = int(np.argmin(self.costs))
        velocities = _average(self.executed, self.costs, self.config.temperature)
        velocities, cost, gain = self._score(velocities, scene, footprint)
        if cost > self.costs[best]:
            velocities, cost, gain = self.executed[best].astype(float), float(self.costs[best]), float(self.gains[best])
        return ControlSolution(velocities, cost, cost >= 0.4 * self.weights.collision, gain)

    def _score(self, velocities: Float64s, scene: ControlScene, footprint: Footprint) -> tuple[Float64s, float, float]:
        executed = np.empty((1, *velocities.shape), np.float32)
        cost, gain = np.empty(1), np.empty(1)
        targets = velocities.astype(np.float32)[None]
        outputs = executed, cost, gain
        _evaluate(targets, scene, self.predicted_obstacles, footprint, self.limits, self.weights, inf, *outputs)
        return executed[0].astype(float), float(cost[0]), float(gain[0])


def _noise(config: MppiConfig, limits: Limits) -> Float32s:
    """(m, steps, 2): a constant and a random walk between knots, so that rollouts differ in where they go."""
    rng = np.random.default_rng(config.seed)
    n, n_knots = 2 * config.rollouts + 1, 6
    place = np.linspace(0, n_knots - 1, config.steps)
    low = np.minimum(place.astype(int), n_knots - 2)
    share = (place - low)[None, :, None]
    knots = rng.standard_normal((n, n_knots, 2))
    wave = knots[:, low] * (1 - share) + knots[:, low + 1] * share
    scale = (config.speed_noise * limits.v_max, config.turn_noise * limits.w_max)
    noise = (wave + 0.7 * rng.standard_normal((n, 1, 2))) * scale
    return np.ascontiguousarray(noise, np.float32)


@njit(cache=True, nogil=True)
def _explore(
    mean: Float64s, noise: Float32s, start: int, scene: ControlScene, limits: Limits, targets: Float32s
) -> None:
    n, steps, _ = targets.shape
    targets[0] = mean
    targets[1] = 0.0
    shares, looks = (1.0, 0.6, 0.3), (0.25, 0.5)
    for i in range(3):
        for j in range(2):
            _descend_cost_to_go(shares[i] * limits.v_max, looks[j], scene, limits, targets[2 + 2 * i + j])
    _descend_cost_to_go(-0.5 * limits.v_max, 0.3, scene, limits, targets[8])
    for k in range(N_GUESSES, n):
        row = noise[(start + k) % len(noise)]
        # two in three around the last solution, the rest around a guess
        if k % 3 < 2:
            for t in range(steps):
                targets[k, t, 0] = mean[t, 0] + row[t, 0]
                targets[k, t, 1] = mean[t, 1] + row[t, 1]
        else:
            guess = targets[1 + (k // 3) % (N_GUESSES - 1)]
            for t in range(steps):
                targets[k, t, 0] = guess[t, 0] + 0.5 * row[t, 0]
                targets[k, t, 1] = guess[t, 1] + 0.5 * row[t, 1]


@njit(cache=True, nogil=True)
def _polish(mean: Float64s, noise: Float32s, start: int, share: float, targets: Float32s) -> None:
    targets[0] = mean
    for k in range(1, len(targets)):
        targets[k] = mean + share * noise[(start + k) % len(noise)]


@njit(cache=True, nogil=True)
def _descend_cost_to_go(speed: float, look: float, scene: ControlScene, limits: Limits, targets: Float32s) -> None:
    """Fills commands that steer `look` m down the cost to go at `speed` (negative: back), turning before driving."""
    x, y, c, s = scene.x, scene.y, cos(scene.yaw), sin(scene.yaw)
    v, w = scene.v, scene.w
    for t in range(len(targets)):
        px, py = carrot(scene.to_go, x, y, look, scene.resolution)
        ahead, aside = c * (px - x) + s * (py - y), c * (py - y) - s * (px - x)
        away = hypot(px - x, py - y)
        if speed < 0.0:
            ahead, aside = -ahead, -aside
        error = atan2(aside, ahead) if away > 1e-6 else 0.0
        target_w = 2.5 * error
        target_v = speed * max(MIN_TURNING_SPEED_SHARE if limits.curvature < inf else 0.0, 1.0 - abs(error) / 0.9)
        if scene.ends:
            rest = hypot(scene.end_x - x, scene.end_y - y)
            most = sqrt(2.0 * APPROACH_BRAKING_SHARE * limits.braking * rest)
            target_v = min(max(target_v, -most), most)
        targets[t, 0], targets[t, 1] = target_v, target_w
        v, w = speed_after(v, target_v, limits, DT), turn_rate_after(w, target_w, limits, DT)
        w = limited_turn_rate(v, w, limits)
        chord, cosine, sine, _ = arc_step(v, w, DT)
        c, s = c * cosine - s * sine, s * cosine + c * sine
        x, y = x + chord * c, y + chord * s
        c, s = c * cosine - s * sine, s * cosine + c * sine


@njit(cache=True, nogil=True)
def _evaluate(
    targets: Float32s,
    scene: ControlScene,
    predicted_obstacles: Float64s,
    footprint: Footprint,
    limits: Limits,
    weights: Weights,
    excess: float,
    executed: Float32s,
    costs: Float64s,
    gains: Float64s,
) -> None:
    """Simulates targets (k, steps, 2) and fills executed velocities, costs, and reductions of the cost to go (m).

    predicted_obstacles: (steps, n, 3), see `predicted_discs`. excess: m. A rollout that is sure to cost more than this
    over the cheapest one before it is not scored to its end. It has the cost that is known, and no braking after
    contact.
    """
    n, steps, _ = targets.shape
    resolution = scene.resolution
    first = to_go_at(scene.to_go, scene.x, scene.y, resolution)
    c0, s0 = cos(scene.yaw), sin(scene.yaw)
    least = clearance(scene.field, resolution, scene.x, scene.y, c0, s0, footprint)
    # a robot that starts too near an obstacle may leave it, but not approach it
    starts_too_near = least <= footprint.padding and touches(
        scene.occupied, resolution, scene.x, scene.y, c0, s0, footprint
    )
    # taken out of a tuple in the loop, arrays would cost a count of references each time
    field, occupied, to_go_field, circles = scene.field, scene.occupied, scene.to_go, footprint.circles
    inscribed, circumscribed, padding = footprint.inscribed, footprint.circumscribed, footprint.padding
    motion, to_gos = np.empty((steps, 6)), np.empty(steps)
    fastest = max(limits.v_max, -limits.v_min, abs(scene.v))
    far_away = 1.001 * max(END_DISTANCE_M, fastest * fastest / (2.0 * APPROACH_BRAKING_SHARE * limits.braking))
    most = inf
    for k in range(n):
        _simulate(targets[k], scene.x, scene.y, c0, s0, scene.v, scene.w, limits, executed[k], motion)
        whole_to_go = 0.0
        for t in range(steps):
            to_gos[t] = to_go_at(to_go_field, motion[t, 0], motion[t, 1], resolution)
            whole_to_go += to_gos[t]
        # no critic is negative: a rollout costs these two at least, or a collision
        known = weights.progress * to_gos[-1] + weights.haste * whole_to_go / steps
        cost, mean_to_go, to_go = 0.0, 0.0, first
        met = False
        v_before, w_before = scene.v, scene.w
        for t in range(steps):
            if cost + known > most:
                to_go, mean_to_go = to_gos[-1], whole_to_go
                break
            x, y, c, s, v, w = motion[t, 0], motion[t, 1], motion[t, 2], motion[t, 3], motion[t, 4], motion[t, 5]
            room = circles_clearance(field, resolution, x, y, c, s, circles, circumscribed)
            if room <= padding:
                if starts_too_near:
                    hit = room < least - 0.005
                else:
                    hit = touches(occupied, resolution, x, y, c, s, footprint)
                if hit:
                    # half of it depends on the time: the later, the cheaper
                    cost += weights.collision * (1.0 - 0.5 * t / steps)
                    # beyond contact the plan brakes, as no drive stops within a step
                    fill_rollout(0.0, 0.0, v, w, limits, executed[k, t + 1 :])
                    mean_to_go += to_go * (steps - t)
                    break
            cost += DT * obstacle_cost(
                field, resolution, inscribed, circumscribed, limits, weights, x, y, c, s, v, room
            )
            if predicted_obstacles.shape[1]:
                ahead = stopping_distance(v, limits, weights)
                far = weights.dynamic_clearance
                away = dynamic_clearance(
                    predicted_obstacles[t], x, y, c, s, ahead if v >= 0.0 else -ahead, inscribed, circumscribed, far
                )
                later = 1.0 - 0.5 * t / steps  # predictions get less certain
                if away < 0.0 and not met:
                    met = True
                    cost += weights.dynamic_collision * later
                if away < weights.dynamic_clearance:
                    share = 1.0 - max(away, 0.0) / weights.dynamic_clearance
                    cost += DT * weights.dynamic_obstacle * later * share * share
            cost += DT * (weights.reverse * max(0.0, -v) + weights.twirl * w * w)
            dv, dw = (v - v_before) / (limits.braking * DT), (w - w_before) / (limits.turn_acceleration * DT)
            v_before, w_before = v, w
            cost += weights.smooth * DT * (dv * dv + dw * dw)
            to_go = to_gos[t]
            mean_to_go += to_go
            if scene.ends:
                cost += _end_cost(scene.end_x - x, scene.end_y - y, v, far_away, steps, limits, weights)
        costs[k] = cost + weights.progress * to_go + weights.haste * mean_to_go / steps
        if costs[k] + excess < min(most, 0.5 * weights.collision):
            most = costs[k] + excess
        gains[k] = first - to_go


@njit(cache=True, nogil=True, inline="always")
def _end_cost(dx: float, dy: float, v: float, far_away: float, steps: int, limits: Limits, weights: Weights) -> float:
    """The cost, m, of one of `steps` at a speed of v m/s, (dx, dy) m from the end; see `goal` and `overspeed`.

    far_away: m, from which the distance costs the most, and no speed is too high to stop there.
    """
    if dx * dx + dy * dy > far_away * far_away:
        return weights.goal * END_DISTANCE_M / steps
    away = hypot(dx, dy)
    over = max(0.0, abs(v) - sqrt(2.0 * APPROACH_BRAKING_SHARE * limits.braking * away))
    return weights.goal * min(away, END_DISTANCE_M) / steps + DT * weights.overspeed * over * over


@njit(cache=True, nogil=True)
def _simulate(
    targets: Float32s,
    x: float,
    y: float,
    c: float,
    s: float,
    v: float,
    w: float,
    limits: Limits,
    executed: Float32s,
    motion: Float64s,
) -> None:
    """Fills executed velocities and the motion (steps, 6): x, y, cosine and sine of the heading, v, w.

    Each step waits for the one before. The costs, in a loop of their own, do not.
    """
    for t in range(len(targets)):
        v, w = speed_after(v, targets[t, 0], limits, DT), turn_rate_after(w, targets[t, 1], limits, DT)
        w = limited_turn_rate(v, w, limits)
        executed[t, 0], executed[t, 1] = v, w
        chord, cosine, sine, _ = arc_step(v, w, DT)
        c, s = c * cosine - s * sine, s * cosine + c * sine
        x, y = x + chord * c, y + chord * s
        c, s = c * cosine - s * sine, s * cosine + c * sine
        motion[t, 0], motion[t, 1], motion[t, 2], motion[t, 3], motion[t, 4], motion[t, 5] = x, y, c, s, v, w


@njit(cache=True, nogil=True)
def _average(executed: Float32s, costs: Float64s, temperature: float) -> Float64s:
    """(steps, 2): the rollouts' velocities, weighted by exp(-(cost - least) / temperature)."""
    n, steps, _ = executed.shape
    least = costs.min()
    total = 0.0
    mean = np.zeros((steps, 2))
    for k in range(n):
        excess = (costs[k] - least) / temperature
        if excess > MAX_EXCESS:
            continue
        weight = np.exp(-excess)
        total += weight
        for t in range(steps):
            mean[t, 0] += weight * executed[k, t, 0]
            mean[t, 1] += weight * executed[k, t, 1]
    return mean / total
