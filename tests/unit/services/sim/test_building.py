# SPDX-License-Identifier: Apache-2.0
"""Made-up buildings: every number is one, always the same, and a robot gets from every room to every other."""

import numpy as np
import pytest

from services.sim.building import HEIGHT, WIDTH, building
from services.sim.world_loader import load_world
from shared.config import UserError
from tests.unit.services.sim.scenes import X80SV, simulator

NUMBERS = range(8)


@pytest.mark.parametrize("number", NUMBERS)
def test_the_robot_can_drive_to_every_room_however_the_loose_things_stand(number):
    for seed in (0, number + 1):
        world = load_world(f"building:{number}", seed, 0.1)
        reached, x0, y0 = world.reachable(0.05, X80SV.circumscribed_radius + 0.05)
        for name, goal in world.goals.items():
            assert reached[int((goal.y - y0) / 0.05), int((goal.x - x0) / 0.05)], name


@pytest.mark.parametrize("number", NUMBERS)
def test_its_size_is_a_building_s_and_its_floor_is_furnished_but_not_blocked(number):
    world = load_world(f"building:{number}")
    low_x, low_y, high_x, high_y = world.bounds
    width, height = high_x - low_x - 0.6, high_y - low_y - 0.6
    assert WIDTH[0] - 0.1 <= width <= WIDTH[1] + 0.1
    assert HEIGHT[0] - 0.1 <= height <= HEIGHT[1] + 0.1
    assert len(world.goals) >= 5
    assert 1 <= len(world.people) <= 3
    reached, _, _ = world.reachable(0.05, X80SV.circumscribed_radius)
    assert 0.55 < reached.sum() * 0.05**2 / (width * height) < 0.95


def test_the_same_number_is_the_same_building_and_another_one_another():
    assert building(3) == building(3)
    assert len({load_world(f"building:{n}").outline().tobytes() for n in NUMBERS}) == len(NUMBERS)


def test_another_seed_moves_what_is_loose_and_nothing_else():
    here, there = load_world("building:3", 1, 0.1), load_world("building:3", 2, 0.1)
    assert here.start == there.start
    assert here.goals == there.goals
    arc_pose = sum(not np.array_equal(a, b) for a, b in zip(here.polygons, there.polygons))
    assert 0 < arc_pose < len(here.polygons) / 2
    assert not np.array_equal(here.circles, there.circles)


def test_some_of_its_rooms_look_alike():
    """Rooms of one row have their furniture at the same places, each from its own corner."""
    tree = building(3)
    sizes = [tuple(box["size"]) for box in tree["boxes"]]
    assert max(sizes.count(size) for size in set(sizes)) >= 3


def test_the_simulator_starts_in_it():
    assert simulator("building:5", seed=1).world.name == "building:5"


@pytest.mark.parametrize("world", ["building:", "building:x", "building:-1", "building:1.5", "building:99999999999"])
def test_what_is_no_number_is_a_clear_error(world):
    with pytest.raises(UserError, match="there is no world"):
        load_world(world)
