# SPDX-License-Identifier: Apache-2.0
"""People who walk their routes round and round, stop before the robot, walk around it, step or turn back."""

from math import atan2, cos, hypot, inf, pi, sin
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from services.sim.contact import disc_touches_world, gap
from services.sim.rays import Cells
from services.sim.world import Walk

Float64s = NDArray[np.float64]
Int64s = NDArray[np.int64]

N_PAUSES = 64  # drawn ahead a person; then they repeat
LOOK = 0.6  # m: how far ahead on the way a person heads for
STEP = 0.3  # m: how far ahead a person checks the ground
PERSONAL_SPACE = 0.4  # m that a person keeps to the robot a STEP ahead
SQUEEZE = 0.12  # m: what a person leaves when walking around a robot that stands in the way
TOO_CLOSE = 0.1  # m to the robot: a person who is nearer steps back
WAITS = 1.5  # s before walking around
TURNS_BACK = 6.0  # s without coming closer to the waypoint before turning back
PROGRESS = 0.1  # m that count as coming closer
N_PLACES = 20  # tried for the start of a person
APART = 2.0  # m from the robot's start to a person's
ACCELERATION = 2.0  # m/s^2
STRAYS = 0.9  # m off the way at most, when walking around

X, Y, RADIUS, SPEED, PAUSE, BLOCKED, TARGET, WAY, NEAREST, STALLED = range(10)  # columns of People.state


class People(NamedTuple):
    """All people. state: (p, 10) x, y, radius m, speed m/s, pause left s, blocked for s, target waypoint, way +-1,
    nearest to the target so far m, not nearer since s.

    routes: (p, k, 2) m, padded.  lengths: (p,) waypoints.  speeds: (p,) m/s.  pauses: (p, N_PAUSES) s.
    n_pauses: (p,) taken so far.  reacts: whether they heed the robot.
    """

    state: Float64s
    routes: Float64s
    lengths: Int64s
    speeds: Float64s
    pauses: Float64s
    n_pauses: Int64s
    reacts: bool


def started(walks: tuple[Walk, ...], reacts: bool, seed: int, robot: tuple[float, float]) -> People:
    """People somewhere on their routes, each a little faster or slower than written, all by the seed.

    robot: m, where it starts; nobody starts near it; on a route wholly near it, at its farthest waypoint.
    """
    rng = np.random.default_rng([seed, 2])
    p, k = len(walks), max((len(w.route) for w in walks), default=1)
    people = People(
        np.zeros((p, 10)),
        np.zeros((p, k, 2)),
        np.array([len(w.route) for w in walks], np.int64),
        np.array([w.speed * rng.uniform(0.9, 1.1) for w in walks], float),
        np.array([w.pause * rng.uniform(0.5, 1.5, N_PAUSES) for w in walks], float).reshape(p, N_PAUSES),
        np.zeros(p, np.int64),
        reacts,
    )
    for i, walk in enumerate(walks):
        n = len(walk.route)
        people.routes[i, :n] = walk.route
        target = int(np.argmax(np.hypot(*(walk.route - robot).T)))
        x, y = walk.route[target]
        for leg, share in zip(rng.integers(n, size=N_PLACES), rng.uniform(size=N_PLACES)):
            there = walk.route[leg - 1] + share * (walk.route[leg] - walk.route[leg - 1])
            if np.hypot(*(there - robot)) > APART:
                target, (x, y) = int(leg), there
                break
        people.state[i] = x, y, walk.radius, 0.0, 0.0, 0.0, target, 1.0, np.inf, 0.0
    return people


@njit(cache=True, nogil=True)
def _on_the_way(people: People, i: int) -> tuple[float, float, float, float, float]:
    """Where person i heads (x, y), the metres left to the waypoint, and the leg's start (x, y)."""
    state, n = people.state[i], people.lengths[i]
    target = int(state[TARGET])
    bx, by = people.routes[i, target]
    ax, ay = people.routes[i, (target - int(state[WAY])) % n]
    length = hypot(bx - ax, by - ay)
    if length < 1e-9:
        return bx, by, hypot(bx - state[X], by - state[Y]), ax, ay
    done = ((state[X] - ax) * (bx - ax) + (state[Y] - ay) * (by - ay)) / length
    ahead = min(max(done, 0.0) + LOOK, length)
    left = hypot(bx - state[X], by - state[Y])
    return ax + ahead * (bx - ax) / length, ay + ahead * (by - ay) / length, left, ax, ay


@njit(cache=True, nogil=True)
def _is_free(
    people: People, i: int, x: float, y: float, robot: Float64s, cells: Cells, distance: float, now: float
) -> bool:
    """Whether person i may stand at (x, y): no wall, nobody else, and `distance` m to the robot or more than `now`."""
    radius = people.state[i, RADIUS]
    to_robot = gap(robot, x, y) - radius
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
def _back(people: People, i: int, robot: Float64s, cells: Cells, now: float) -> tuple[float, float, float]:
    """As `_heading`, for a person `now` m from the robot: straight away from it, or aside where that is not free."""
    state = people.state[i]
    away = atan2(state[Y] - robot[:, 1].mean(), state[X] - robot[:, 0].mean())
    for turn in (0.0, pi / 4, -pi / 4, pi / 2, -pi / 2):
        ux, uy = cos(away + turn), sin(away + turn)
        if _is_free(people, i, state[X] + TOO_CLOSE * ux, state[Y] + TOO_CLOSE * uy, robot, cells, TOO_CLOSE, now):
            return ux, uy, 0.6
    return 0.0, 0.0, 0.0


@njit(cache=True, nogil=True)
def _heading(people: People, i: int, robot: Float64s, cells: Cells) -> tuple[float, float, float]:
    """The direction (x, y) that person i takes and the share of their speed, 0 where nothing is open."""
    state = people.state[i]
    hx, hy, left, ax, ay = _on_the_way(people, i)
    to_target = max(hypot(hx - state[X], hy - state[Y]), 1e-6)
    ux, uy = (hx - state[X]) / to_target, (hy - state[Y]) / to_target
    if not people.reacts:
        return ux, uy, 1.0
    now = gap(robot, state[X], state[Y]) - state[RADIUS]
    if now < TOO_CLOSE:
        return _back(people, i, robot, cells, now)
    step = min(STEP, left)
    if now > PERSONAL_SPACE + LOOK:
        open_ahead = _is_free(people, i, state[X] + STEP * ux, state[Y] + STEP * uy, robot, cells, 0.0, now)
        if open_ahead or state[BLOCKED] < WAITS:
            return ux, uy, 1.0 if open_ahead else 0.0
    elif _is_free(people, i, state[X] + step * ux, state[Y] + step * uy, robot, cells, PERSONAL_SPACE, now):
        return ux, uy, min(1.0, 0.4 + now)
    if state[BLOCKED] < WAITS:
        return 0.0, 0.0, 0.0
    for k in range(1, 5):
        for side in (-1.0, 1.0):
            turn = side * k * pi / 8
            vx, vy = cos(turn) * ux - sin(turn) * uy, sin(turn) * ux + cos(turn) * uy
            x, y = state[X] + STEP * vx, state[Y] + STEP * vy
            length = hypot(hx - ax, hy - ay)
            off = abs((x - ax) * (hy - ay) - (y - ay) * (hx - ax)) / length if length > 1e-6 else 0.0
            if off < STRAYS and _is_free(people, i, x, y, robot, cells, SQUEEZE, now):
                return vx, vy, 0.6
    return 0.0, 0.0, 0.0


@njit(cache=True, nogil=True)
def _head_on(people: People, i: int) -> None:
    """Sends person i to the next waypoint of their way."""
    state = people.state[i]
    state[TARGET] = (int(state[TARGET]) + int(state[WAY])) % people.lengths[i]
    state[NEAREST], state[STALLED], state[BLOCKED] = inf, 0.0, 0.0


@njit(cache=True, nogil=True)
def walk(people: People, robot: Float64s, cells: Cells, dt: float) -> bool:
    """Moves everybody by `dt` s; returns whether somebody ran into the robot, whose corners (k, 2) are given.

    Nobody ever overlaps a wall or the robot after a step: a step that would is not taken.
    """
    hit = False
    for i in range(len(people.state)):
        state = people.state[i]
        steps_back = people.reacts and gap(robot, state[X], state[Y]) - state[RADIUS] < TOO_CLOSE
        if state[PAUSE] > 0.0 and not steps_back:
            state[PAUSE] -= dt
            state[SPEED] = 0.0
            continue
        _, _, left, _, _ = _on_the_way(people, i)
        if left < 0.1 and not steps_back:
            _head_on(people, i)
            state[PAUSE] = people.pauses[i, people.n_pauses[i] % N_PAUSES]
            people.n_pauses[i] += 1
            continue
        ux, uy, share = _heading(people, i, robot, cells)
        wanted = share * people.speeds[i]
        state[SPEED] = min(wanted, state[SPEED] + ACCELERATION * dt)
        x, y = state[X] + state[SPEED] * dt * ux, state[Y] + state[SPEED] * dt * uy
        before = gap(robot, state[X], state[Y])
        bumps = gap(robot, x, y) <= state[RADIUS] and gap(robot, x, y) <= before
        moves = state[SPEED] > 0.0 and not bumps and not disc_touches_world(x, y, state[RADIUS], cells)
        hit |= bumps and state[SPEED] > 0.0
        if moves:
            state[X], state[Y] = x, y
        else:
            state[SPEED] = 0.0
        state[BLOCKED] = max(0.0, state[BLOCKED] - dt) if moves and share > 0.9 else state[BLOCKED] + (not moves) * dt
        state[STALLED] += dt
        if left < state[NEAREST] - PROGRESS:
            state[NEAREST], state[STALLED] = left, 0.0
        if state[STALLED] > TURNS_BACK:
            state[WAY] = -state[WAY]
            _head_on(people, i)
    return hit
