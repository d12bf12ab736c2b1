# SPDX-License-Identifier: Apache-2.0
"""Simulation of one pair of velocities: its end, its clearance, and whether the robot can stop before contact."""

from math import cos, hypot, inf, sin, sqrt
from typing import NamedTuple

from numba import njit

from services.local_ctrl.controller import APPROACH_BRAKING_SHARE, ControlScene
from services.local_ctrl.footprint import Footprint, clearance, touches
from services.local_ctrl.manoeuvres import MAX_CLEARANCE_LOSS_M
from services.local_ctrl.rollout import DT, Limits, arc_step, limited_turn_rate, speed_after, turn_rate_after

END_CUT_DISTANCE_M = 0.5  # from the path's end within which an arc that leads away from it is cut


class Arc(NamedTuple):
    """The end of an arc: before contact, beside the path's end, or at its time."""

    x: float  # m
    y: float
    c: float  # cosine and sine of the heading
    s: float
    v: float  # m/s and rad/s of its first step
    w: float
    room: float  # m, the least clearance on it
    contact: float  # s until contact, inf without
    seconds: float  # until it ends
    stops: bool  # whether the robot stops before contact when it runs the first step and then brakes


@njit(cache=True, nogil=True)
def simulated_arc(
    target_v: float,
    target_w: float,
    seconds: float,
    reaction: float,
    scene: ControlScene,
    limits: Limits,
    shape: Footprint,
) -> Arc:
    """Simulates a pair of target velocities (m/s, rad/s) within the limits for `seconds`.

    reaction: s before braking begins.

    The test of stopping is equation 14 of Fox, Burgard, Thrun 1997 (admissible velocities). It is in time instead of
    distance, so that it holds for turning in place as well.
    """
    x, y, c, s, v, w = scene.x, scene.y, cos(scene.yaw), sin(scene.yaw), scene.v, scene.w
    first_v, first_w = speed_after(v, target_v, limits, DT), turn_rate_after(w, target_w, limits, DT)
    first_w = limited_turn_rate(first_v, first_w, limits)
    least = clearance(scene.field, scene.resolution, x, y, c, s, shape)
    # a robot that starts too near an obstacle may leave it, but not approach it
    starts_too_near = least <= shape.padding and touches(scene.occupied, scene.resolution, x, y, c, s, shape)
    room, contact = inf, inf
    to_end = hypot(scene.end_x - x, scene.end_y - y)
    n_steps, n_run = max(1, round(seconds / DT)), 0
    for t in range(n_steps):
        v, w = speed_after(v, target_v, limits, DT), turn_rate_after(w, target_w, limits, DT)
        w = limited_turn_rate(v, w, limits)
        chord, cosine, sine, _ = arc_step(v, w, DT)
        next_c, next_s = c * cosine - s * sine, s * cosine + c * sine
        next_x, next_y = x + chord * next_c, y + chord * next_s
        next_c, next_s = next_c * cosine - next_s * sine, next_s * cosine + next_c * sine
        near = clearance(scene.field, scene.resolution, next_x, next_y, next_c, next_s, shape)
        room = min(room, near)
        if near <= shape.padding:
            if starts_too_near:
                hit = near < least - MAX_CLEARANCE_LOSS_M
            else:
                hit = touches(scene.occupied, scene.resolution, next_x, next_y, next_c, next_s, shape)
            if hit:
                contact = t * DT
                break
        if scene.ends:
            left = hypot(scene.end_x - next_x, scene.end_y - next_y)
            if left > to_end and to_end < END_CUT_DISTANCE_M and t > 0:
                break
            to_end = left
        x, y, c, s = next_x, next_y, next_c, next_s
        n_run += 1
    braking = max(abs(first_v) / limits.braking, abs(first_w) / limits.turn_acceleration)
    moves = first_v != 0.0 or first_w != 0.0
    stops = not moves or contact >= DT + reaction + 0.5 * braking
    return Arc(x=x, y=y, c=c, s=s, v=first_v, w=first_w, room=room, contact=contact, seconds=n_run * DT, stops=stops)


@njit(cache=True, nogil=True)
def max_speed_to_end(scene: ControlScene, limits: Limits) -> float:
    """The greatest speed, m/s, for a gentle stop at the path's end; inf where the end is not in view."""
    if not scene.ends:
        return inf
    return sqrt(2.0 * APPROACH_BRAKING_SHARE * limits.braking * hypot(scene.end_x - scene.x, scene.end_y - scene.y))
