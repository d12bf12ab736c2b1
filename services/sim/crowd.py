# SPDX-License-Identifier: Apache-2.0
"""A number makes a square with a moving crowd, after DynaBARN (Nair et al. 2022): discs on smooth closed ways."""

from math import pi

import numpy as np
from numpy.typing import NDArray

from services.sim.world import Walk, World
from shared.geometry import Pose2

Float64s = NDArray[np.float64]

SIDE = 20.0  # m of the square; the robot starts in the middle of one side, its goal is across
FEWEST, MOST = 5, 24  # discs
RADIUS = 0.5  # m of each
SLOWEST, FASTEST = 0.3, 1.36  # m/s; in a seed each is a tenth faster or slower
N_WAVES = 3  # of a way about its middle
SPACING = 0.5  # m between a way's points
RIM = 1.5  # m from the square to the posts around it
POST, APART = 0.075, 0.15  # m: radius of a post, and between two: nothing else is there to be seen by


def crowd(number: int) -> World:
    """The crowd of this number: the same number, the same ways; where on them who begins is the seed's."""
    rng = np.random.default_rng([number, 20])
    walks = tuple(
        Walk(way(rng), float(rng.uniform(SLOWEST, FASTEST)), 0.0, RADIUS) for _ in range(rng.integers(FEWEST, MOST + 1))
    )
    low, high = -RIM, SIDE + RIM
    across = np.arange(low, high, APART)
    sides = [(across, np.full(len(across), low)), (across + APART, np.full(len(across), high))]
    posts = np.concatenate([np.column_stack(side) for x, y in sides for side in ((x, y), (y, x))])
    circles = np.column_stack((posts - (0.0, SIDE / 2), np.full(len(posts), POST)))
    bounds = low - 1, low - SIDE / 2 - 1, high + 1, high - SIDE / 2 + 1
    goal = Pose2(SIDE, 0.0, 0.0)
    return World(f"crowd_{number}", bounds, Pose2(), circles=circles, people=walks, goals={"goal": goal})


def way(rng: np.random.Generator) -> Float64s:
    """A smooth closed way within the square: waves about a middle, points (k, 2) SPACING m apart."""
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
