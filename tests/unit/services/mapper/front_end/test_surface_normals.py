# SPDX-License-Identifier: Apache-2.0
from math import pi

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from services.mapper.front_end.surface_normals import free_standing_beams, grid_surface, sweep_normals, usable_beams
from shared.geometry import Pose2
from tests.unit.services.mapper.rooms import CORRIDOR, ROOM, box, sweep


@given(st.floats(-pi, pi))
def test_normals_of_a_square_room_point_at_the_laser_along_the_axes(yaw):
    pose = Pose2(0.3, 0.2, yaw)
    origins, ends = sweep(np.array(box(-2, -2, 2, 2)), pose)
    normals = Pose2(0, 0, yaw) @ sweep_normals(origins, ends)
    points = pose @ ends
    directed = np.hypot(*normals.T) > 0
    on_one_wall = np.min(2.2 - np.abs(points), axis=1) < 0.5  # away from the corners
    assert directed[on_one_wall].mean() > 0.9
    assert_allclose(np.hypot(*normals[directed].T), 1, atol=1e-9)
    wall = (np.abs(points[:, 0]) > 1.999) & (np.abs(points[:, 1]) < 1.5) & directed
    assert_allclose(normals[wall, 0], -np.sign(points[wall, 0]), atol=1e-6)


def test_a_gap_ends_a_surface_and_a_lone_pole_has_no_direction():
    ends = np.array([(2.0, y) for y in np.linspace(-0.5, 0.5, 12)])
    pole = np.array([(1.0, 0.6), (1.0, 0.63)])
    normals = sweep_normals(np.zeros((14, 2)), np.concatenate((ends, pole)))
    assert_allclose(normals[:12], np.tile((-1.0, 0.0), (12, 1)), atol=1e-9)
    assert not normals[12:].any()


def test_a_wall_at_a_grazing_angle_keeps_its_direction_to_the_far_end():
    """Beams 1 degree apart land 0.4 m apart at 5 m down a corridor: points without a direction would hold the robot."""
    origins, ends = sweep(CORRIDOR, Pose2(), noise=0.002)
    ends[np.hypot(*ends.T) > 5] = np.nan
    normals = sweep_normals(origins, ends)
    seen = ~np.isnan(ends[:, 0])
    assert (np.abs(normals[seen, 1]) > 0.95).mean() > 0.95


def test_points_far_apart_are_not_found_again_however_squarely_they_were_hit():
    room = np.array(box(-2, -2, 2, 2))
    pose = Pose2(0.1, 0.2, 0.1)
    assert usable_beams(*sweep(room, pose, 180)).mean() > 0.9
    assert usable_beams(*sweep(room, pose, 16)).mean() < 0.5  # what is left are poles and gaps, by their looks


@given(st.floats(-pi, pi), st.floats(0.8, 2.2), st.floats(0.2, 0.5), st.integers(0, 9))
def test_what_stands_free_before_the_walls_is_lone_and_no_wall_is(bearing, away, width, dropped):
    empty, pose = np.array(box(-4, -4, 4, 4)), Pose2()
    at = (Pose2(0, 0, bearing) @ np.array([(away, 0.0)]))[0]
    somebody = np.array(box(at[0] - width / 2, at[1] - width / 2, at[0] + width / 2, at[1] + width / 2))
    origins, ends = sweep(np.concatenate((empty, somebody)), pose)
    ends[dropped::10] = np.nan
    inside = np.hypot(*(ends - at).T) < width
    assert inside.any()
    assert (
        free_standing_beams(origins, ends, False) != inside
    ).sum() <= 1  # a beam that grazes its side may fall far behind
    assert not free_standing_beams(*sweep(empty, pose), False).any()


def test_what_is_wider_than_a_person_or_stands_at_a_wall_is_not_lone():
    room = box(-4, -4, 4, 4)
    for thing in (box(2.0, -0.7, 2.4, 0.7), box(3.75, -0.3, 4.0, 0.3)):
        assert not free_standing_beams(*sweep(np.array([*room, *thing]), Pose2()), False).any()


def test_what_is_hidden_on_one_side_by_what_stands_free_is_lone_too():
    front, behind, third = box(1.5, -0.8, 1.9, 0.1), box(2.5, -0.2, 2.9, 0.7), box(3.3, 0.4, 3.6, 1.3)
    origins, ends = sweep(np.array([*box(-5, -5, 5, 5), *front, *behind, *third]), Pose2())
    on = np.isfinite(ends[:, 0]) & (np.abs(ends) < 4.9).all(axis=1)
    assert on.sum() > 40
    assert (free_standing_beams(origins, ends, True) != on).sum() <= 3  # a beam that grazes a side may fall far behind


def test_two_abreast_stand_free_where_much_walks_though_together_they_are_wide():
    origins, ends = sweep(np.array([*box(-5, -5, 5, 5), *box(1.5, -0.8, 1.9, 0.1), *box(1.7, 0.1, 2.1, 0.9)]), Pose2())
    on = (np.abs(ends) < 4.9).all(axis=1)
    assert (free_standing_beams(origins, ends, True) != on).sum() <= 3
    assert not free_standing_beams(origins, ends, False)[on].any()


def test_beams_without_an_echo_have_no_normal():
    origins, ends = sweep(ROOM, Pose2())
    ends[40:60] = np.nan
    assert not sweep_normals(origins, ends)[40:60].any()


def test_the_surface_of_a_drawn_wall_lies_on_it_and_faces_free_space():
    occupied, free = np.zeros((40, 60), bool), np.zeros((40, 60), bool)
    occupied[10, 5:50] = True
    free[11:35, 5:50] = True
    points, normals = grid_surface(occupied, free, -1.0, 2.0, 0.05)
    assert len(points) == 45
    assert_allclose(points[:, 1], 2.0 + 10.5 * 0.05, atol=1e-9)
    inner = normals[3:-3]
    assert_allclose(inner, np.tile((0.0, 1.0), (len(inner), 1)), atol=1e-9)


def test_a_slanted_wall_of_steps_reads_as_a_line():
    occupied, free = np.zeros((60, 60), bool), np.zeros((60, 60), bool)
    for column in range(5, 55):
        row = 10 + column // 3
        occupied[row, column] = True
        free[row + 1 : row + 15, column] = True
    points, normals = grid_surface(occupied, free, 0.0, 0.0, 0.05)
    slope = np.arctan2(1, 3)
    middle = (points[:, 0] > 0.5) & (points[:, 0] < 2.5)
    tilt = np.arctan2(-normals[middle, 0], normals[middle, 1])
    assert np.abs(tilt - slope).max() < 0.25
    off = points[middle] @ np.array((-np.sin(slope), np.cos(slope)))
    assert off.std() < 0.012


def test_a_grid_without_walls_has_no_surface():
    points, normals = grid_surface(np.zeros((5, 5), bool), np.ones((5, 5), bool), 0.0, 0.0, 0.05)
    assert points.shape == normals.shape == (0, 2)
