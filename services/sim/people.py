# SPDX-License-Identifier: Apache-2.0
"""Simulated pedestrians: they follow their routes, stop for the robot, walk around it, step back or turn back."""

from math import atan2, cos, hypot, inf, pi, sin
from typing import NamedTuple

import numpy as np
from numba import njit

from services.sim.contact import disc_touches_world
from services.sim.rays import Cells
from services.sim.world import Pedestrian
from shared.polygon_kernels import distance_to_polygon
from shared.types import Float64s, Int64s

N_PAUSES = 64  # random pauses of each person, then repeated
LOOK_AHEAD_M = 0.6  # m: look-ahead on the route
STEP_AHEAD_M = 0.3  # m: distance of the collision check
PERSONAL_SPACE_M = 0.4  # m to the robot at the checked point
MIN_PASSING_GAP_M = 0.12  # m to a blocking robot while walking around it
MIN_GAP_M = 0.1  # m to the robot; at less a person steps back
WAIT_S = 1.5  # s before walking around
STALL_TIME_S = 6.0  # s without progress to the waypoint before turning back
MIN_PROGRESS_M = 0.1  # m
N_PLACES = 20  # candidates for a person's start
MIN_START_DISTANCE_M = 2.0  # m between the starts of robot and person
ACCELERATION = 2.0  # m/s^2
MAX_DETOUR_M = 0.9  # m from the route, when walking around

X, Y, RADIUS, SPEED, PAUSE, BLOCKED, TARGET, WAY, NEAREST, STALLED = range(10)  # columns of People.state


class People(NamedTuple):
    """All people.

    - state: (p, 10), columns X to STALLED: x, y, radius m, speed m/s, pause left s, blocked for s, target
    - its last columns: direction +-1, minimum distance to the target so far m, time without progress s
    - routes: (p, k, 2) m, padded
    - lengths: (p,) number of waypoints
    - speeds: (p,) m/s
    - pauses: (p, N_PAUSES) s
    - n_pauses: (p,) number of pauses so far
    - reacts: whether people react to the robot
    """

    state: Float64s
    routes: Float64s
    lengths: Int64s
    speeds: Float64s
    pauses: Float64s
    n_pauses: Int64s
    reacts: bool


def initial_people(walks: tuple[Pedestrian, ...], reacts: bool, seed: int, robot: tuple[float, float]) -> People:
    """People at random points of their routes, with speeds within 10 % of the configured ones, by the seed.

    robot: (x, y) m, its start. No person starts near it; on a route entirely near it, at the farthest waypoint.
    """
    rng = np.random.default_rng([seed, 2])
    p, k = len(walks), max((len(w.route) for w in walks), default=1)
    people = People(
        state=np.zeros((p, 10)),
        routes=np.zeros((p, k, 2)),
        lengths=np.array([len(w.route) for w in walks], np.int64),
        speeds=np.array([w.speed * rng.uniform(0.9, 1.1) for w in walks], float),
        pauses=np.array([w.pause * rng.uniform(0.5, 1.5, N_PAUSES) for w in walks], float).reshape(p, N_PAUSES),
        n_pauses=np.zeros(p, np.int64),
        reacts=reacts,
    )
    for i, step_people in enumerate(walks):
        n = len(step_people.route)
        people.routes[i, :n] = step_people.route
        target = int(np.argmax(np.hypot(*(step_people.route - robot).T)))
        x, y = step_people.route[target]
        for leg, share in zip(rng.integers(n, size=N_PLACES), rng.uniform(size=N_PLACES)):
            there = step_people.route[leg - 1] + share * (step_people.route[leg] - step_people.route[leg - 1])
            if np.hypot(*(there - robot)) > MIN_START_DISTANCE_M:
                target, (x, y) = int(leg), there
                break
        people.state[i] = x, y, step_people.radius, 0.0, 0.0, 0.0, target, 1.0, np.inf, 0.0
    return people


@njit(cache=True, nogil=True)
def _route_target(people: People, i: int) -> tuple[float, float, float, float, float]:
    """Point ahead on the route of person i (x, y), distance to the waypoint, start of the route segment (x, y); m."""
    state, n = people.state[i], people.lengths[i]
    target = int(state[TARGET])
    bx, by = people.routes[i, target]
    ax, ay = people.routes[i, (target - int(state[WAY])) % n]
    length = hypot(bx - ax, by - ay)
    if length < 1e-9:
        return bx, by, hypot(bx - state[X], by - state[Y]), ax, ay
    done = ((state[X] - ax) * (bx - ax) + (state[Y] - ay) * (by - ay)) / length
    ahead = min(max(done, 0.0) + LOOK_AHEAD_M, length)
    left = hypot(bx - state[X], by - state[Y])
    return ax + ahead * (bx - ax) / length, ay + ahead * (by - ay) / length, left, ax, ay


@njit(cache=True, nogil=True)
def _is_free(
    people: People, i: int, x: float, y: float, robot: Float64s, cells: Cells, distance: float, now: float
) -> bool:
    """Whether person i may stand at (x, y): no wall, no person, and `distance` m to the robot, or more than `now`."""
    radius = people.state[i, RADIUS]
    to_robot = distance_to_polygon(robot, x, y) - radius
    if to_robot < distance and to_robot <= now:
        return False
    for j in range(len(people.state)):
        if j != i:
            other = people.state[j]
            far = hypot(other[X] - x, other[Y] - y) - radius - other[RADIUS]
            before = hypot(other[X] - people.state[i, X], other[Y] - people.state[i, Y]) - radius - other[RADIUS]
            if far < 0.05 and far <= before:
                return False
    return not disc_touches_world(x, y, radius, cells)


@njit(cache=True, nogil=True)
def _retreat_direction(people: People, i: int, robot: Float64s, cells: Cells, now: float) -> tuple[float, float, float]:
    """Direction away from the robot, or aside if that is blocked, as `_walking_direction`; now: m to the robot."""
    state = people.state[i]
    away = atan2(state[Y] - robot[:, 1].mean(), state[X] - robot[:, 0].mean())
    for turn in (0.0, pi / 4, -pi / 4, pi / 2, -pi / 2):
        ux, uy = cos(away + turn), sin(away + turn)
        if _is_free(people, i, state[X] + MIN_GAP_M * ux, state[Y] + MIN_GAP_M * uy, robot, cells, MIN_GAP_M, now):
            return ux, uy, 0.6
    return 0.0, 0.0, 0.0


@njit(cache=True, nogil=True)
def _walking_direction(people: People, i: int, robot: Float64s, cells: Cells) -> tuple[float, float, float]:
    """Direction (x, y) of person i, and the share of the walking speed; 0 if every direction is blocked."""
    state = people.state[i]
    hx, hy, left, ax, ay = _route_target(people, i)
    to_target = max(hypot(hx - state[X], hy - state[Y]), 1e-6)
    ux, uy = (hx - state[X]) / to_target, (hy - state[Y]) / to_target
    if not people.reacts:
        return ux, uy, 1.0
    now = distance_to_polygon(robot, state[X], state[Y]) - state[RADIUS]
    if now < MIN_GAP_M:
        return _retreat_direction(people, i, robot, cells, now)
    step = min(STEP_AHEAD_M, left)
    if now > PERSONAL_SPACE_M + LOOK_AHEAD_M:
        open_ahead = _is_free(
            people, i, state[X] + STEP_AHEAD_M * ux, state[Y] + STEP_AHEAD_M * uy, robot, cells, 0.0, now
        )
        if open_ahead or state[BLOCKED] < WAIT_S:
            return ux, uy, 1.0 if open_ahead else 0.0
    elif _is_free(people, i, state[X] + step * ux, state[Y] + step * uy, robot, cells, PERSONAL_SPACE_M, now):
        return ux, uy, min(1.0, 0.4 + now)
    if state[BLOCKED] < WAIT_S:
        return 0.0, 0.0, 0.0
    for k in range(1, 5):
        for side in (-1.0, 1.0):
            turn = side * k * pi / 8
            vx, vy = cos(turn) * ux - sin(turn) * uy, sin(turn) * ux + cos(turn) * uy
            x, y = state[X] + STEP_AHEAD_M * vx, state[Y] + STEP_AHEAD_M * vy
            length = hypot(hx - ax, hy - ay)
            off = abs((x - ax) * (hy - ay) - (y - ay) * (hx - ax)) / length if length > 1e-6 else 0.0
            if off < MAX_DETOUR_M and _is_free(people, i, x, y, robot, cells, MIN_PASSING_GAP_M, now):
                return vx, vy, 0.6
    return 0.0, 0.0, 0.0


@njit(cache=True, nogil=True)
def _next_waypoint(people: People, i: int) -> None:
    """Sets the target of person i to the next waypoint."""
    state = people.state[i]
    state[TARGET] = (int(state[TARGET]) + int(state[WAY])) % people.lengths[i]
    state[NEAREST], state[STALLED], state[BLOCKED] = inf, 0.0, 0.0


@njit(cache=True, nogil=True)
def step_people(people: People, robot: Float64s, cells: Cells, dt: float) -> bool:
    """Moves all people by `dt` s; returns whether a person ran into the robot.

    robot: (k, 2) m, corners of its footprint in the world. A step that would overlap a wall or the robot is not taken.
    """
    hit = False
    for i in range(len(people.state)):
        state = people.state[i]
        if state[PAUSE] == inf:  # a disc of another robot: other_robots.py
            continue
        steps_back = people.reacts and distance_to_polygon(robot, state[X], state[Y]) - state[RADIUS] < MIN_GAP_M
        if state[PAUSE] > 0.0 and not steps_back:
            state[PAUSE] -= dt
            state[SPEED] = 0.0
            continue
        _, _, left, _, _ = _route_target(people, i)
        if left < 0.1 and not steps_back:
            _next_waypoint(people, i)
            state[PAUSE] = people.pauses[i, people.n_pauses[i] % N_PAUSES]
            people.n_pauses[i] += 1
            continue
        ux, uy, share = _walking_direction(people, i, robot, cells)
        wanted = share * people.speeds[i]
        state[SPEED] = min(wanted, state[SPEED] + ACCELERATION * dt)
        x, y = state[X] + state[SPEED] * dt * ux, state[Y] + state[SPEED] * dt * uy
        before = distance_to_polygon(robot, state[X], state[Y])
        bumps = distance_to_polygon(robot, x, y) <= state[RADIUS] and distance_to_polygon(robot, x, y) <= before
        moves = state[SPEED] > 0.0 and not bumps and not disc_touches_world(x, y, state[RADIUS], cells)
        hit |= bumps and state[SPEED] > 0.0
        if moves:
            state[X], state[Y] = x, y
        else:
            state[SPEED] = 0.0
        state[BLOCKED] = max(0.0, state[BLOCKED] - dt) if moves and share > 0.9 else state[BLOCKED] + (not moves) * dt
        state[STALLED] += dt
        if left < state[NEAREST] - MIN_PROGRESS_M:
            state[NEAREST], state[STALLED] = left, 0.0
        if state[STALLED] > STALL_TIME_S:
            state[WAY] = -state[WAY]
            _next_waypoint(people, i)
    return hit
