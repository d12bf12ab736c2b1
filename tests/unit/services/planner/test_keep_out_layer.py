# SPDX-License-Identifier: Apache-2.0
"""The planner keeps out of zones as of walls, at once, and lets a robot that stands in one drive out."""

import numpy as np
import pytest

from shared import reasons
from shared.geometry import Pose2
from shared.messages import Zones
from shared.polygon import contains
from shared.zones import ZoneConfig
from tests.unit.services.maps import message, room
from tests.unit.services.planner.test_planner import X80, PlannerBench, goes_above, two_ways

MIDDLE = ((3.0, 0.0), (4.0, 0.0), (4.0, 3.0), (3.0, 3.0))
"""In a room of 8 x 4 m it leaves a way over it."""


def zones(*corners, **asks):
    return Zones(0, tuple(ZoneConfig(corners=c, **asks).zone(str(i)) for i, c in enumerate(corners)))


def hold(bench, *corners, **asks):
    return bench.take(bench.planner.zones(zones(*corners, **asks)))


def nearest(path, corners):
    """m from a path to a polygon, 0 inside."""
    points = np.column_stack((path.xs, path.ys))
    polygon = np.array(corners)
    edges = np.concatenate([np.linspace(a, b, 50) for a, b in zip(polygon, np.roll(polygon, -1, axis=0))])
    away = np.hypot(*(points[:, None] - edges).transpose(2, 0, 1)).min()
    return 0.0 if contains(polygon, points).any() else float(away)


def test_the_path_goes_around_a_keep_out_zone_with_the_whole_robot_and_through_a_speed_zone():
    bench = PlannerBench(room(4, 8))
    hold(bench, MIDDLE)
    (path,) = bench.go(Pose2(7.0, 1.0))
    assert path.reason == ""
    assert nearest(path, MIDDLE) > X80.inscribed_radius
    slow = PlannerBench(room(4, 8))
    hold(slow, MIDDLE, speed=0.3)
    assert slow.go(Pose2(7.0, 1.0))[0].length < 6.2


def test_a_zone_that_is_set_under_way_is_planned_around_at_once_and_taken_away_it_is_forgotten():
    bench = PlannerBench(two_ways(), pose=Pose2(3.0, 7.0))
    bench.go(Pose2(8.0, 7.0))
    assert goes_above(bench.out[-1])
    (path,) = hold(bench, ((4.5, 5.0), (5.5, 5.0), (5.5, 9.0), (4.5, 9.0)))
    assert not goes_above(path)
    assert not path.reason
    (path,) = hold(bench)
    assert goes_above(path)


def test_a_goal_in_a_keep_out_zone_is_refused_by_name_also_one_that_becomes_so():
    bench = PlannerBench(room(4, 8))
    bench.go(Pose2(3.5, 1.0))
    assert bench.out[-1].reason == ""
    (path,) = hold(bench, MIDDLE)
    assert (path.reason, len(path.xs)) == (reasons.GOAL_KEEP_OUT.code, 0)
    (path,) = bench.go(Pose2(7.0, 1.0), number=2)
    assert path.reason == ""


def test_zones_that_close_every_way_make_the_goal_unreachable():
    bench = PlannerBench(two_ways(), pose=Pose2(3.0, 4.0))
    hold(bench, ((4.5, -1.0), (5.5, -1.0), (5.5, 10.0), (4.5, 10.0)))
    assert bench.go(Pose2(8.0, 4.0))[0].reason == reasons.UNREACHABLE.code


def test_a_robot_that_stands_deep_in_a_zone_drives_out_by_a_short_way_and_not_in_again():
    deep = ((0.5, 0.3), (6.0, 0.3), (6.0, 3.0), (0.5, 3.0))
    bench = PlannerBench(room(4, 8), pose=Pose2(2.5, 2.2))
    hold(bench, deep)
    (path,) = bench.go(Pose2(7.0, 1.0))
    points = np.column_stack((path.xs, path.ys))
    within = contains(np.array(deep), points)
    assert path.reason == ""
    assert np.count_nonzero(within) * 0.05 < 1.5  # 0.8 m up to its edge; straight to the goal are 3.7 m
    assert not np.diff(within.astype(int)).max() > 0
    outside = np.flatnonzero(~within)
    bench.put(Pose2(*points[outside[len(outside) // 2]]))
    path = bench.pass_time(1.0)
    assert path.reason == ""
    assert nearest(path, deep) > X80.inscribed_radius


def test_on_another_map_of_the_same_size_the_zones_hold_too():
    deep = ((0.5, 0.5), (2.5, 0.5), (2.5, 3.5), (0.5, 3.5))
    bench = PlannerBench(room(4, 8))
    hold(bench, deep)
    bench.go(Pose2(7.0, 1.0))
    before = bench.planner.present.costmap.costs.copy()
    bench.planner.now += 10**9
    bench.take(bench.planner.map(message(room(4, 8), version=1, map_id=2)))
    bench.take(bench.planner.confirm())
    assert np.array_equal(bench.planner.present.costmap.costs, before)


def test_beyond_the_map_a_zone_holds_too():
    bench = PlannerBench(room(4, 3.2)[:, :-4], pose=Pose2(1.0, 2.0), beyond_map=10.0)
    far = ((4.0, 1.0), (5.0, 1.0), (5.0, 3.0), (4.0, 3.0))
    bench.go(Pose2(8.0, 2.0))
    assert nearest(bench.out[-1], far) == 0.0
    (path,) = hold(bench, far)
    assert path.reason == ""
    assert nearest(path, far) > X80.inscribed_radius


@pytest.mark.parametrize("seed", range(3))
def test_following_a_changing_map_under_zones_is_the_same_as_planning_from_the_start(seed):
    rng = np.random.default_rng(seed)
    cells = room(6, 8)
    bench = PlannerBench(cells, pose=Pose2(1.0, 5.0))
    hold(bench, MIDDLE)
    bench.go(Pose2(7.0, 1.0))
    for _ in range(4):
        row, column = rng.integers(4, (116, 150))
        cells = cells.copy()
        cells[row : row + 6, column : column + 6] = 100
        cells[90:110, 14:30] = 0
        bench.show(cells)
        bench.planner.now += 10**9
        list(bench.planner.confirm())
    fresh = PlannerBench(cells, pose=Pose2(1.0, 5.0))
    hold(fresh, MIDDLE)
    fresh.go(Pose2(7.0, 1.0))
    assert np.array_equal(bench.planner.present.costmap.costs, fresh.planner.present.costmap.costs)
