# SPDX-License-Identifier: Apache-2.0
"""A path's points lie at the same places whatever part of it is left, and the map says how wide it is across it."""

import numpy as np
import pytest

from services.traffic.conflicts import Clearances, TrafficRobot, order_of
from services.traffic.give_way import refuge
from services.traffic.passages import SPACING_M, passage_widths, points_from_end
from shared import sample_messages as sample
from shared.grid import OccupancyGrid
from shared.messages import TILE_CELLS

BEND = np.array([(0.5, 1.6), (1.7, 1.6), (2.6, 2.2)])


def grid(closed):
    """A map of 3.2 x 3.2 m, with cells closed where `closed(x, y)` holds."""
    y, x = (np.indices((TILE_CELLS, TILE_CELLS)) + 0.5) * 0.05
    built = OccupancyGrid()
    built.apply(sample.map_update(0, np.where(closed(x, y), 100, 0).astype(np.int8)))
    return built


def test_the_rest_of_a_path_has_the_points_of_the_whole():
    whole, rest = points_from_end(BEND), points_from_end(np.concatenate(([(1.0, 1.6)], BEND[1:])))
    assert rest == pytest.approx(whole[-len(rest) :])
    assert np.hypot(*np.diff(whole[:4], axis=0).T) == pytest.approx(SPACING_M)
    assert whole[-1] == pytest.approx(BEND[-1])


def test_a_corridor_a_door_and_a_wall_beside_an_open_floor_have_their_widths():
    points = np.column_stack((np.arange(0.4, 2.9, 0.3), np.full(9, 1.6)))
    corridor = passage_widths(points, grid(lambda x, y: abs(y - 1.6) > 0.5))
    assert corridor == pytest.approx(np.full(9, 1.0), abs=0.11)
    door = passage_widths(points, grid(lambda x, y: (abs(x - 1.6) < 0.2) & (abs(y - 1.6) > 0.45)))
    assert door.min() == pytest.approx(0.9, abs=0.11)
    assert door[0] > 2.0
    beside_wall = passage_widths(points, grid(lambda x, y: y < 1.3))
    assert beside_wall.min() > 1.7, "the free side counts"


@pytest.mark.parametrize("thickness", [0.05, 0.1, 0.2])
@pytest.mark.parametrize("first", np.arange(0.4, 0.7, 0.05))
def test_a_door_in_a_thin_wall_is_narrow_wherever_the_points_of_the_path_are(first, thickness):
    xs = np.arange(first, 2.9, SPACING_M)
    points = np.column_stack((xs, np.full(len(xs), 1.6)))
    wall = grid(lambda x, y: (x > 1.6) & (x < 1.6 + thickness) & (abs(y - 1.6) > 0.45))
    widths = passage_widths(points, wall)
    near = abs(points[:, 0] - 1.6 - thickness / 2) < SPACING_M / 2
    assert widths[near] == pytest.approx(np.full(near.sum(), 0.9), abs=0.11)
    assert widths[0] > 2.0


def robot(name, x, y, path=(), **more):
    points = np.array(path, float).reshape(-1, 2)
    order = order_of(name, 0, 1, False)
    return TrafficRobot(name, x, y, 0.2, order, path=points, widths=np.zeros(len(points)), **more)


def test_a_refuge_is_beside_the_others_path_and_there_is_none_in_a_blind_alley():
    """A corridor of 0.8 m along x, with a niche upward at x = 0.6."""
    clearances = Clearances(beside=0.1, passing=0.1)
    coming = robot("blue", 2.6, 1.6, [(x, 1.6) for x in np.arange(2.6, 0.2, -0.3)], held=1)
    with_niche = grid(lambda x, y: (abs(y - 1.6) > 0.4) & ~((abs(x - 0.6) < 0.4) & (y > 1.6) & (y < 3.0)))
    found = refuge(with_niche, robot("red", 1.6, 1.6), [coming], clearances)
    assert found is not None
    assert found.x < 1.0
    assert found.y > 2.0
    without = grid(lambda x, y: abs(y - 1.6) > 0.4)
    assert refuge(without, robot("red", 1.6, 1.6), [coming], clearances) is None
    behind = robot("green", 1.0, 1.6)
    assert refuge(with_niche, robot("red", 1.6, 1.6), [coming, behind], clearances) is None, "green stands on the way"
