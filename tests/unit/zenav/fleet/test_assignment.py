# SPDX-License-Identifier: Apache-2.0
"""Which robot gets which task: the oldest first, the nearest that is free, another one after a failure."""

from math import inf

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from shared.grid import OccupancyGrid, update_of_cells
from zenav.fleet.assignment import RETRY_S, FreeRobot, MapWays, assignments, straight
from zenav.fleet.task_queue import FleetTask, TaskState
from zenav.maps.map_files import grid_from_update, write_map

CELL_M = 0.05
COORDINATE = st.floats(-50, 50)


def task(number=1, x=0.0, y=0.0, only="", failed=(), changed=0.0):
    return FleetTask(
        number, "", ((x, y, None),), only, TaskState.WAITING, "", "", 0, None, tuple(failed), "", 0.0, changed
    )


def robot(name, x=0.0, y=0.0):
    return FreeRobot(name, "0", 0, x, y)


@given(st.lists(st.tuples(COORDINATE, COORDINATE), max_size=6), st.lists(st.tuples(COORDINATE, COORDINATE), max_size=6))
def test_every_task_that_can_has_one_robot_and_each_is_the_nearest_that_is_left(goals, places):
    tasks = [task(i, *goal) for i, goal in enumerate(goals)]
    robots = [robot(f"r{i}", *place) for i, place in enumerate(places)]
    pairs = assignments(tasks, robots, straight, 0.0)
    assert [pair[0].id for pair in pairs] == list(range(min(len(tasks), len(robots))))
    left = set(robots)
    for given_task, chosen in pairs:
        goal = given_task.targets[0][:2]
        assert straight((chosen.x, chosen.y), goal) == min(straight((r.x, r.y), goal) for r in left)
        left.remove(chosen)


def test_a_task_of_one_robot_waits_for_it_and_keeps_no_other_task_waiting():
    pairs = assignments([task(1, only="red"), task(2)], [robot("blue")], straight, 0.0)
    assert [(t.id, r.name) for t, r in pairs] == [(2, "blue")]


def test_after_a_failure_another_robot_comes_first_and_the_same_one_only_after_a_while():
    failed = task(failed=("red",), changed=100.0)
    near_and_far = [robot("red"), robot("blue", 40.0)]
    assert assignments([failed], near_and_far, straight, 100.0 + 2 * RETRY_S)[0][1].name == "blue"
    assert assignments([failed], [robot("red")], straight, 100.0 + RETRY_S / 2) == []
    assert assignments([failed], [robot("red")], straight, 100.0 + RETRY_S)[0][1].name == "red"


@pytest.fixture
def ways(tmp_path):
    """Two rooms of 4 x 4 m whose only door is at the top; a third one has none."""
    cells = np.full((82, 242), 100, np.int8)
    for first in (1, 81, 161):
        cells[1:81, first : first + 79] = 0
    cells[60:80, 75:85] = 0
    grid = grid_from_update(update_of_cells(cells, CELL_M, 0.0, 0.0))
    assert isinstance(grid, OccupancyGrid)
    return MapWays(write_map(grid, tmp_path / "rooms"))


def test_on_a_map_the_way_through_the_door_counts_and_not_the_wall_between(ways):
    assert ways((1.0, 0.5), (1.0, 3.0)) == pytest.approx(2.5, abs=0.1)
    around = ways((3.5, 0.5), (4.5, 0.5))
    assert 5.0 < around < 8.0
    near, far = robot("near", 3.5, 0.5), robot("far", 7.0, 0.5)
    (pair,) = assignments([task(x=4.5, y=0.5)], [near, far], ways, 0.0)
    assert pair[1].name == "far"


def test_a_robot_without_a_way_gets_no_task(ways):
    assert ways((1.0, 1.0), (9.0, 1.0)) == inf
    assert ways((1.0, 1.0), (99.0, 1.0)) == inf
    assert assignments([task(x=9.0, y=1.0)], [robot("red", 1.0, 1.0)], ways, 0.0) == []
