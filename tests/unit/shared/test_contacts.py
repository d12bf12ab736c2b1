# SPDX-License-Identifier: Apache-2.0
"""Which motions lead away from a contact, and where it is on the map."""

from math import cos, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared.config import load_robot
from shared.contacts import DEPTH_M, MEMORY_S, ContactPlaces, contact_points, leads_away, outline_sector
from shared.geometry import Pose2, arc
from shared.messages import Contacts
from shared.polygon import contains, signed_distances
from shared.robot import Bumper, CliffSensor

X80SV = load_robot("x80sv").robot
BUMPERS = tuple(
    Bumper(name=name, bearing=bearing, width=pi / 2)
    for name, bearing in (("front", 0.0), ("left", pi / 2), ("back", pi), ("right", -pi / 2))
)
CLIFFS = (CliffSensor(name="ahead", x=0.19, y=0.0),)
ROBOT = X80SV.model_copy(update={"bumpers": BUMPERS, "cliffs": CLIFFS})
S = 1_000_000_000


def touching(*bumpers, cliffs=(), at=0):
    return Contacts(at, bumpers, cliffs, False)


@pytest.mark.parametrize("width", [0.3, pi, 2 * pi])
def test_the_points_of_a_sector_lie_on_the_outline_and_in_the_sector(width):
    points, normals = outline_sector(ROBOT.corners, 0.7, width)
    assert np.abs(signed_distances(ROBOT.corners, points)).max() < 1e-9
    turned = points @ np.array([[cos(0.7), -sin(0.7)], [sin(0.7), cos(0.7)]])
    assert np.abs(np.arctan2(turned[:, 1], turned[:, 0])).max() <= width / 2 + 1e-9
    assert (signed_distances(ROBOT.corners, points + 0.01 * normals) > 0.005).all()


@pytest.mark.parametrize(
    ("bumpers", "v", "w", "away"),
    [
        (("front",), -0.1, 0.0, True),
        (("front",), 0.1, 0.0, False),
        (("front",), 0.0, 0.0, False),
        (("front",), 0.0, 1.0, False),
        (("back",), 0.1, 0.0, True),
        (("back",), -0.1, 0.0, False),
        (("left",), 0.1, 0.0, False),
        (("front", "back"), 0.1, 0.0, False),
        (("front", "back"), -0.1, 0.0, False),
        (("somewhere",), -0.1, 0.0, False),
        ((), 0.5, 1.0, True),
    ],
)
def test_only_a_motion_off_every_contact_leads_away(bumpers, v, w, away):
    assert leads_away(ROBOT, touching(*bumpers), v, w) is away


def test_a_cliff_ahead_is_left_backward_only():
    assert leads_away(ROBOT, touching(cliffs=("ahead",)), -0.1, 0.0)
    assert not leads_away(ROBOT, touching(cliffs=("ahead",)), 0.1, 0.0)
    assert not leads_away(ROBOT, touching(cliffs=("ahead",)), 0.0, 1.0)
    assert not leads_away(ROBOT, touching(cliffs=("unknown",)), -0.1, 0.0)


@settings(max_examples=200, deadline=None)
@given(st.sampled_from(BUMPERS), st.floats(-0.15, 0.15), st.floats(-0.5, 0.5), st.floats(-pi / 4, pi / 4))
def test_what_leads_away_does_not_press_an_obstacle_of_the_sector(bumper, v, w, bearing):
    """A point that touches the outline is not deeper in it after 0.1 s than the allowed approach."""
    if not leads_away(ROBOT, touching(bumper.name), v, w):
        return
    point, _ = outline_sector(ROBOT.corners, bumper.bearing + bearing, 1e-6)
    moved = arc(0.1 * v, 0.1 * w).inverse() @ point[:1]
    assert signed_distances(ROBOT.corners, moved)[0] > -0.0025


def test_the_place_of_a_contact_lies_before_the_bumper_and_lasts_a_minute():
    places, pose = ContactPlaces(ROBOT), Pose2(1.0, 2.0, pi / 2)
    assert places.add(touching("front"), pose, 0)
    assert not places.add(touching("front", at=S), pose, S)
    (polygon,) = places.polygons
    before = pose @ np.array([[0.2 + DEPTH_M / 2, 0.0], [0.1, 0.0], [0.0, 0.3]])
    assert contains(polygon, before).tolist() == [True, False, False]
    late, later = round(MEMORY_S) * S, round(MEMORY_S + 2) * S
    assert not places.add(touching(at=late), pose, late)
    assert places.add(touching(at=later), pose, later)
    assert places.polygons == ()


def test_a_bumper_that_stays_pressed_while_the_robot_leaves_is_one_place():
    places = ContactPlaces(ROBOT)
    places.add(touching("front"), Pose2(), 0)
    before = places.polygons
    assert not places.add(touching("front", at=S), Pose2(-0.3, 0.0, 0.0), S)
    assert places.polygons == before


@pytest.mark.parametrize(
    ("at", "counts"), [(0, True), (-200, True), (-300, False), (-61_000, False), (3_600_000, False)]
)
def test_a_contact_of_another_moment_is_no_place_where_the_robot_is_now(at, counts):
    """at: ms after now."""
    places, now = ContactPlaces(ROBOT), 100 * S
    assert places.add(touching("front", at=now + at * S // 1000), Pose2(), now) == counts
    assert len(places.polygons) == counts


def test_a_contact_that_comes_after_a_newer_message_is_no_place():
    places = ContactPlaces(ROBOT)
    places.add(touching(at=S), Pose2(), S)
    assert not places.add(touching("front", at=S - 1), Pose2(), S)
    assert places.polygons == ()


def test_a_cliff_is_a_square_before_its_sensor():
    places = ContactPlaces(ROBOT)
    places.add(touching(cliffs=("ahead",)), Pose2(), 0)
    (polygon,) = places.polygons
    assert contains(polygon, np.array([[0.24, 0.0], [0.24, 0.09], [0.15, 0.0]])).tolist() == [True, True, False]


def test_places_are_few_and_cleared_with_the_map():
    places = ContactPlaces(ROBOT)
    for k in range(40):
        places.add(touching("front"), Pose2(k, 0.0, 0.0), k)
        places.add(touching(), Pose2(k, 0.0, 0.0), k)
    assert len(places.polygons) == 16
    places.clear()
    assert places.polygons == ()


def test_without_contacts_there_are_no_points():
    assert contact_points(ROBOT, touching())[0].shape == (0, 2)
