# SPDX-License-Identifier: Apache-2.0
"""Point in polygon and distance to the outline against brute force: winding numbers, and points along the outline."""

from itertools import pairwise
from math import inf, pi

import numpy as np
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from shared.config import load_robot
from shared.polygon import contains, distances_to_outline, offsets_from_outline, signed_area, signed_distances
from shared.polygon_kernels import contains_point, distance_to_polygon, distance_to_segment

L_SHAPE = np.array([[-0.3, -0.2], [0.4, -0.2], [0.4, 0.0], [0.0, 0.0], [0.0, 0.3], [-0.3, 0.3]])
ARROW = np.array([[0, 0], [4, 0], [4, 4], [2, 1], [0, 4]], float)
SUBNORMAL_EDGE = np.array([[0.0, 0.0], [0.0, 2.2e-309], [1.0, 0.0]])
REPEATED_CORNER = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
ROBOTS = [load_robot(name).robot for name in ("x80sv", "jackal")]

coordinates = st.floats(-5, 5)
points = st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=8).map(np.array)


@st.composite
def simple_polygons(draw):
    """Star-shaped about a point, so that no edges cross; the corners run counter-clockwise."""
    n = draw(st.integers(3, 9))
    gaps = np.array(draw(st.lists(st.floats(0.2, 1.0), min_size=n, max_size=n)))
    radii = np.array(draw(st.lists(st.floats(0.1, 3.0), min_size=n, max_size=n)))
    assume(gaps.max() < 0.49 * gaps.sum())  # a gap of half a turn would have the point outside
    angles = np.cumsum(gaps / gaps.sum() * 2 * pi)
    centre = np.array((draw(st.floats(-2, 2)), draw(st.floats(-2, 2))))
    return centre + radii[:, None] * np.column_stack((np.cos(angles), np.sin(angles)))


polygons = st.sampled_from([L_SHAPE, ARROW, *(robot.corners for robot in ROBOTS)]) | simple_polygons()


def along_outline(polygon, n=2001):
    """Points on the outline, n an edge."""
    share = np.linspace(0, 1, n)[:, None]
    return np.concatenate([a + share * (b - a) for a, b in zip(polygon, np.roll(polygon, -1, axis=0))])


def winding_number(polygon, point):
    """Turns of the outline about a point that does not lie on it, from the angles of its corners."""
    x, y = (polygon - point).T
    angles = np.arctan2(y, x)
    turns = (np.roll(angles, -1) - angles + pi) % (2 * pi) - pi
    return round(float(turns.sum()) / (2 * pi))


@given(polygons, points)
def test_a_point_is_inside_where_the_outline_turns_once_about_it(polygon, points):
    clear = distances_to_outline(polygon, points) > 1e-6
    expected = [winding_number(polygon, point) == 1 for point in points]
    assert contains(polygon, points)[clear].tolist() == np.array(expected)[clear].tolist()


@settings(deadline=None)
@given(polygons, points)
def test_the_distance_is_that_to_the_nearest_of_many_points_on_the_outline(polygon, points):
    outline = along_outline(polygon)
    longest = np.hypot(*(np.roll(polygon, -1, axis=0) - polygon).T).max()
    for point, distance in zip(points, distances_to_outline(polygon, points)):
        sampled = np.hypot(*(outline - point).T).min()
        assert sampled - longest / 4000 - 1e-9 <= distance <= sampled + 1e-9


@given(polygons, points)
def test_the_offset_leads_from_the_nearest_point_on_its_edge(polygon, points):
    offsets, i_edges = offsets_from_outline(polygon, points)
    for point, offset, i in zip(points, offsets, i_edges):
        a, b = polygon[i], polygon[(i + 1) % len(polygon)]
        foot = point - offset
        assert np.hypot(*(foot - a)) + np.hypot(*(foot - b)) <= np.hypot(*(b - a)) + 1e-9


@settings(deadline=None)
@given(polygons, points)
@example(SUBNORMAL_EDGE, np.array([[0.5, 0.5], [0.0, 1e-309], [-1.0, 0.0]]))
@example(REPEATED_CORNER, np.array([[0.2, 0.2], [2.0, 0.0], [1.0, 0.0]]))
def test_the_kernels_for_one_point_give_the_same_bits(polygon, points):
    inside, signed = contains(polygon, points), signed_distances(polygon, points)
    for (x, y), within, distance in zip(points, inside, signed):
        assert contains_point(polygon, x, y) == within
        assert distance_to_polygon(polygon, x, y) == max(distance, 0.0)


@settings(deadline=None)
@given(coordinates, coordinates, coordinates, coordinates, coordinates, coordinates)
def test_the_distance_to_a_segment_is_that_to_its_nearest_point(x, y, x0, y0, x1, y1):
    share = np.linspace(0, 1, 2001)
    sampled = np.hypot(x - x0 - share * (x1 - x0), y - y0 - share * (y1 - y0)).min()
    distance = distance_to_segment(x, y, x0, y0, x1, y1)
    assert sampled - np.hypot(x1 - x0, y1 - y0) / 4000 - 1e-9 <= distance <= sampled + 1e-9


@given(simple_polygons(), st.integers(0, 8))
def test_the_area_is_that_of_its_triangles_and_changes_sign_with_the_order(polygon, shift):
    def triangle(a, b, c):
        return 0.5 * ((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))

    fan = sum(triangle(polygon[0], b, c) for b, c in pairwise(polygon[1:]))
    assert np.isclose(signed_area(polygon), fan, atol=1e-9)
    assert signed_area(polygon) > 0 > signed_area(polygon[::-1])
    assert np.isclose(signed_area(np.roll(polygon, shift, axis=0)), fan, atol=1e-9)


def test_a_notch_is_outside():
    within = contains(ARROW, np.array([[1, 1], [3, 1], [2, 3], [5, 1], [2, 0.5]]))
    assert within.tolist() == [True, True, False, False, True]


def test_a_repeated_corner_is_as_far_as_one():
    at = np.array([[3.0, 0.0]])
    assert distances_to_outline(REPEATED_CORNER, at)[0] == 2.0
    assert distance_to_polygon(REPEATED_CORNER, 3.0, 0.0) == 2.0
    assert contains_point(REPEATED_CORNER, inf, 0.5) == contains(REPEATED_CORNER, np.array([[inf, 0.5]]))[0]
