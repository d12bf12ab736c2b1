# SPDX-License-Identifier: Apache-2.0
"""One step of physics: wheels, motion, contact, people; and the history that the sensors use."""

from typing import NamedTuple

import numpy as np
from numba import njit

from services.sim.contact import touches_people, touches_world, transform_polygon
from services.sim.drive import Wheels, acting_distance, arc_pose, next_slip, wheel_speed
from services.sim.people import RADIUS, People, step_people
from services.sim.rays import Cells
from shared.types import Float64s

DT_NS = 5_000_000
DT = 0.005  # s: a step of the physics
CONTACT_M = 0.001  # m: nearer than this is a contact
RELEASE_M = 0.01  # m: a contact ends when the robot is this far off
N_BISECTIONS = 8  # of a blocked step: what is left of 1 cm is 0.04 mm

(X, Y, YAW, LEFT_SPEED, RIGHT_SPEED, LEFT_ANGLE, RIGHT_ANGLE, LEFT_SLIP, RIGHT_SLIP, V, W, DISTANCE, CONTACT,
 N_CONTACTS) = range(14)  # fmt: skip
"""Places in the robot's state: m, rad (unwrapped), rad/s of the wheels, shares, v m/s, w rad/s, m, flag, count."""


class Body(NamedTuple):
    """The footprint (k, 2) in `base`, and grown by TOUCH and by RELEASE."""

    footprint: Float64s
    touch: Float64s
    release: Float64s


@njit(cache=True, nogil=True)
def _is_blocked(corners: Float64s, x: float, y: float, yaw: float, cells: Cells, people: Float64s) -> bool:
    at = transform_polygon(corners, x, y, yaw)
    return touches_world(at, cells) or touches_people(at, people)


@njit(cache=True, nogil=True)
def move_until_contact(
    x: float, y: float, yaw: float, forward: float, turn: float, corners: Float64s, cells: Cells, people: Float64s
) -> tuple[float, float, float, bool]:
    """The pose after the part of a motion that is free, and whether something was in the way.

    A blocked motion goes as far as it is free; of the rest, the turn alone or the way alone is tried.
    """
    ex, ey, eyaw = arc_pose(x, y, yaw, forward, turn)
    if not _is_blocked(corners, ex, ey, eyaw, cells, people):
        return ex, ey, eyaw, False
    free, stuck = 0.0, 1.0
    for _ in range(N_BISECTIONS):
        share = (free + stuck) / 2.0
        ex, ey, eyaw = arc_pose(x, y, yaw, share * forward, share * turn)
        if _is_blocked(corners, ex, ey, eyaw, cells, people):
            stuck = share
        else:
            free = share
    x, y, yaw = arc_pose(x, y, yaw, free * forward, free * turn)
    for f, t in ((0.0, (1.0 - free) * turn), ((1.0 - free) * forward, 0.0)):
        ex, ey, eyaw = arc_pose(x, y, yaw, f, t)
        if not _is_blocked(corners, ex, ey, eyaw, cells, people):
            return ex, ey, eyaw, True
    return x, y, yaw, True


@njit(cache=True, nogil=True)
def advance(
    first_step: int,
    n_steps: int,
    state: Float64s,
    targets: Float64s,
    lives: int,
    draws: Float64s,
    wheels: Wheels,
    body: Body,
    cells: Cells,
    people: People,
    history: Float64s,
) -> None:
    """Takes steps first_step, first_step + 1, ...; changes state, people and history in place.

    targets: (2,) rad/s of the wheels, for the next `lives` steps, then 0.  draws: (n_steps, 2) standard normal.
    history: (n, 3 + 3 p): row k % n is the pose and the people's discs at the end of step k - 1, thus at time k * DT.
    """
    n_people = len(people.state)
    for k in range(n_steps):
        left = targets[0] if k < lives else 0.0
        right = targets[1] if k < lives else 0.0
        state[LEFT_SPEED] = wheel_speed(state[LEFT_SPEED], left, wheels.lag, wheels.limit, DT)
        state[RIGHT_SPEED] = wheel_speed(state[RIGHT_SPEED], right, wheels.lag, wheels.limit, DT)
        state[LEFT_ANGLE] += state[LEFT_SPEED] * DT
        state[RIGHT_ANGLE] += state[RIGHT_SPEED] * DT
        state[LEFT_SLIP] = next_slip(state[LEFT_SLIP], draws[k, 0], wheels)
        state[RIGHT_SLIP] = next_slip(state[RIGHT_SLIP], draws[k, 1], wheels)
        on_left = state[LEFT_SPEED] * DT * wheels.left_radius * (1.0 - state[LEFT_SLIP])
        on_right = state[RIGHT_SPEED] * DT * wheels.right_radius * (1.0 - state[RIGHT_SLIP])
        forward = (on_left + on_right) / 2.0
        turn = (on_right - on_left) / acting_distance(on_left, on_right, wheels)

        x, y, yaw = state[X], state[Y], state[YAW]
        discs = people.state[:, : RADIUS + 1]
        hit = False
        if forward != 0.0 or turn != 0.0:
            state[X], state[Y], state[YAW], hit = move_until_contact(
                x, y, yaw, forward, turn, body.footprint, cells, discs
            )
        gone = np.hypot(state[X] - x, state[Y] - y)
        ahead = (state[X] - x) * np.cos(yaw) + (state[Y] - y) * np.sin(yaw)
        state[V] = (gone if ahead >= 0.0 else -gone) / DT
        state[W] = (state[YAW] - yaw) / DT
        state[DISTANCE] += gone

        hit |= step_people(people, transform_polygon(body.footprint, state[X], state[Y], state[YAW]), cells, DT)
        felt = body.release if state[CONTACT] > 0.0 else body.touch
        touching = hit or _is_blocked(felt, state[X], state[Y], state[YAW], cells, discs)
        state[N_CONTACTS] += touching and state[CONTACT] == 0.0
        state[CONTACT] = 1.0 if touching else 0.0

        row = history[(first_step + k + 1) % len(history)]
        row[0], row[1], row[2] = state[X], state[Y], state[YAW]
        for i in range(n_people):
            row[3 + 3 * i : 6 + 3 * i] = discs[i]
