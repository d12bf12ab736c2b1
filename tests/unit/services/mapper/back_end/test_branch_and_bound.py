# SPDX-License-Identifier: Apache-2.0
from math import ceil, cos, hypot, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.mapper.back_end.branch_and_bound import BranchAndBoundConfig, build_pyramid, headings
from services.mapper.back_end.branch_and_bound import search as search_counted
from services.mapper.front_end.voxel_filter import voxel_downsample
from shared.geometry import Pose2, wrapped
from tests.unit.services.mapper.rooms import ROOM, sweep

CONFIG = BranchAndBoundConfig()
EVERYWHERE = CONFIG.model_copy(update={"min_rival_ratio": 0.0})
ASIDE = np.array([20.0, 0.0, 20.0, 0.0])


def search(*arguments):
    return search_counted(*arguments)[0]


def seen(segments, pose, **arguments):
    ends = sweep(segments, pose, **arguments)[1]
    return ends[~np.isnan(ends[:, 0])]


def mapped(segments, *poses):
    return np.concatenate([pose @ seen(segments, pose) for pose in poses])


def lattice(points, pyramid, centre, reach, turn, config):
    """Every pose of the window: headings (n,), k, and the sums of the picture's values there, (n, 2k + 1, 2k + 1)."""
    points = voxel_downsample(points, config.max_points, pyramid.resolution)
    turns = headings(np.percentile(np.hypot(*points.T), 90), turn, pyramid.resolution, config.min_turn_step)
    k = ceil(reach / pyramid.resolution - 1e-9)
    picture, margin = pyramid.levels[0], 2 * k + 1
    padded = np.pad(picture, margin).astype(int)
    sums = np.zeros((len(turns), 2 * k + 1, 2 * k + 1), int)
    for h, heading in enumerate(turns):
        c, s = cos(centre.yaw + heading), sin(centre.yaw + heading)
        for x, y in points:
            column = int(np.floor((centre.x - pyramid.x0 + c * x - s * y) / pyramid.resolution))
            row = int(np.floor((centre.y - pyramid.y0 + s * x + c * y) / pyramid.resolution))
            column = min(max(column, -k - 1), picture.shape[1] + k) + margin
            row = min(max(row, -k - 1), picture.shape[0] + k) + margin
            sums[h] += padded[row - k : row + k + 1, column - k : column + k + 1].T
    return turns, k, sums, 255 * len(points)


def brute_force(points, pyramid, centre, reach, turn, least, config, farther=()):
    """What `search` promises, from the sums of all poses: (x, y, yaw, score) of the best and of its rivals."""
    turns, k, sums, full = lattice(points, pyramid, centre, reach, turn, config)
    poses = [
        (-int(sums[h, a, b]), (h - len(turns) // 2) ** 2 + (a - k) ** 2 + (b - k) ** 2, h, a - k, b - k)
        for h, a, b in np.argwhere((sums > 0) & (sums / full >= least)).tolist()
    ]
    found = []
    if poses:
        found.append(best := min(poses))
        for distance in (config.min_rival_distance, *farther):
            rivals = [
                pose
                for pose in poses
                if -pose[0] >= config.min_rival_ratio * -best[0]
                and (
                    hypot(pose[3] - best[3], pose[4] - best[4]) > distance / pyramid.resolution
                    or abs(wrapped(turns[pose[2]] - turns[best[2]])) > config.min_rival_turn
                )
            ]
            found += [min(rivals)] if rivals else []
    r = pyramid.resolution
    rows = [(centre.x + i * r, centre.y + j * r, wrapped(centre.yaw + turns[h]), -s / full) for s, _, h, i, j in found]
    return np.array(rows).reshape(-1, 4)


def as_rows(candidates):
    return np.array([(c.pose.x, c.pose.y, c.pose.yaw, c.score) for c in candidates]).reshape(-1, 4)


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    n_map=st.integers(0, 60),
    n_beams=st.integers(1, 12),
    levels=st.integers(1, 6),
    reach=st.sampled_from([0.0, 0.4, 1.0, 1.7]),
    turn=st.sampled_from([0.0, 0.3, 3.0, pi]),
    least=st.sampled_from([0.0, 0.3, 0.6]),
    rival=st.sampled_from([0.0, 0.8]),
    farther=st.sampled_from([(), (0.8,), (0.35, 1.2)]),
)
def test_the_search_is_brute_force_over_its_lattice(seed, n_map, n_beams, levels, reach, turn, least, rival, farther):
    rng = np.random.default_rng(seed)
    config = BranchAndBoundConfig(
        resolution=0.1,
        levels=levels,
        min_turn_step=0.1,
        max_points=10,
        min_rival_distance=0.35,
        min_rival_turn=0.35,
        min_rival_ratio=rival,
    )
    pyramid = build_pyramid(rng.uniform(-2, 2, (n_map, 2)), config)
    points = rng.uniform(-1.5, 1.5, (n_beams, 2))
    centre = Pose2(*rng.uniform((-1, -1, -pi), (1, 1, pi)))
    arguments = points, pyramid, centre, reach, turn, least, config, farther
    found, expected = as_rows(search(*arguments)), brute_force(*arguments)
    assert found.shape == expected.shape
    assert found == pytest.approx(expected, abs=1e-12)


def test_a_window_of_many_roots_and_levels_is_searched_exactly():
    """Windows that begin with roots of several cells, none of which end where the window does."""
    config = EVERYWHERE.model_copy(update={"min_turn_step": 0.1})
    pyramid = build_pyramid(mapped(ROOM, Pose2()), config)
    points = seen(ROOM, Pose2(0.6, -0.4, 0.2), n=60)
    arguments = points, pyramid, Pose2(0.1, 0.2, 0.1), 1.85, 0.2, 0.3, config
    expected = brute_force(*arguments)
    assert len(expected) == 2
    assert as_rows(search(*arguments)) == pytest.approx(expected, abs=1e-12)


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(0, 20), levels=st.integers(1, 5))
def test_a_level_holds_the_largest_value_of_the_window_that_begins_at_each_cell(seed, n, levels):
    config = BranchAndBoundConfig(resolution=0.1, levels=levels)
    pyramid = build_pyramid(np.random.default_rng(seed).uniform(-1, 1, (n, 2)), config)
    finest = pyramid.levels[0]
    for k, level in enumerate(pyramid.levels):
        wide = np.pad(finest, (0, 2**k))
        windows = np.lib.stride_tricks.sliding_window_view(wide, (2**k, 2**k))[: level.shape[0], : level.shape[1]]
        assert np.array_equal(level, windows.max(axis=(2, 3)))
        assert not level[[0, -1]].any()
        assert not level[:, [0, -1]].any()


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(1, 20))
def test_a_cell_is_worth_its_distance_to_the_nearest_point_of_the_map(seed, n):
    points = np.random.default_rng(seed).uniform(-1, 1, (n, 2))
    pyramid = build_pyramid(points, CONFIG.model_copy(update={"levels": 1}))
    picture = pyramid.levels[0]
    y, x = (np.indices(picture.shape) + 0.5) * CONFIG.resolution
    away = np.hypot(x[..., None] + pyramid.x0 - points[:, 0], y[..., None] + pyramid.y0 - points[:, 1]).min(axis=2)
    # points are rounded to quarters of a cell: at most 0.9 cm, where the value falls by 10 a metre at most
    assert picture / 255 == pytest.approx(np.maximum(1 - (away / CONFIG.radius) ** 2, 0), abs=0.095)


@pytest.mark.parametrize("true", [Pose2(0.42, -0.3, 2.8), Pose2(-1.38, 1.2, -1.3), Pose2(1.5, -1, -3.1)])
def test_a_robot_that_was_carried_away_is_found(true):
    pyramid = build_pyramid(mapped(ROOM, Pose2(), Pose2(1, 0, 0), Pose2(-1, 1, 0)), CONFIG)
    best, turned = search(seen(ROOM, true, noise=0.01), pyramid, Pose2(), 5.0, pi, 0.5, EVERYWHERE)
    assert best.pose.distance(true) < 0.1
    assert abs(wrapped(best.pose.yaw - true.yaw)) < 0.03
    assert best.score > 0.85
    # the room is a rectangle: only its furniture excludes the pose turned by half a turn
    assert turned.score < 0.9 * best.score
    assert abs(wrapped(turned.pose.yaw - true.yaw - pi)) < 0.1


@pytest.mark.parametrize("reach", [0.85, 1.7, 2.05, 3.5])
def test_the_pose_just_beyond_the_window_is_not_found(reach):
    """The last window of each level reaches beyond the search's: the robot stands a cell outside."""
    pyramid = build_pyramid(mapped(ROOM, Pose2()), CONFIG)
    for true in (Pose2(reach + 0.05, 0, 0), Pose2(0, reach + 0.05, 0)):
        points = true.inverse() @ mapped(ROOM, Pose2())
        for found in search(points, pyramid, Pose2(), reach, 0.0, 0.0, EVERYWHERE):
            assert max(abs(found.pose.x), abs(found.pose.y)) < reach + 1e-6


def test_of_two_rooms_that_look_alike_each_is_the_others_rival():
    true = Pose2(0.5, -0.5, 0.4)
    pyramid = build_pyramid(mapped(np.concatenate((ROOM, ROOM + ASIDE)), Pose2(), Pose2(20, 0, 0)), CONFIG)
    best, rival = search(seen(ROOM, true), pyramid, Pose2(9, 0, 0.3), 13.0, 0.5, 0.6, CONFIG)
    assert rival.score > 0.97 * best.score
    assert abs(best.pose.x - rival.pose.x) == pytest.approx(20, abs=0.1)


def test_along_a_corridor_without_ends_the_nearest_of_equal_poses_counts_and_has_a_rival():
    x = np.arange(-30, 30, 0.05) + 0.02
    corridor = np.concatenate([np.column_stack((x, np.full_like(x, y))) for y in (-1.02, 1.02)])
    points = corridor[np.abs(corridor[:, 0]) < 3]
    best, rival = search(points, build_pyramid(corridor, CONFIG), Pose2(4, 0.1, 0), 2.0, 0.1, 0.6, CONFIG)
    assert (best.pose.x, best.pose.y, best.pose.yaw) == pytest.approx((4, 0, 0), abs=0.051)
    assert rival.score == best.score


def test_the_score_is_that_of_the_pose():
    """A map of the scan itself: at the centre, of a window of one pose, each beam lies on a point of the map."""
    points = seen(ROOM, Pose2())
    (found,) = search(points, build_pyramid(points, CONFIG), Pose2(), 0.0, 0.0, 0.0, CONFIG)
    assert found.pose == Pose2()
    assert 0.95 < found.score <= 1


def test_where_nothing_matches_there_is_no_candidate():
    points, nothing = seen(ROOM, Pose2()), np.zeros((0, 2))
    room = build_pyramid(points, CONFIG)
    assert search(points, room, Pose2(100, 0, 0), 2.0, pi, 0.0, EVERYWHERE) == []
    assert search(points, room, Pose2(1e12, -1e12, 0), 2.0, 0.3, 0.0, EVERYWHERE) == []
    assert search(nothing, room, Pose2(), 2.0, 0.3, 0.0, EVERYWHERE) == []
    assert search(points, build_pyramid(nothing, CONFIG), Pose2(), 2.0, 0.3, 0.0, EVERYWHERE) == []
    assert search(points, room, Pose2(), 2.0, 0.3, 1.01, EVERYWHERE) == []


def test_a_wide_map_has_larger_cells_and_still_finds_the_pose():
    config = CONFIG.model_copy(update={"max_cells": 60_000})
    wide = np.concatenate((mapped(ROOM, Pose2(), Pose2(1, 0, 0)), [[-15.0, -15.0], [15.0, 15.0]]))
    pyramid = build_pyramid(wide, config)
    assert pyramid.levels[0].size <= config.max_cells
    assert pyramid.resolution in (0.1, 0.2, 0.4)
    true = Pose2(0.7, 0.4, 0.5)
    best = search(seen(ROOM, true), pyramid, Pose2(), 2.0, 1.0, 0.6, config)[0]
    assert best.pose.distance(true) < 2 * pyramid.resolution


def test_one_far_point_does_not_make_a_picture_without_bound():
    assert build_pyramid(np.array([[0.0, 0.0], [1e7, -1e7]]), CONFIG).levels[0].size <= CONFIG.max_cells


@given(far=st.floats(0, 100), turn=st.one_of(st.floats(0, 7), st.floats(3, pi)), finest=st.floats(0.001, 0.1))
def test_headings_are_even_and_fill_the_window_and_none_comes_twice(far, turn, finest):
    turns = headings(far, turn, 0.05, finest)
    steps = np.diff(turns)
    step = max(0.05 / max(far, 0.05), finest) + 1e-9
    assert turns[len(turns) // 2] == 0
    assert np.all(steps > 0)
    assert np.all(steps <= step)
    assert np.ptp(steps) < 1e-9 if len(steps) else turn == 0
    left = 2 * pi - (turns[-1] - turns[0])  # of the circle, from the last back to the first
    if turn < 3:
        assert (turns[0], turns[-1]) == pytest.approx((-turn, turn))
        assert left > 0.28
    else:
        assert left >= steps[0] - 1e-9
        assert left <= max(step, 2 * (pi - turn) + 1e-9)


@given(seed=st.integers(0, 2**32 - 1), n=st.integers(0, 300), most=st.integers(1, 100))
def test_a_thinned_scan_is_a_part_of_it_of_few_points(seed, n, most):
    points = np.random.default_rng(seed).normal(0, 5, (n, 2))
    kept = voxel_downsample(points, most, 0.05)
    assert min(n, 1) <= len(kept) <= most
    assert {tuple(p) for p in kept} <= {tuple(p) for p in points}
    assert np.array_equal(kept, voxel_downsample(points, most, 0.05))


def test_a_thinned_scan_is_even_over_space():
    """A near wall of 900 points and a far one of 100, of the same length, count the same."""
    near = np.column_stack((np.linspace(0, 5, 900), np.full(900, 1.0)))
    far = np.column_stack((np.linspace(0, 5, 100), np.full(100, 9.0)))
    kept = voxel_downsample(np.concatenate((near, far)), 60, 0.05)
    assert len(kept) > 40
    assert abs((kept[:, 1] < 5).sum() - (kept[:, 1] > 5).sum()) <= 2
