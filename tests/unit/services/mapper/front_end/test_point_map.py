# SPDX-License-Identifier: Apache-2.0
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from services.mapper.front_end.point_map import MIN_NORMAL_COSINE, PointMap, nearest


def directions(rng, n):
    angle = rng.uniform(-np.pi, np.pi, n)
    normals = np.column_stack((np.cos(angle), np.sin(angle)))
    normals[rng.random(n) < 0.3] = 0
    return normals


@settings(max_examples=40)
@given(st.integers(0, 10**6), st.integers(1, 400), st.floats(0.1, 20), st.floats(0.05, 0.7), st.floats(-1e5, 1e5))
def test_nearest_is_the_brute_force_nearest(seed, n, extent, gate, far):
    """Also at negative and at distant coordinates, and over the borders of cells."""
    rng = np.random.default_rng(seed)
    points, normals = far + rng.uniform(-extent, extent, (n, 2)), directions(rng, n)
    found = PointMap(1e-9)
    found.insert(points, normals)
    assert found.n == n
    for (x, y), (nx, ny) in zip(far + rng.uniform(-extent, extent, (20, 2)), directions(rng, 20)):
        squared = (points[:, 0] - x) ** 2 + (points[:, 1] - y) ** 2
        directed = (normals != 0).any(axis=1) & bool(nx or ny)
        squared[directed & (normals @ (nx, ny) <= MIN_NORMAL_COSINE)] = np.inf
        i, d = nearest(x, y, nx, ny, gate, *found.index)
        if squared.min() < gate**2:
            assert d == squared.min()
            assert i == np.argmin(squared)
        else:
            assert i == -1


def test_seeing_the_same_wall_again_does_not_grow_the_map():
    rng = np.random.default_rng(0)
    map_ = PointMap(0.1)
    sizes = []
    for _ in range(50):
        points = np.column_stack((rng.uniform(0, 5, 300), 0.01 * rng.normal(size=300)))
        map_.insert(points, np.tile((0.0, 1.0), (300, 1)))
        sizes.append(map_.n)
    assert sizes[-1] < 60
    assert sizes[-1] - sizes[5] <= 5


def test_seeing_a_wall_again_and_again_sharpens_it():
    rng = np.random.default_rng(0)
    map_ = PointMap(0.1)
    for _ in range(30):
        points = np.column_stack((rng.uniform(0, 5, 300), 0.02 * rng.normal(size=300)))
        map_.insert(points, np.tile((0.0, 1.0), (300, 1)))
    assert np.abs(map_.points[: map_.n, 1]).mean() < 0.01


def test_the_two_sides_of_a_thin_wall_are_two_surfaces():
    x = np.arange(0, 2, 0.15)
    map_ = PointMap(0.1)
    map_.insert(np.column_stack((x, np.zeros_like(x))), np.tile((0.0, -1.0), (len(x), 1)))
    map_.insert(np.column_stack((x, np.full_like(x, 0.04))), np.tile((0.0, 1.0), (len(x), 1)))
    assert map_.n == 2 * len(x)
    i, _ = nearest(1.0, 0.0, 0.0, 1.0, 0.5, *map_.index)
    assert map_.points[i, 1] == 0.04


def test_a_point_keeps_the_doubt_of_the_pose_that_first_saw_it():
    map_ = PointMap(0.1)
    walls = [np.array([(x, 0.0)]) for x in np.arange(0, 400, 0.25)]
    for k, point in enumerate(walls):
        map_.insert(point, np.array([(0.0, 1.0)]))
        map_.set_pose_of_new_points(k, -1.0, k * np.eye(3), k)
    map_.insert(walls[7], np.array([(0.0, 1.0)]))
    map_.set_pose_of_new_points(99.0, 99.0, 99 * np.eye(3), 99)
    assert map_.n == len(walls)
    assert_allclose(map_.covariances[: map_.n, 1, 1], np.arange(len(walls)))
    assert_allclose(map_.positions[7], (7.0, -1.0))
    assert map_.stamps[7] == 7
