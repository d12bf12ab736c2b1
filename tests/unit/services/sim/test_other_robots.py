# SPDX-License-Identifier: Apache-2.0
"""Discs of other robots: they lie inside the footprint and fill it, and a laser and a body meet them as a robot."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from services.sim.other_robots import discs_at, footprint_discs, place_discs
from services.sim.people import RADIUS, X, Y
from shared.config import load_robot
from shared.geometry import Pose2
from shared.messages import RobotDiscs
from shared.polygon import signed_distances
from shared.robot_files import ROBOTS_DIR

ROBOTS = sorted(path.stem for path in ROBOTS_DIR.glob("*.yaml"))
OPEN_M = 0.02
"""of the outline that no disc covers, at most, away from a sharp corner"""


def covered(discs: np.ndarray, points: np.ndarray) -> np.ndarray:
    """m from each point (n, 2) into the nearest disc; negative is outside."""
    return (discs[:, 2] - np.hypot(*(points[:, None] - discs[None, :, :2]).transpose(2, 0, 1))).max(axis=1)


@pytest.mark.parametrize("name", ROBOTS)
def test_the_discs_of_each_robot_are_its_outline_to_two_centimetres(name):
    corners = load_robot(name).robot.corners
    discs = footprint_discs(corners)
    inside = -signed_distances(corners, discs[:, :2])
    assert (discs[:, 2] <= inside + 1e-9).all(), "a disc reaches out of the footprint"
    share = np.linspace(0.15, 0.85, 30)[:, None, None]  # a disc does not reach into a corner
    edges = ((1 - share) * corners + share * np.roll(corners, -1, axis=0)).reshape(-1, 2)
    assert covered(discs, edges).min() > -OPEN_M


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3))
def test_discs_move_with_their_robot(x, y, yaw):
    discs = footprint_discs(load_robot("x80sv").robot.corners)
    moved = discs_at(discs, Pose2(x, y, yaw))
    back = Pose2(x, y, yaw).inverse() @ moved[:, :2]
    assert np.allclose(back, discs[:, :2])
    assert (moved[:, 2] == discs[:, 2]).all()


def test_a_disc_that_comes_out_inside_the_body_only_touches_it_and_what_has_no_row_is_left_out():
    corners = load_robot("x80sv").robot.corners
    rows = np.ones((3, 10))
    place = np.array([0.3, 0.25, 5.0, 6.0], np.float32)
    others = RobotDiscs(0, place, np.zeros(4, np.float32), np.full(4, 0.2, np.float32))
    place_discs(rows, others, corners, np.zeros(3))
    assert rows[:, X].tolist() == pytest.approx([0.3, 0.25, 5.0])
    gaps = signed_distances(corners, rows[:, [X, Y]]) - rows[:, RADIUS]
    assert gaps[:2] == pytest.approx([5e-4, 5e-4])
    assert rows[2, RADIUS] == pytest.approx(0.2)
    place_discs(rows, RobotDiscs(0, *np.zeros((3, 0), np.float32)), corners, np.zeros(3))
    assert (rows[:, X] > 1e4).all()
