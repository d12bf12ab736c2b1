# SPDX-License-Identifier: Apache-2.0
"""The quick answer is never more hopeful than the polygon."""

from math import cos, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from services.local_ctrl.footprint import clearance, collides, footprint_of
from shared.config import Robot, load_robot
from shared.distance_field import distance_field
from shared.geometry import Pose2
from shared.polygon import contains

N, RESOLUTION = 40, 0.05

ROBOTS = [load_robot("x80sv").robot, load_robot("jackal").robot]
LONG = ROBOTS[0].model_copy(update={"footprint": ((0.6, -0.1), (0.6, 0.1), (-0.2, 0.15), (-0.2, -0.15))})
ELL = ROBOTS[0].model_copy(
    update={"footprint": ((0.4, -0.15), (0.4, 0.15), (0.1, 0.15), (0.1, 0.5), (-0.15, 0.5), (-0.15, -0.15))}
)
robots = st.sampled_from([*ROBOTS, LONG, ELL])
scenes = st.lists(st.tuples(st.integers(0, N - 1), st.integers(0, N - 1)), min_size=1, max_size=6)
places = st.tuples(st.floats(0.3, 1.7), st.floats(0.3, 1.7), st.floats(-3.2, 3.2))


def occupied_at(cells: list[tuple[int, int]]) -> NDArray[np.bool_]:
    occupied = np.zeros((N, N), bool)
    for row, column in cells:
        occupied[row, column] = True
    return occupied


def distance_to_polygon(robot: Robot, place: tuple[float, float, float], occupied: NDArray[np.bool_]) -> float:
    """Brute force: finely sampled outline against every occupied cell's centre; 0 where one lies inside."""
    rows, columns = np.nonzero(occupied)
    centres = np.column_stack((columns, rows)) * RESOLUTION
    corners = Pose2(*place) @ robot.corners
    if contains(corners, centres).any():
        return 0.0
    ends = np.roll(corners, -1, axis=0)
    outline = np.concatenate([a + np.linspace(0, 1, 400)[:, None] * (b - a) for a, b in zip(corners, ends)])
    return float(np.hypot(*(outline[:, None] - centres[None]).reshape(-1, 2).T).min())


@settings(deadline=None, max_examples=200)
@given(robots, scenes, places, st.sampled_from([0.0, 0.03]))
def test_what_is_called_free_is_free_of_the_padded_polygon(
    robot: Robot, cells: list[tuple[int, int]], place: tuple[float, float, float], padding: float
) -> None:
    occupied = occupied_at(cells)
    field = distance_field(occupied, RESOLUTION)
    x, y, yaw = place
    truth = distance_to_polygon(robot, place, occupied)
    shape = footprint_of(robot, padding)
    if truth < padding - 1e-3 or truth == 0.0:
        assert collides(field, occupied, RESOLUTION, x, y, cos(yaw), sin(yaw), shape)
    if truth > padding + 1e-3:
        assert not collides(field, occupied, RESOLUTION, x, y, cos(yaw), sin(yaw), shape)


@settings(deadline=None, max_examples=200)
@given(robots, scenes, places)
def test_clearance_never_exceeds_the_true_distance(
    robot: Robot, cells: list[tuple[int, int]], place: tuple[float, float, float]
) -> None:
    occupied = occupied_at(cells)
    x, y, yaw = place
    told = clearance(
        distance_field(occupied, RESOLUTION), RESOLUTION, x, y, cos(yaw), sin(yaw), footprint_of(robot, 0.0)
    )
    assert told <= distance_to_polygon(robot, place, occupied) + 1e-3


@pytest.mark.parametrize("robot", [*ROBOTS, LONG, ELL], ids=["x80sv", "jackal", "long", "ell"])
def test_circles_cover_the_outline_and_reach_little_beyond_its_box(robot: Robot) -> None:
    circles = footprint_of(robot, 0.0).circles
    corners = robot.corners
    low, high = corners.min(axis=0), corners.max(axis=0)
    fine = np.stack(np.meshgrid(np.linspace(low[0], high[0], 90), np.linspace(low[1], high[1], 90)), -1).reshape(-1, 2)
    body = fine[contains(corners, fine)]
    away = np.hypot(*(body[:, None] - circles[None, :, :2]).reshape(-1, 2).T).reshape(len(body), -1) - circles[:, 2]
    assert away.min(axis=1).max() <= 0
    assert (circles[:, :2] - circles[:, 2:] >= low - 0.0401).all()
    assert (circles[:, :2] + circles[:, 2:] <= high + 0.0401).all()
    gaps = np.hypot(*(circles[:, None, :2] - circles[None, :, :2]).transpose(2, 0, 1))
    holds = gaps + circles[None, :, 2] <= circles[:, None, 2]
    assert (holds == np.eye(len(circles), dtype=bool)).all(), "a circle in another is looked at for nothing"
