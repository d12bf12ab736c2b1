# SPDX-License-Identifier: Apache-2.0
from math import hypot

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.sim.contact import disc_touches_world, transform_polygon
from services.sim.people import BLOCKED, RADIUS, SPEED, X, Y, initial_people, step_people
from services.sim.world import Pedestrian
from services.sim.world_loader import load_world
from shared.polygon_kernels import distance_to_polygon
from tests.unit.services.sim.scenes import X80SV

OFFICE = load_world("office")
FAR = transform_polygon(X80SV.corners, -50.0, -50.0, 0.0)
DT = 0.005


def walked(people, robot, cells, seconds):
    """(n, p, 2) positions every 0.1 s, and whether anybody ran into the robot."""
    track, hit = [], False
    for k in range(round(seconds / DT)):
        hit |= step_people(people, robot, cells, DT)
        if k % 20 == 0:
            track.append(people.state[:, : Y + 1].copy())
    return np.array(track), hit


def corridor_walker(reacts, robot_x=5.0):
    """Somebody at the western end of the corridor of 20 x 2 m, bound for the other; the robot stands in the way."""
    cells = load_world("corridor").cells
    people = initial_people(
        (Pedestrian(np.array([[1.0, 1.3], [18.0, 1.3]]), 1.0, 0.1, 0.25),), reacts, 1, (robot_x, 1.3)
    )
    people.state[0, X], people.state[0, Y], people.state[0, 6] = 1.0, 1.3, 1
    return people, transform_polygon(X80SV.corners, robot_x, 1.3, 0.0), cells


@settings(deadline=None, max_examples=8)
@given(st.integers(0, 1000), st.booleans(), st.sampled_from([(12.55, 9.95), (16.6, 10.9), (19.9, 4.3), (0.95, 7.0)]))
def test_people_never_walk_through_walls_or_the_robot(seed, reacts, at):
    people = initial_people(OFFICE.people, reacts, seed, at)
    robot = transform_polygon(X80SV.corners, *at, 0.5)
    track, _ = walked(people, robot, OFFICE.cells, 60.0)
    for place in track.reshape(-1, 2):
        assert not disc_touches_world(place[0], place[1], 0.25, OFFICE.cells)
        assert distance_to_polygon(robot, place[0], place[1]) >= 0.25


def test_people_walk_their_whole_route_at_about_their_speed():
    people = initial_people(OFFICE.people, True, 3, (OFFICE.start.x, OFFICE.start.y))
    track, _ = walked(people, FAR, OFFICE.cells, 200.0)
    for i, person in enumerate(OFFICE.people):
        for waypoint in person.route:
            assert np.hypot(*(track[:, i] - waypoint).T).min() < 0.15
        steps = np.hypot(*np.diff(track[:, i], axis=0).T) / 0.1
        assert 0.85 * person.speed < np.median(steps) < 1.15 * person.speed
        assert (steps < 0.01).any()


def test_who_reacts_stops_before_the_robot_and_never_touches_it():
    people, robot, cells = corridor_walker(reacts=True)
    nearest = 9.0
    for _ in range(round(4.0 / DT)):
        assert not step_people(people, robot, cells, DT)
        nearest = min(nearest, distance_to_polygon(robot, *people.state[0, :2]) - 0.25)
    assert 0.3 < nearest < 0.7
    assert people.state[0, SPEED] == 0.0
    assert people.state[0, BLOCKED] > 0.0


def test_who_reacts_walks_around_a_robot_that_leaves_room():
    people, robot, cells = corridor_walker(reacts=True)
    robot = transform_polygon(X80SV.corners, 5.0, 1.75, 0.0)
    track, hit = walked(people, robot, cells, 25.0)
    assert not hit
    assert track[:, 0, 0].max() > 15.0


def test_who_finds_no_way_around_turns_back():
    people, _, cells = corridor_walker(reacts=True)
    wide = transform_polygon(np.array([[-0.2, -0.9], [0.2, -0.9], [0.2, 0.6], [-0.2, 0.6]]), 5.0, 1.3, 0.0)
    track, hit = walked(people, wide, cells, 40.0)
    assert not hit
    farthest = int(np.argmax(track[:, 0, 0]))
    assert track[farthest, 0, 0] < 5.0
    assert track[farthest:, 0, 0].min() < 1.5


def test_who_does_not_react_runs_into_the_robot_and_stands_there():
    people, robot, cells = corridor_walker(reacts=False)
    track, hit = walked(people, robot, cells, 6.0)
    assert hit
    assert distance_to_polygon(robot, *track[-1, 0]) - 0.25 < 0.02


@pytest.mark.parametrize("seed", range(8))
def test_nobody_starts_beside_the_robot_and_seeds_differ(seed):
    start = OFFICE.start.x, OFFICE.start.y
    people, other = (initial_people(OFFICE.people, True, s, start) for s in (seed, seed + 1))
    assert all(hypot(p[X] - start[0], p[Y] - start[1]) > 2.0 for p in people.state)
    assert not np.array_equal(people.state, other.state)
    assert np.array_equal(people.state, initial_people(OFFICE.people, True, seed, start).state)
    assert (people.state[:, RADIUS] == 0.25).all()


@pytest.mark.parametrize("pause", [0.0, 30.0])
@pytest.mark.parametrize("bearing", [0.0, -1.6, 3.0])
def test_who_touches_the_robot_steps_back(bearing, pause):
    people, robot, cells = corridor_walker(reacts=True)
    people.state[0, :2] = 5.0 + 0.47 * np.cos(bearing), 1.3 + 0.47 * np.sin(bearing)
    people.state[0, 4] = pause
    _, hit = walked(people, robot, cells, 1.0)
    assert not hit
    assert distance_to_polygon(robot, *people.state[0, :2]) - 0.25 >= 0.09
