# SPDX-License-Identifier: Apache-2.0
import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.planner.costmap import CostConfig
from services.planner.search import GridSearch
from shared.config import UserError, load_robot
from tests.unit.services.maps import planning_data
from zenav.bench.plan.equal_clearance import least_clearance, over_equal, over_least
from zenav.bench.plan.maps import (
    FREE,
    INFLATED,
    RESOLUTION,
    Scenario,
    cell_sized,
    enlarged,
    movingai,
    read_movingai,
    terrain_of,
)
from zenav.bench.plan.measure import clearance, length, ours, raw
from zenav.bench.plan.navfn import NavFn
from zenav.bench.plan.report import plan
from zenav.bench.plan.shortest import corners_of, sees, shortest

MAPS = ["32room_000", "AR0011SR", "Aftershock", "Berlin_0_256", "Boston_0_512", "arena", "brc202d", "den520d"]
EACH = 25  # scenarios of a map: 200 in all
ROBOT = cell_sized(load_robot("x80sv").robot)


@pytest.mark.parametrize("name", MAPS)
def test_200_scenarios_are_solved_with_the_published_lengths_and_shorter_by_any_angle(name):
    benchmark = read_movingai(planning_data() / "movingai", name, EACH)
    assert len(benchmark.scenarios) >= EACH - 8
    assert raw(benchmark).summary()["wrong"] == 0
    terrain = terrain_of(np.where(benchmark.free, 0, 100).astype(np.int8), RESOLUTION, FREE, ROBOT)
    row, paths = ours(terrain, benchmark.scenarios)
    assert (row.solved, row.touched) == (row.n, 0)
    assert sum(map(length, paths)) < sum(scenario.optimum for scenario in benchmark.scenarios)


@pytest.mark.parametrize("name", ["AR0011SR", "den520d", "arena"])
def test_the_path_is_hardly_longer_than_the_shortest_of_all(name):
    benchmark = read_movingai(planning_data() / "movingai", name, EACH)
    terrain = terrain_of(np.where(benchmark.free, 0, 100).astype(np.int8), RESOLUTION, FREE, ROBOT)
    corners, over = corners_of(benchmark.free), []
    for scenario, path in zip(benchmark.scenarios, ours(terrain, benchmark.scenarios)[1]):
        ends = np.array([scenario.start[::-1], scenario.goal[::-1]], float) + 0.5
        if best := shortest(benchmark.free, corners, ends, length(path)):
            assert best <= length(path) + 1e-9
            assert best <= scenario.optimum + 1e-3 + scenario.rounded
            over.append(length(path) / best)
    assert np.mean(over) < 1.015


@pytest.mark.parametrize("name", ["den520d", "arena"])
def test_with_costs_every_scenario_is_solved_and_the_clearance_grows(name):
    benchmark = read_movingai(planning_data() / "movingai", name, EACH)
    cells = np.where(benchmark.free, 0, 100).astype(np.int8)
    rows = [ours(terrain_of(cells, RESOLUTION, config, ROBOT), benchmark.scenarios)[0] for config in (FREE, INFLATED)]
    assert all((row.solved, row.touched) == (row.n, 0) for row in rows)
    # the free one's distances end at a cell, so only how often it is that near can be compared
    near = [np.mean(np.array(row.figures["clearance_mean_m"]) > 0.06) for row in rows]
    assert near[1] > near[0]


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32), st.floats(0.05, 0.4))
def test_the_shortest_of_all_is_symmetric_and_between_the_straight_line_and_the_octile_one(seed, share):
    rng = np.random.default_rng(seed)
    free = rng.random((12, 14)) >= share
    cells = np.argwhere(free)
    start, goal = (tuple(map(int, cells[rng.integers(len(cells))])) for _ in range(2))
    way = GridSearch().cheapest_path(
        np.pad(free, 1).astype(np.uint16), *((r + 1, c + 1) for r, c in (start, goal)), 1, 1
    )
    if not len(way):
        return
    octile = length(way.astype(float))
    ends = np.array([start[::-1], goal[::-1]], float) + 0.5
    there, back = (shortest(free, corners_of(free), e, octile) for e in (ends, ends[::-1]))
    assert there == pytest.approx(back)
    assert math.dist(*ends) - 1e-9 <= there <= octile + 1e-9


def test_a_line_may_touch_a_corner_but_not_pass_between_two():
    free = np.array([[True, True], [False, True]])
    assert sees(free, 0.5, 0.5, 1.0, 1.0)
    assert sees(free, 0.5, 0.5, 1.5, 1.5)
    free[0, 1] = False
    assert not sees(free, 0.5, 0.5, 1.5, 1.5)


def test_around_one_block_the_shortest_path_bends_at_its_corners():
    free = np.ones((9, 9), bool)
    free[3:6, 3:6] = False
    ends = np.array([[1.5, 4.5], [7.5, 4.5]])
    assert shortest(free, corners_of(free), ends, 20.0) == pytest.approx(2 * math.hypot(1.5, 1.5) + 3)


def test_navfn_by_our_hand_finds_its_way_around_a_wall():
    costs = np.pad(np.full((40, 40), 50, np.uint16), 1)
    costs[5:35, 20] = 0
    for astar in (True, False):
        path = NavFn(costs).path((20, 5), (20, 36), astar)
        assert length(path) == pytest.approx(2 * math.hypot(15.5, 15), rel=0.06)
        assert tuple(path[-1]) == (36.5, 20.5)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32))
def test_no_path_is_shorter_than_the_shortest_of_its_clearance_and_a_detour_is_longer(seed):
    rng = np.random.default_rng(seed)
    cells = np.zeros((60, 80), np.int8)
    cells[[0, -1]], cells[:, [0, -1]] = 100, 100
    for row, column in rng.integers(5, (50, 70), (6, 2)):
        cells[row : row + 5, column : column + 5] = 100
    terrain = terrain_of(cells, RESOLUTION, CostConfig(inflation_radius=0.5, margin=0, least_margin=0), ROBOT)
    free = [(int(r), int(c)) for r, c in np.argwhere(terrain.distance > 3) if r < 60 and c < 80 and not cells[r, c]]
    (start, goal), aside = (free[i] for i in rng.integers(len(free), size=2)), free[rng.integers(len(free))]
    direct, there, on = (
        ours(terrain, [Scenario(a, b, 0, 0)])[1][0] for a, b in ((start, goal), (start, aside), (aside, goal))
    )
    detour = np.concatenate((there, on[1:]))
    if min(len(direct), len(there), len(on)) < 2 or math.dist(start, goal) < 10:
        return
    over = []
    for path in (direct, detour):
        away = clearance(terrain, path) / RESOLUTION
        least = least_clearance(terrain, path, float(away.min()))
        assert least <= away.min() + 1e-6
        shorter = over_least(terrain, path, length(path), least)
        over.append(over_equal(terrain, path, length(path), least, float(away.mean()), shorter))
        assert 1 - 1e-6 <= over[-1] <= shorter
    one, other = (clearance(terrain, path) for path in (direct, detour))
    if one.min() >= other.min() and one.mean() >= other.mean():  # then the detour's surplus is told in full
        assert over[1] >= length(detour) / length(direct) / 1.01


def test_an_enlarged_map_asks_the_same_questions():
    benchmark = read_movingai(planning_data() / "movingai", "arena", 10)
    larger = enlarged(benchmark, 4)
    assert larger.free.shape == tuple(4 * n for n in benchmark.free.shape)
    assert all(larger.free[s.start] and larger.free[s.goal] for s in larger.scenarios)


def test_a_folder_without_maps_is_one_line_with_its_mend(tmp_path):
    with pytest.raises(UserError, match=r"holds no NAME\.map\.gz"):
        movingai(tmp_path, 5)
    (tmp_path / "x.map.gz").write_bytes(b"not gzip")
    with pytest.raises(UserError, match="x"):
        movingai(tmp_path, 5)


def test_the_report_holds_a_summary_and_what_was_not_kept(tmp_path, capsys):
    source = planning_data() / "movingai"
    folder = tmp_path / "movingai"
    folder.mkdir()
    for name in ("arena.map.gz", "arena.map.scen.gz"):
        (folder / name).symlink_to(source / name)
    (tmp_path / "ros_maps").mkdir()
    plan(tmp_path, 5, "x80sv", tmp_path / "plan.json")
    report = json.loads((tmp_path / "plan.json").read_text())
    assert report["summary"]["256"]["raw, exact 8-connected"]["wrong"] == 0
    assert report["summary"]["256"]["ours, with costs"]["solved"] == 1
    assert "NavFn A*" in capsys.readouterr().out
