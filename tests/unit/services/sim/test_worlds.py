# SPDX-License-Identifier: Apache-2.0
"""The worlds that come with the project: what the demo and the benchmarks rely on, in every seed."""

import pytest

from services.sim.world_loader import WORLDS_DIR, load_world
from tests.unit.services.sim.scenes import X80SV, simulator

NAMES = sorted(path.stem for path in WORLDS_DIR.glob("*.yaml"))


def can_reach_its_goals(world):
    reached, x0, y0 = world.reachable(0.05, X80SV.circumscribed_radius + 0.05)
    return all(reached[int((goal.y - y0) / 0.05), int((goal.x - x0) / 0.05)] for goal in world.goals.values())


@pytest.mark.parametrize("name", NAMES)
def test_every_goal_can_be_reached_from_a_start_where_the_robot_fits(name):
    assert can_reach_its_goals(simulator(name, seed=1).world)


def test_every_seed_of_the_office_is_another_and_none_blocks_a_goal():
    offices = [load_world("office", seed, 0.1) for seed in range(10)]
    assert len({world.circles.tobytes() for world in offices}) == 10
    assert all(can_reach_its_goals(world) for world in offices)


def test_the_office_has_ten_rooms_two_loops_two_people_and_five_goals():
    world = load_world("office")
    low_x, low_y, high_x, high_y = world.bounds
    assert high_x - low_x >= 25
    assert high_y - low_y >= 15
    assert len(world.people) == 2
    assert len(world.goals) == 5
    reached, x0, y0 = world.reachable(0.05, X80SV.circumscribed_radius)
    rooms = [(3, 2), (8, 2), (15.5, 2), (21, 2.5), (3, 8), (15, 7.5), (21, 7.5), (1, 14), (12.4, 12), (17, 12.5)]
    assert all(reached[int((y - y0) / 0.05), int((x - x0) / 0.05)] for x, y in rooms)
    blocks = [(6.7, 7.3), (20.3, 8.7)]  # a table and a shelf, inside what each loop goes around
    assert not any(reached[int((y - y0) / 0.05), int((x - x0) / 0.05)] for x, y in blocks)
