# SPDX-License-Identifier: Apache-2.0
"""Where a robot that makes way stands, and what it does when the other's path changes."""

import numpy as np
import pytest

from services.traffic.conflicts import Clearances, TrafficRobot, order_of, reach_of
from services.traffic.give_way import CIRCLE_NS, MIN_REST_NS, SLACK_M, STUCK_NS, GivingWay, refuge
from shared import sample_messages as sample
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import TILE_CELLS

S = 1_000_000_000
CLEARANCES = Clearances(beside=0.1, passing=0.1)
ALONG = [(x, 1.6) for x in np.arange(2.6, 0.2, -0.3)]


def floor():
    """A free map of 3.2 x 3.2 m."""
    built = OccupancyGrid()
    built.apply(sample.map_update(0, np.zeros((TILE_CELLS, TILE_CELLS), np.int8)))
    return built


def robot(name, x, y, path=(), since=1, **more):
    points = np.array(path, float).reshape(-1, 2)
    return TrafficRobot(
        name, x, y, 0.2, order_of(name, 0, since, False), path=points, widths=np.zeros(len(points)), **more
    )


def test_a_refuge_is_farther_from_a_path_than_the_tolerance_of_arriving_takes_away():
    red, blue = robot("red", 1.6, 1.6), robot("blue", 2.6, 1.6, ALONG, held=1)
    found = refuge(floor(), red, [blue], CLEARANCES)
    apart = np.hypot(blue.path[:, 0] - found.x, blue.path[:, 1] - found.y).min()
    assert apart >= reach_of(red, blue, CLEARANCES) + SLACK_M


@pytest.mark.parametrize(("x", "y"), [(4.0, 1.6), (1.6, 5.0), (-0.5, 1.6), (-14.0, 1.6), (1.6, -14.0)])
def test_a_robot_outside_of_the_map_has_no_refuge(x, y):
    blue = robot("blue", 2.6, 1.6, ALONG, held=1)
    assert refuge(floor(), robot("red", x, y), [blue], CLEARANCES) is None
    assert refuge(OccupancyGrid(), robot("red", x, y), [blue], CLEARANCES) is None


@pytest.fixture
def giving():
    """Red makes way for blue, and stands at its refuge."""
    state = GivingWay()
    red = robot("red", 1.6, 1.6, since=2, waits_for=("blue",))
    blue = robot("blue", 2.6, 1.6, ALONG, held=1, waits_for=("red",))
    for now in (S, S + CIRCLE_NS):
        state.update(red, [blue], floor(), CLEARANCES, now)
    assert state.refuge is not None
    return state


def test_a_robot_whose_refuge_is_on_a_new_path_of_the_other_takes_another_refuge(giving):
    first = giving.refuge
    resting = robot("red", first.x, first.y, since=2)
    stays = robot("blue", 2.6, 1.6, ALONG, held=1)
    for now in (5 * S, 5 * S + MIN_REST_NS):
        giving.update(resting, [stays], floor(), CLEARANCES, now)
    assert giving.refuge == first
    through = robot("blue", 2.6, 1.6, [*ALONG[:3], (first.x, first.y), (0.4, 1.6)], held=1)
    giving.update(resting, [through], floor(), CLEARANCES, 6 * S + MIN_REST_NS)
    assert giving.refuge != first
    apart = np.hypot(through.path[:, 0] - giving.refuge.x, through.path[:, 1] - giving.refuge.y).min()
    assert apart >= reach_of(resting, through, CLEARANCES) + SLACK_M


def test_a_robot_that_is_in_the_way_at_its_refuge_and_cannot_leave_it_lets_another_one_make_way(giving):
    """Its refuge is the end of a corridor, and blue comes into that."""
    cells = np.full((TILE_CELLS, TILE_CELLS), 100, np.int8)
    cells[:14] = 0
    corridor = OccupancyGrid()
    corridor.apply(sample.map_update(0, cells))
    end = robot("red", 0.35, 0.35, since=2)
    into = robot("blue", 0.8, 0.35, [(0.6, 0.35), (1.6, 1.6)], held=1, waits_for=("red",))
    giving.refuge = Pose2(0.35, 0.35)
    for now in (5 * S, 5 * S + MIN_REST_NS):
        giving.update(end, [into], corridor, CLEARANCES, now)
    assert giving.refuge is None
    assert giving.stuck
    giving.update(end, [into], corridor, CLEARANCES, 5 * S + MIN_REST_NS + STUCK_NS)
    assert not giving.stuck
