# SPDX-License-Identifier: Apache-2.0
"""The warehouse has aisles for one robot and for two, and every one of them can be reached from the start."""

import numpy as np
from scipy.ndimage import label

from services.sim.warehouse import HALL_WALL_Y, LENGTH, NARROW_AISLE, WIDE_AISLE, WIDTH
from services.sim.world_loader import load_world

RADIUS = 0.3  # m, of a robot
CELL = 0.1  # m


def test_a_robot_reaches_every_aisle_and_the_hall_behind_the_doors():
    world = load_world("warehouse")
    free, x0, y0 = world.centres(CELL, RADIUS)
    floors = label(free)[0]
    here = floors[int((world.start.y - y0) / CELL), int((world.start.x - x0) / CELL)]
    assert here > 0
    inside = free[: int((LENGTH - y0) / CELL), : int((WIDTH - x0) / CELL)]
    assert (floors == here).sum() > 0.98 * inside.sum()
    hall = floors[int((HALL_WALL_Y + 2 - y0) / CELL) :]
    assert (hall == here).any()


def test_aisles_are_in_turn_for_one_robot_and_for_two():
    occupied, _, y0 = load_world("warehouse").occupied(0.05)
    row = occupied[int((5.0 - y0) / 0.05)]
    ends = np.flatnonzero(np.diff(np.concatenate(([1], row.astype(int), [1]))))
    widths = np.round(0.05 * np.diff(ends)[::2], 1)
    assert np.isclose(widths, NARROW_AISLE, atol=0.15).sum() == 6
    assert np.isclose(widths, WIDE_AISLE, atol=0.15).sum() >= 5
