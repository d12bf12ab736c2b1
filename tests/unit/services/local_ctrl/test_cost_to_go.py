# SPDX-License-Identifier: Apache-2.0
"""Distance to go is the length of the way where it is free, and leads around what stands on it."""

import heapq
from math import hypot

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from numpy.typing import NDArray

from services.local_ctrl.cost_to_go import CostToGo, CostToGoConfig, carrot, cost_to_go, to_go_at
from shared.distance_field import distance_field

N, RESOLUTION, INSCRIBED = 120, 0.05, 0.2
PLAIN = CostToGoConfig(beside_plan=0, near_obstacles=0, unknown=0)


def solution(
    occupied: NDArray[np.bool_],
    path: NDArray[np.float64],
    config: CostToGoConfig | None = None,
    robot: tuple[float, float] | None = None,
) -> CostToGo:
    field = np.minimum(distance_field(occupied, RESOLUTION), np.float32(20))
    x, y = robot or (float(path[0, 0]), float(path[0, 1]))
    known = np.zeros_like(occupied)
    return cost_to_go(field, known, RESOLUTION, path, (x, y), INSCRIBED, config or CostToGoConfig())


def solved(
    occupied: NDArray[np.bool_], path: NDArray[np.float64], config: CostToGoConfig | None = None
) -> NDArray[np.float32]:
    return solution(occupied, path, config).field


def line(x0: float, y0: float, x1: float, y1: float) -> NDArray[np.float64]:
    n = max(2, round(hypot(x1 - x0, y1 - y0) / 0.05))
    return np.column_stack((np.linspace(x0, x1, n), np.linspace(y0, y1, n)))


def test_in_the_open_it_is_the_distance_to_the_path_s_end() -> None:
    to_go = solved(np.zeros((N, N), bool), line(1, 1, 4.3, 3.1), PLAIN)
    rng = np.random.default_rng(1)
    for x, y in rng.uniform(0.3, 5.6, (200, 2)):
        truth = hypot(4.3 - x, 3.1 - y)
        assert to_go_at(to_go, x, y, RESOLUTION) == pytest.approx(truth, rel=0.06, abs=0.06)


def test_on_a_free_plan_it_is_what_is_left_of_the_plan() -> None:
    path = np.concatenate((line(1, 1, 4, 1), line(4, 1, 4, 4)))
    to_go = solved(np.zeros((N, N), bool), path, CostToGoConfig(beside_plan=5, max_beside_plan=5))
    assert to_go_at(to_go, 1.0, 1.0, RESOLUTION) == pytest.approx(6.0, rel=0.08)
    assert to_go_at(to_go, 4.0, 2.0, RESOLUTION) == pytest.approx(2.0, rel=0.08)


def test_no_way_is_shorter_than_the_one_over_the_grid_s_neighbours() -> None:
    """The continuous way undercuts Dijkstra's over 8 neighbours, never by more than the grid's detour of 8 %."""
    rng = np.random.default_rng(4)
    occupied = np.zeros((N, N), bool)
    for _ in range(10):
        row, column = rng.integers(15, N - 15, 2)
        occupied[row : row + 6, column : column + 6] = True
    end = (110, 110)
    occupied[100:, 100:] = False
    path = line(0.5, 0.5, end[1] * RESOLUTION, end[0] * RESOLUTION)
    to_go = solved(occupied, path, PLAIN)
    field = distance_field(occupied, RESOLUTION)
    m = N // 2
    room = field.reshape(m, 2, m, 2).mean(axis=(1, 3)) - INSCRIBED
    goal = (end[0] // 2, end[1] // 2)
    best, heap = {goal: 0.0}, [(0.0, goal)]
    while heap:
        value, at = heapq.heappop(heap)
        if value > best[at]:
            continue
        for dr in (-1, 0, 1):
            for dc in (-1, 0, 1):
                to = at[0] + dr, at[1] + dc
                if not (0 <= to[0] < m and 0 <= to[1] < m) or room[to] <= 0:
                    continue
                if value + 0.1 * hypot(dr, dc) < best.get(to, np.inf):
                    best[to] = value + 0.1 * hypot(dr, dc)
                    heapq.heappush(heap, (best[to], to))
    compared = [(to_go[at], value) for at, value in best.items() if value > 0.5]
    assert len(compared) > 1000
    for ours, theirs in compared:
        assert 0.9 * theirs - 0.1 <= ours <= 1.06 * theirs + 0.1


def test_the_way_down_leads_around_a_box_on_the_plan() -> None:
    occupied = np.zeros((N, N), bool)
    occupied[50:70, 50:60] = True
    path = line(1.0, 3.0, 5.0, 3.0)
    to_go = solved(occupied, path)
    field = np.minimum(distance_field(occupied, RESOLUTION), np.float32(20))
    x, y, steps = 1.0, 3.0, 0
    while hypot(5.0 - x, 3.0 - y) > 0.2:
        assert field[round(y / RESOLUTION), round(x / RESOLUTION)] > INSCRIBED - RESOLUTION
        x, y = carrot(to_go, x, y, 0.0, RESOLUTION)
        steps += 1
        assert steps < 200


def test_where_a_wall_closes_every_way_it_leads_along_the_plan_to_the_wall() -> None:
    occupied = np.zeros((N, N), bool)
    occupied[:, 60:64] = True
    path = line(1.0, 3.0, 5.0, 3.0)
    found = solution(occupied, path)
    assert found.closed
    assert 2.5 < path[found.i_end, 0] < 2.975 - INSCRIBED
    x, y = 1.0, 4.0
    for _ in range(40):
        x, y = carrot(found.field, x, y, 0.0, RESOLUTION)
    assert hypot(x - path[found.i_end, 0], y - 3.0) < 0.15


def test_a_gap_that_is_wide_enough_opens_the_wall() -> None:
    for width, closed in ((0.3, True), (0.6, False)):
        occupied = np.zeros((N, N), bool)
        occupied[:, 60:64] = True
        occupied[80 : 80 + round(width / RESOLUTION)] = False
        found = solution(occupied, line(1.0, 3.0, 5.0, 3.0))
        assert found.closed is closed
        assert (found.i_end == len(line(1.0, 3.0, 5.0, 3.0)) - 1) is not closed


def test_who_stands_where_it_does_not_fit_is_led_out() -> None:
    occupied = np.zeros((N, N), bool)
    occupied[57, 30:80] = True  # 0.15 m below the robot
    found = solution(occupied, line(2.5, 3.0, 5.0, 3.0))
    assert not found.closed
    x, y = 2.5, 3.0
    for _ in range(6):
        x, y = carrot(found.field, x, y, 0.0, RESOLUTION)
    assert y > 3.1


def test_a_path_of_one_point_is_a_goal() -> None:
    to_go = solved(np.zeros((N, N), bool), np.array([[3.0, 3.0]]), PLAIN)
    assert np.isfinite(to_go).all()
    assert to_go_at(to_go, 4.0, 3.0, RESOLUTION) == pytest.approx(1.0, abs=0.06)


def test_a_window_of_nothing_but_obstacles_has_finite_distances() -> None:
    assert np.isfinite(solved(np.ones((N, N), bool), line(1, 1, 4, 4))).all()


def test_the_same_scene_gives_the_same_bytes() -> None:
    rng = np.random.default_rng(2)
    occupied = rng.random((N, N)) < 0.01
    path = line(1, 1, 4, 4)
    assert_array_equal(solved(occupied, path), solved(occupied, path))
