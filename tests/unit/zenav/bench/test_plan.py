# SPDX-License-Identifier: Apache-2.0
import gzip
import json
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.planner.costmap import CostConfig
from services.planner.search import GridSearch
from shared.config import UserError, load_robot
from shared.ros_map import ros_map_files
from tests.unit.services.maps import planning_data
from zenav.bench.plan.equal_clearance import least_clearance, ratio_to_equal_clearance, ratio_to_least_clearance
from zenav.bench.plan.maps import (
    FREE,
    INFLATED,
    RESOLUTION,
    PlanQuery,
    cell_sized_robot,
    costmap_of,
    enlarged_map,
    read_movingai_map,
    read_movingai_maps,
)
from zenav.bench.plan.measure import grid_search_row, movingai_rows, path_clearance, path_length, planner_row
from zenav.bench.plan.navfn import NavFn
from zenav.bench.plan.report import plan
from zenav.bench.plan.shortest import corners_of, sees, shortest_length

MAPS = ["32room_000", "AR0011SR", "Aftershock", "Berlin_0_256", "Boston_0_512", "arena", "brc202d", "den520d"]
EACH = 25  # scenarios of a map: 200 in all
ROBOT = cell_sized_robot(load_robot("x80sv").robot)


@pytest.mark.parametrize("name", MAPS)
def test_200_scenarios_are_solved_with_the_published_lengths_and_shorter_by_any_angle(name):
    benchmark = read_movingai_map(planning_data() / "movingai", name, EACH)
    assert len(benchmark.scenarios) >= EACH - 8
    assert grid_search_row(benchmark).summary()["wrong"] == 0
    terrain = costmap_of(np.where(benchmark.free, 0, 100).astype(np.int8), RESOLUTION, FREE, ROBOT)
    row, paths = planner_row(terrain, benchmark.scenarios)
    assert (row.solved, row.touched) == (row.n, 0)
    assert sum(map(path_length, paths)) < sum(scenario.optimum for scenario in benchmark.scenarios)


@pytest.mark.parametrize("name", ["AR0011SR", "den520d", "arena"])
def test_the_path_is_hardly_longer_than_the_shortest_of_all(name):
    benchmark = read_movingai_map(planning_data() / "movingai", name, EACH)
    terrain = costmap_of(np.where(benchmark.free, 0, 100).astype(np.int8), RESOLUTION, FREE, ROBOT)
    corners, over = corners_of(benchmark.free), []
    for scenario, path in zip(benchmark.scenarios, planner_row(terrain, benchmark.scenarios)[1]):
        ends = np.array([scenario.start[::-1], scenario.goal[::-1]], float) + 0.5
        if best := shortest_length(benchmark.free, corners, ends, path_length(path)):
            assert best <= path_length(path) + 1e-9
            assert best <= scenario.optimum + 1e-3 + scenario.rounded
            over.append(path_length(path) / best)
    assert np.mean(over) < 1.015


@pytest.mark.parametrize("name", ["den520d", "arena"])
def test_with_costs_every_scenario_is_solved_and_the_clearance_grows(name):
    benchmark = read_movingai_map(planning_data() / "movingai", name, EACH)
    cells = np.where(benchmark.free, 0, 100).astype(np.int8)
    rows = [
        planner_row(costmap_of(cells, RESOLUTION, config, ROBOT), benchmark.scenarios)[0] for config in (FREE, INFLATED)
    ]
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
    octile = path_length(way.astype(float))
    ends = np.array([start[::-1], goal[::-1]], float) + 0.5
    there, back = (shortest_length(free, corners_of(free), e, octile) for e in (ends, ends[::-1]))
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
    assert shortest_length(free, corners_of(free), ends, 20.0) == pytest.approx(2 * math.hypot(1.5, 1.5) + 3)


def test_navfn_by_our_hand_finds_its_way_around_a_wall():
    costs = np.pad(np.full((40, 40), 50, np.uint16), 1)
    costs[5:35, 20] = 0
    for astar in (True, False):
        path = NavFn(costs).path((20, 5), (20, 36), astar)
        assert path_length(path) == pytest.approx(2 * math.hypot(15.5, 15), rel=0.06)
        assert tuple(path[-1]) == (36.5, 20.5)


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 2**32))
def test_no_path_is_shorter_than_the_shortest_of_its_clearance_and_a_detour_is_longer(seed):
    rng = np.random.default_rng(seed)
    cells = np.zeros((60, 80), np.int8)
    cells[[0, -1]], cells[:, [0, -1]] = 100, 100
    for row, column in rng.integers(5, (50, 70), (6, 2)):
        cells[row : row + 5, column : column + 5] = 100
    terrain = costmap_of(cells, RESOLUTION, CostConfig(inflation_radius=0.5, margin=0, least_margin=0), ROBOT)
    free = [(int(r), int(c)) for r, c in np.argwhere(terrain.distance > 3) if r < 60 and c < 80 and not cells[r, c]]
    (start, goal), aside = (free[i] for i in rng.integers(len(free), size=2)), free[rng.integers(len(free))]
    direct, there, on = (
        planner_row(terrain, [PlanQuery(a, b, 0, 0)])[1][0] for a, b in ((start, goal), (start, aside), (aside, goal))
    )
    detour = np.concatenate((there, on[1:]))
    if min(len(direct), len(there), len(on)) < 2 or math.dist(start, goal) < 10:
        return
    over = []
    for path in (direct, detour):
        away = path_clearance(terrain, path) / RESOLUTION
        least = least_clearance(terrain, path, float(away.min()))
        assert least <= away.min() + 1e-6
        shorter = ratio_to_least_clearance(terrain, path, path_length(path), least)
        assert shorter is not None
        over.append(ratio_to_equal_clearance(terrain, path, path_length(path), least, float(away.mean()), shorter))
        assert 1 - 1e-6 <= over[-1] <= shorter
    one, other = (path_clearance(terrain, path) for path in (direct, detour))
    if one.min() >= other.min() and one.mean() >= other.mean():  # then the detour's surplus is reported in full
        assert over[1] >= path_length(detour) / path_length(direct) / 1.01


def test_an_enlarged_map_asks_the_same_questions():
    benchmark = read_movingai_map(planning_data() / "movingai", "arena", 10)
    larger = enlarged_map(benchmark, 4)
    assert larger.free.shape == tuple(4 * n for n in benchmark.free.shape)
    assert all(larger.free[s.start] and larger.free[s.goal] for s in larger.scenarios)


def test_a_maze_of_512_cells_is_too_large_for_the_shortest_length_of_all():
    n, rng = 512, np.random.default_rng(1)
    free = np.zeros((n, n), bool)  # a binary tree: each cell has a corridor up or to the left
    free[::2, ::2] = True
    up = rng.random((n // 2, n // 2)) < 0.5
    up[0], up[1:, 0] = False, True
    rows, columns = np.nonzero(up)
    free[2 * rows - 1, 2 * columns] = True
    rows, columns = np.nonzero(~up[:, 1:])
    free[2 * rows, 2 * columns + 1] = True
    assert shortest_length(free, corners_of(free), np.array([[0.5, 510.5], [510.5, 0.5]]), math.inf) is None


def test_a_map_with_too_many_corners_has_no_any_angle_figure_and_the_rest_of_its_figures(monkeypatch):
    benchmark = read_movingai_map(planning_data() / "movingai", "arena", 5)
    robot = load_robot("x80sv").robot
    rows, left_out = movingai_rows(benchmark, robot)
    assert "length" in rows["NavFn A*"].figures
    assert not left_out
    monkeypatch.setattr("zenav.bench.plan.shortest.MAX_PAIRS", 1)
    rows, left_out = movingai_rows(benchmark, robot)
    assert not any("length" in row.figures for row in rows.values())
    assert rows["ours, free and blocked"].solved == 5
    assert len(left_out) == 1
    assert left_out[0].startswith("arena: too many corners")


def movingai_files(folder, name, rows, scenarios):
    """Writes NAME.map.gz and NAME.map.scen.gz. scenarios: (x, y) of the start, (x, y) of the goal and the optimum."""
    lines = ["type octile", f"height {len(rows)}", f"width {len(rows[0])}", "map", *rows]
    (folder / f"{name}.map.gz").write_bytes(gzip.compress("\n".join(lines).encode()))
    lines = ["version 1", *("\t".join(map(str, (0, name, len(rows[0]), len(rows), *s))) for s in scenarios)]
    (folder / f"{name}.map.scen.gz").write_bytes(gzip.compress("\n".join(lines).encode()))


def test_scenarios_in_water_are_left_out_and_said(tmp_path):
    movingai_files(
        tmp_path, "lake", ["..WW", "..WW", "...."], [(0, 0, 1, 0, 1.0), (2, 0, 3, 0, 1.0), (0, 0, 2, 2, 2.8)]
    )
    benchmark = read_movingai_map(tmp_path, "lake", 5)
    assert [(s.start, s.goal) for s in benchmark.scenarios] == [((0, 0), (0, 1)), ((0, 0), (2, 2))]
    assert not benchmark.free[0, 2]
    assert benchmark.notes == ("lake: 1 of 3 scenarios begin or end in water (W), left out",)


def test_a_map_that_cannot_be_read_or_has_only_water_is_left_out_and_the_others_are_measured(tmp_path):
    movingai_files(tmp_path, "field", ["...", "..."], [(0, 0, 2, 0, 2.0)])
    movingai_files(tmp_path, "sea", ["WWW", "WWW"], [(0, 0, 2, 0, 2.0)])
    movingai_files(tmp_path, "wall", ["@@@", "..."], [(0, 0, 2, 0, 2.0)])
    benchmarks, left_out = read_movingai_maps(tmp_path, 5)
    assert [benchmark.name for benchmark in benchmarks] == ["field"]
    assert ["no scenario on land" in left_out[0], "blocked cell" in left_out[1]] == [True, True]


def test_a_folder_without_maps_is_one_line_with_its_hint(tmp_path):
    with pytest.raises(UserError, match=r"holds no NAME\.map\.gz"):
        read_movingai_maps(tmp_path, 5)
    (tmp_path / "x.map.gz").write_bytes(b"not gzip")
    with pytest.raises(UserError, match="x"):
        read_movingai_maps(tmp_path, 5)


def test_the_report_holds_a_summary_and_what_was_not_kept(tmp_path, capsys):
    source = planning_data() / "movingai"
    folder = tmp_path / "movingai"
    folder.mkdir()
    for name in ("arena.map.gz", "arena.map.scen.gz"):
        (folder / name).symlink_to(source / name)
    rotated = ros_map_files(np.zeros((40, 40), np.int8), 0.05, 0.0, 0.0)
    (tmp_path / "ros_maps").mkdir()
    for name, content in rotated.items():
        (tmp_path / "ros_maps" / name).write_bytes(content.replace(b"0, 0, 0]", b"0, 0, 0.5]"))
    plan(tmp_path, 5, "x80sv", tmp_path / "plan.json")
    report = json.loads((tmp_path / "plan.json").read_text())
    assert report["summary"]["256"]["raw, exact 8-connected"]["wrong"] == 0
    assert report["summary"]["256"]["ours, with costs"]["solved"] == 1
    assert [line.partition(":")[0] for line in report["left_out"]] == ["map"]
    assert "turned by 0.5 rad" in report["left_out"][0]
    assert "NavFn A*" in capsys.readouterr().out
