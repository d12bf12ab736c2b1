# SPDX-License-Identifier: Apache-2.0
from collections import deque

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.navigator.frontiers import FrontierConfig, Snapshot, find_frontiers
from tests.unit.services.maps import drawn

RADIUS = 0.2
CONFIG = FrontierConfig()


def look(cells, x, y, dropped=(), row=0, column=0, config=CONFIG):
    return find_frontiers(
        Snapshot(cells, row, column, 0.05, x, y, RADIUS, np.array(dropped, np.int64).reshape(-1, 2)), config
    )


CORRIDOR = drawn(
    """
    ##########
    .........?
    .........?
    ##########
    """,
    10,
)  # 5 m long, 1 m wide, open to the unknown at its right end; the picture's left edge borders on it as well


def test_the_open_ends_of_a_corridor_are_its_frontiers():
    found = look(CORRIDOR, 2.5, 1.0)
    assert not found.enclosed
    assert sorted(round(f.cells[:, 1].mean()) for f in found.frontiers) == [0, 89]
    left, right = sorted(found.frontiers, key=lambda f: f.x)
    assert abs(right.yaw) < 0.1
    assert abs(abs(left.yaw) - np.pi) < 0.1
    assert right.size == pytest.approx(1.0)
    assert right.distance == pytest.approx(right.x - 2.5, abs=0.15)


def test_a_goal_is_where_the_robot_fits():
    for frontier in look(CORRIDOR, 2.5, 1.0).frontiers:
        assert 0.5 + RADIUS <= frontier.y <= 1.5 - RADIUS


def test_what_lies_behind_a_gap_too_narrow_is_unreachable():
    cells = CORRIDOR.copy()
    cells[10:18, 60:64] = cells[22:30, 60:64] = 100  # leaves 0.2 m
    found = look(cells, 2.0, 1.0)
    assert [round(f.x) for f in found.frontiers] == [0]
    assert [round(cells[:, 1].mean()) for cells in found.unreachable] == [89]


def test_a_robot_in_a_place_that_became_enclosed_finds_its_way_out_through_the_gap_it_came_by():
    cells = CORRIDOR.copy()
    cells[10:15, 60:64] = cells[25:30, 60:64] = 100  # leaves 0.5 m: less than is wanted, more than the robot
    cells[:, 88:] = 100
    inside = look(cells, 4.0, 1.0)
    assert [round(f.x) for f in inside.frontiers] == [0]
    outside = look(cells, 2.0, 1.0)
    assert [round(f.x) for f in outside.frontiers] == [0]
    cells[15:17, 60:64] = cells[23:25, 60:64] = 100  # 0.3 m
    assert not look(cells, 4.0, 1.0).frontiers


def test_a_gap_beside_a_desk_seen_along_its_edge_is_as_narrow_as_if_the_edge_were_mapped():
    cells = np.full((100, 100), 0, np.int8)
    cells[[0, -1]] = cells[:, [0, -1]] = 100
    cells[10:, 40:] = cells[:, 80:] = -1  # the desk, of which few beams came back; 0.45 m from the wall
    cells[10::8, 40] = cells[10, 40:80:6] = 100
    assert look(cells, 1.0, 3.0).frontiers == ()


def test_gaps_between_beams_do_not_bar_the_way():
    cells = CORRIDOR.copy()
    cells[10:30:4, 30:90] = -1
    assert any(f.cells[:, 1].max() == 89 for f in look(cells, 1.0, 1.0).frontiers)


def test_small_gaps_in_the_map_are_no_frontiers():
    cells = np.full((100, 100), 0, np.int8)
    cells[[0, -1]] = cells[:, [0, -1]] = 100
    cells[30, 30] = cells[60:63, 60:64] = -1
    assert look(cells, 2.0, 2.0).frontiers == ()
    cells[60:72, 60:72] = -1
    assert len(look(cells, 2.0, 2.0).frontiers) == 1


def test_a_sliver_beside_a_wall_is_no_frontier():
    cells = np.full((100, 100), 0, np.int8)
    cells[[0, -1]] = cells[:, [0, -1]] = 100
    cells[40, 20:60] = 100
    cells[41:43, 20:60] = -1  # the wall seen twice, 10 cm apart
    cells[43, 20:59:2] = 100
    assert look(cells, 2.5, 3.5).frontiers == ()


def test_a_dropped_frontier_is_none():
    found = look(CORRIDOR, 2.5, 1.0)
    left, right = sorted(found.frontiers, key=lambda f: f.x)
    rest = look(CORRIDOR, 2.5, 1.0, dropped=right.cells)
    assert [f.x for f in rest.frontiers] == [left.x]


def test_cells_and_goals_are_in_the_map_wherever_the_grid_begins():
    here = look(CORRIDOR, 2.5, 1.0).frontiers
    there = look(CORRIDOR, 2.5 - 6.4, 1.0 + 3.2, row=64, column=-128).frontiers
    for a, b in zip(here, there, strict=True):
        assert (b.x, b.y, b.yaw) == pytest.approx((a.x - 6.4, a.y + 3.2, a.yaw))
        assert (b.cells - a.cells == (64, -128)).all()


def test_a_long_border_is_cut_into_goals():
    cells = np.full((60, 400), -1, np.int8)
    cells[:30] = 0
    found = look(cells, 10.0, 0.7)
    assert len(found.frontiers) >= 6
    assert all(f.size <= CONFIG.max_size + 1e-9 for f in found.frontiers)
    every = {tuple(cell) for f in found.frontiers for cell in f.cells}
    assert {(29, column) for column in range(400)} <= every


def test_a_robot_that_fits_nowhere_is_enclosed():
    cells = np.full((64, 64), 100, np.int8)
    cells[30:33, 30:33] = 0
    assert look(cells, 1.55, 1.55).enclosed
    assert look(np.full((64, 64), -1, np.int8), 10.0, 1.0).enclosed


def test_a_robot_in_space_that_no_beam_crossed_still_starts():
    cells = CORRIDOR.copy()
    cells[16:24, 46:54] = -1  # under the robot
    assert len(look(cells, 2.5, 1.0).frontiers) == 2


def reachable(cells, row, column, clearance):
    """Free cells that 4-connected steps over cells with clearance lead to, by the definition."""
    occupied = np.argwhere(cells >= 65)
    free = (cells >= 0) & (cells <= 25)
    passable = free.copy()
    for r, c in np.argwhere(free):
        if len(occupied) and np.hypot(*(occupied - (r, c)).T).min() < clearance - 1e-6:
            passable[r, c] = False
    if not passable[row, column]:
        return None
    seen, queue = {(row, column)}, deque([(row, column)])
    while queue:
        r, c = queue.popleft()
        for there in ((r, c + 1), (r + 1, c), (r, c - 1), (r - 1, c)):
            inside = 0 <= there[0] < cells.shape[0] and 0 <= there[1] < cells.shape[1]
            if inside and there not in seen and passable[there]:
                seen.add(there)
                queue.append(there)
    return seen


def has_room(cells, row, column):
    """Whether a goal may be there: away from obstacles, and from the middles of 3 x 3 unknown cells less one cell."""
    unknown = np.lib.stride_tricks.sliding_window_view(cells < 0, (3, 3)).all(axis=(2, 3))
    away = (RADIUS + CONFIG.goal_margin) / 0.05 - 1e-6
    near = [(np.argwhere(cells >= 65), away), (np.argwhere(unknown) + 1, away + 1)]
    return all(not len(them) or np.hypot(*(them - (row, column)).T).min() >= least for them, least in near)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32))
def test_goals_are_reachable_and_cells_border_on_the_unknown(seed):
    rng = np.random.default_rng(seed)
    blocks = rng.choice([0, 0, 0, -1, 100], (6, 6))
    cells = np.kron(blocks, np.ones((6, 6), int)).astype(np.int8)
    row, column = (int(v) for v in rng.integers(0, 36, 2))
    rows, columns = np.mgrid[:36, :36]
    under = np.hypot(rows - row, columns - column) * 0.05 <= RADIUS
    cells[under & (cells < 0)] = 0  # the robot stands there
    area = reachable(cells, row, column, (RADIUS + CONFIG.margin) / 0.05)
    if area is None:
        return
    found = look(cells, (column + 0.5) * 0.05, (row + 0.5) * 0.05, config=FrontierConfig(min_size=0.05))
    assert not found.enclosed
    padded = np.pad(cells, 1, constant_values=-1)
    for frontier in found.frontiers:
        goal = int(frontier.y / 0.05), int(frontier.x / 0.05)
        assert goal in area
        assert has_room(cells, *goal)
        assert frontier.distance >= np.hypot(frontier.x - (column + 0.5) * 0.05, frontier.y - (row + 0.5) * 0.05) - 1e-6
        for r, c in frontier.cells:
            assert 0 <= cells[r, c] <= 25
            assert -1 in (padded[r, c + 1], padded[r + 2, c + 1], padded[r + 1, c], padded[r + 1, c + 2])
    mine = {tuple(cell) for f in found.frontiers for cell in f.cells}
    for r, c in area:  # where the robot itself gets to the border and has room, the border was found
        around = padded[r, c + 1], padded[r + 2, c + 1], padded[r + 1, c], padded[r + 1, c + 2]
        if has_room(cells, r, c) and -1 in around:
            assert (r, c) in mine
