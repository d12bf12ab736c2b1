# SPDX-License-Identifier: Apache-2.0
"""A crowd by number: discs on smooth closed ways that stay in the square, and walk on whatever the robot does."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from services.sim import people as crowding
from services.sim.crowd import MAX_DISCS, MIN_DISCS, RADIUS, SIDE, SPACING, crowd_world
from services.sim.world_loader import load_world
from shared.config import UserError
from shared.geometry import Pose2

DT = 0.005  # s
FAR_ROBOT = np.array([[99.0, 99.0], [99.1, 99.0], [99.1, 99.1]])


@pytest.mark.parametrize("number", range(12))
def test_ways_are_smooth_closed_and_in_the_square(number):
    world = crowd_world(number)
    assert MIN_DISCS <= len(world.people) <= MAX_DISCS
    for step_people in world.people:
        assert step_people.radius == RADIUS
        assert step_people.speed * 1.1 <= 1.5
        assert (step_people.route >= (RADIUS - 1e-9, RADIUS - SIDE / 2 - 1e-9)).all()
        assert (step_people.route <= (SIDE - RADIUS + 1e-9, SIDE / 2 - RADIUS + 1e-9)).all()
        legs = np.hypot(*np.diff(step_people.route, axis=0, append=step_people.route[:1]).T)
        assert legs.max() < 1.3 * SPACING  # closed: from the last to the first too
    assert not world.solid_at(np.array([[world.start.x, world.start.y], [SIDE, 0.0]])).any()


def test_the_number_makes_the_crowd_and_the_seed_says_where_it_begins():
    a, b, other = load_world("crowd:4"), load_world("crowd:4", seed=9), load_world("crowd:5")
    assert all(np.array_equal(x.route, y.route) for x, y in zip(a.people, b.people))
    assert len(a.people) != len(other.people) or not np.array_equal(a.people[0].route, other.people[0].route)
    begun = [crowding.initial_people(a.people, False, seed, (0.0, 0.0)).state for seed in (1, 1, 2)]
    assert_array_equal(begun[0], begun[1])
    assert not np.array_equal(begun[0], begun[2])
    with pytest.raises(UserError, match="no world crowd:x"):
        load_world("crowd:x")


def test_nobody_in_it_stops_and_none_is_faster_than_the_rule():
    world = crowd_world(1)
    people = crowding.initial_people(world.people, False, 1, (0.0, 0.0))
    for _ in range(400):
        crowding.step_people(people, FAR_ROBOT, world.cells, DT)
    before = people.state[:, :2].copy()
    for _ in range(100):
        crowding.step_people(people, FAR_ROBOT, world.cells, DT)
    speed = np.hypot(*(people.state[:, :2] - before).T) / (100 * DT)
    assert speed.min() > 0.15
    assert speed.max() <= 1.5
    assert world.start == Pose2()
