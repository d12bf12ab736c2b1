# SPDX-License-Identifier: Apache-2.0
"""Generates a square with a moving crowd from a number, after DynaBARN (Nair et al. 2022): discs on closed paths."""

from math import pi

import numpy as np

from services.sim.world import Pedestrian, World
from shared.geometry import Pose2
from shared.types import Float64s

SIDE = 20.0  # m of the square; the robot starts in the middle of one side, its goal is across
MIN_DISCS, MAX_DISCS = 5, 24  # discs
RADIUS = 0.5  # m of each
MIN_SPEED, MAX_SPEED = 0.3, 1.36  # m/s; in a seed each is a tenth faster or slower
N_WAVES = 3  # waves of a path
SPACING = 0.5  # m between points of a path
POST_MARGIN = 1.5  # m from the square to its posts
POST_RADIUS, POST_SPACING = 0.075, 0.15  # m: the posts are the only landmarks


def crowd_world(number: int) -> World:
    """The crowd of this number. It determines the paths; the simulator's seed determines the starts on them."""
    rng = np.random.default_rng([number, 20])
    walks = tuple(
        Pedestrian(closed_path(rng), float(rng.uniform(MIN_SPEED, MAX_SPEED)), 0.0, RADIUS)
        for _ in range(rng.integers(MIN_DISCS, MAX_DISCS + 1))
    )
    low, high = -POST_MARGIN, SIDE + POST_MARGIN
    across = np.arange(low, high, POST_SPACING)
    sides = [(across, np.full(len(across), low)), (across + POST_SPACING, np.full(len(across), high))]
    posts = np.concatenate([np.column_stack(side) for x, y in sides for side in ((x, y), (y, x))])
    circles = np.column_stack((posts - (0.0, SIDE / 2), np.full(len(posts), POST_RADIUS)))
    bounds = low - 1, low - SIDE / 2 - 1, high + 1, high - SIDE / 2 + 1
    goal = Pose2(SIDE, 0.0, 0.0)
    return World(f"crowd_{number}", bounds, Pose2(), circles=circles, people=walks, goals={"goal": goal})


def closed_path(rng: np.random.Generator) -> Float64s:
    """A smooth closed path in the square: (k, 2) m, SPACING apart; a sum of waves around a centre."""
    turn = np.linspace(0, 2 * pi, 400, endpoint=False)
    centre = rng.uniform(0.2 * SIDE, 0.8 * SIDE, 2)
    points = np.tile(centre, (len(turn), 1))
    for wave in range(1, N_WAVES + 1):
        size, phase = rng.uniform(0.05, 0.35, 2) * SIDE / wave, rng.uniform(0, 2 * pi, 2)
        points += size * np.sin(wave * turn[:, None] + phase)
    points = np.clip(points, RADIUS, SIDE - RADIUS) - (0.0, SIDE / 2)
    along = np.concatenate(([0.0], np.cumsum(np.hypot(*np.diff(points, axis=0, append=points[:1]).T))))
    at = np.arange(max(4, round(along[-1] / SPACING))) * along[-1] / max(4, round(along[-1] / SPACING))
    closed = np.concatenate((points, points[:1]))
    return np.column_stack([np.interp(at, along, column) for column in closed.T])
