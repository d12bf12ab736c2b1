# SPDX-License-Identifier: Apache-2.0
"""The window marks what is hit, clears what is seen through, remembers what is out of sight, and forgets in time."""

from math import cos, nan, pi, sin

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from services.local_ctrl.costmap_update import clear_square
from services.local_ctrl.footprint import footprint_of
from services.local_ctrl.local_costmap import CostmapConfig, LocalCostmap
from shared.config import Mount, load_robot
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import TILE_CELLS, LaserScan, MapUpdate, RangeReadings
from shared.types import NS_PER_S

SHAPE = footprint_of(load_robot("x80sv").robot, 0.03)
NOW = 100 * NS_PER_S
N_BEAMS = 360


def sweep(ranges: NDArray[np.float32] | float, stamp: int = NOW) -> LaserScan:
    full = np.full(N_BEAMS, ranges, np.float32) if np.isscalar(ranges) else np.asarray(ranges, np.float32)
    return LaserScan(stamp, 0.0, 2 * pi / N_BEAMS, 0.0, 0.1, 5.0, full)


def standing(x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> NDArray[np.float64]:
    return np.tile((x, y, yaw), (N_BEAMS, 1))


def costmap(**config: float | bool) -> LocalCostmap:
    made = LocalCostmap(CostmapConfig.model_validate(config), 3.0)
    made.recentre(0.0, 0.0)
    return made


def at(made: LocalCostmap, x: float, y: float) -> tuple[int, int]:
    return round((y - made.y0) / made.resolution), round((x - made.x0) / made.resolution)


def look(made: LocalCostmap, now: int = NOW, here: Pose2 | None = None) -> None:
    made.refresh(now, here or Pose2(), SHAPE)


@settings(deadline=None, max_examples=50)
@given(st.floats(-2, 2), st.floats(-2, 2), st.floats(-3, 3), st.floats(0.5, 2.5), st.integers(0, N_BEAMS - 1))
def test_a_beam_marks_the_cell_where_it_ends_and_only_there(
    x: float, y: float, yaw: float, away: float, i_beam: int
) -> None:
    made = costmap()
    made.recentre(x, y)
    ranges = np.zeros(N_BEAMS, np.float32)  # under range_min: no measurement
    ranges[i_beam] = away
    made.add_scan(sweep(ranges), standing(x, y, yaw), Mount())
    look(made, here=Pose2(x, y, yaw))
    direction = yaw + i_beam * 2 * pi / N_BEAMS
    hit = (made.x0 - x) + away * cos(direction), (made.y0 - y) + away * sin(direction)
    rows, columns = np.nonzero(made.occupied)
    assert len(rows) == 1
    assert abs(made.x0 + columns[0] * 0.05 - (x + away * cos(direction))) <= 0.0251, hit
    assert abs(made.y0 + rows[0] * 0.05 - (y + away * sin(direction))) <= 0.0251


@settings(deadline=None, max_examples=30)
@given(st.floats(-3, 3), st.floats(-0.4, 0.4), st.floats(-3, 3), st.floats(0.5, 2.0), st.integers(0, N_BEAMS - 1))
def test_the_second_laser_marks_and_clears_from_its_own_mount(
    yaw: float, mount_x: float, mount_yaw: float, away: float, i_beam: int
) -> None:
    made, mount = costmap(), Mount(x=mount_x, y=0.2, yaw=mount_yaw)
    ranges = np.zeros(N_BEAMS, np.float32)
    ranges[i_beam] = away
    laser = Pose2(0.0, 0.0, yaw) @ Pose2(mount.x, mount.y, mount.yaw)
    direction = laser.yaw + i_beam * 2 * pi / N_BEAMS
    end = at(made, laser.x + away * cos(direction), laser.y + away * sin(direction))
    made.add_scan(sweep(ranges), standing(0.0, 0.0, yaw), mount, "scan_2")
    assert set(zip(*np.nonzero(made.evidence))) == {end}
    ranges[i_beam] = 2.5  # now it looks past
    for k in range(1, 3):
        made.add_scan(sweep(ranges, NOW + k * NS_PER_S // 10), standing(0.0, 0.0, yaw), mount, "scan_2")
    assert made.evidence[end] == 0


def test_every_cell_that_a_beam_crosses_becomes_free_and_no_other() -> None:
    made = costmap()
    ranges = np.zeros(N_BEAMS, np.float32)
    ranges[30] = 2.0
    made.add_scan(sweep(ranges), standing(0.01, 0.02), Mount())
    freed = made.free_at > 0
    rows, columns = np.nonzero(freed)
    along = np.linspace(0, 2.0 - 0.05, 20000)
    crossed = {at(made, 0.01 + a * cos(pi / 6), 0.02 + a * sin(pi / 6)) for a in along}
    found = set(zip(rows.tolist(), columns.tolist()))
    assert crossed <= found
    assert len(found - crossed) <= 1  # the cell in which the beam stops


def test_what_a_person_leaves_vanishes_within_two_sweeps_that_see_through() -> None:
    made = costmap()
    made.add_scan(sweep(1.0), standing(), Mount())
    for i in (1, 2):
        look(made)
        assert made.occupied[at(made, 1.0, 0.0)]
        made.add_scan(sweep(2.5, NOW + i * NS_PER_S // 5), standing(), Mount())
    look(made)
    assert not made.occupied[at(made, 1.0, 0.0)]
    assert made.occupied[at(made, 2.5, 0.0)]


def test_beams_without_echo_clear_too_but_take_longer() -> None:
    made = costmap()
    made.add_scan(sweep(1.0), standing(), Mount())
    sweeps = 0
    while look(made) or made.occupied[at(made, 1.0, 0.0)]:  # type: ignore[func-returns-value]
        sweeps += 1
        made.add_scan(sweep(nan, NOW + sweeps * NS_PER_S // 5), standing(), Mount())
    assert sweeps == 4


def test_what_is_too_near_to_measure_clears_nothing() -> None:
    made = costmap()
    made.add_scan(sweep(1.0), standing(), Mount())
    for i in range(9):
        made.add_scan(sweep(0.05, NOW + i), standing(), Mount())
    look(made)
    assert made.occupied[at(made, 1.0, 0.0)]


def test_what_is_out_of_sight_is_remembered_and_then_forgotten() -> None:
    made = costmap(memory=10.0)
    made.add_scan(sweep(1.0), standing(), Mount())
    look(made, NOW + 9 * NS_PER_S)
    assert made.occupied[at(made, 1.0, 0.0)]
    look(made, NOW + 11 * NS_PER_S)
    assert not made.occupied.any()


@settings(deadline=None, max_examples=30)
@given(st.lists(st.tuples(st.floats(-1.2, 1.2), st.floats(-1.2, 1.2)), min_size=1, max_size=8))
def test_rolling_the_window_moves_no_obstacle(ways: list[tuple[float, float]]) -> None:
    made = costmap()
    made.add_scan(sweep(1.0), standing(), Mount())
    look(made)
    before = {(r + made.row, c + made.column) for r, c in zip(*np.nonzero(made.occupied))}
    for x, y in ways:
        made.recentre(x, y)
    look(made, here=Pose2(50.0, 50.0))
    assert {(r + made.row, c + made.column) for r, c in zip(*np.nonzero(made.occupied))} == before


def test_a_window_that_leaps_away_holds_nothing() -> None:
    made = costmap()
    made.add_scan(sweep(1.0), standing(), Mount())
    made.recentre(1e5, -1e5)
    look(made, here=Pose2(1e5, -1e5))
    assert not made.occupied.any()
    assert made.unknown.any()


def test_the_robot_s_own_outline_is_free() -> None:
    made = costmap()
    made.add_scan(sweep(0.15), standing(), Mount())
    look(made)
    assert not made.occupied.any()


def grid_with(row: int, column: int, value: int) -> OccupancyGrid:
    grid = OccupancyGrid()
    cells = np.zeros((1, TILE_CELLS, TILE_CELLS), np.int8)
    cells[0, row, column] = value
    zero = np.zeros(1, np.int32)
    grid.apply(MapUpdate(0, 1, 1, 0.05, zero, zero, cells.reshape(1, -1)))
    return grid


@settings(deadline=None, max_examples=50)
@given(st.floats(-1, 1), st.floats(-1, 1), st.floats(-3, 3))
def test_a_wall_of_the_map_stands_where_the_transform_puts_it(x: float, y: float, yaw: float) -> None:
    made = costmap()
    odom_from_map = Pose2(x, y, yaw)
    grid = grid_with(20, 10, 100)
    made.set_static_map(grid, odom_from_map)
    look(made, here=Pose2(50.0, 50.0))
    wanted = odom_from_map @ np.array([grid.centre(20, 10)])
    rows, columns = np.nonzero(made.occupied)
    assert len(rows) == 1
    assert abs(made.x0 + columns[0] * 0.05 - wanted[0, 0]) <= 0.0251
    assert abs(made.y0 + rows[0] * 0.05 - wanted[0, 1]) <= 0.0251


def test_the_map_gives_way_where_the_laser_has_looked_lately() -> None:
    made = costmap(memory=10.0)
    made.set_static_map(grid_with(20, 10, 100), Pose2())
    x, y = 0.525, 1.025
    look(made)
    assert made.occupied[at(made, x, y)]
    made.add_scan(sweep(2.5), standing(), Mount())
    look(made)
    assert not made.occupied[at(made, x, y)]
    look(made, NOW + 11 * NS_PER_S)
    assert made.occupied[at(made, x, y)]


def test_cells_that_nobody_has_seen_are_unknown() -> None:
    made = costmap()
    made.add_scan(sweep(1.0), standing(), Mount())
    made.set_static_map(OccupancyGrid(), Pose2())
    look(made)
    assert not made.unknown[at(made, 0.5, 0.0)]
    assert made.unknown[at(made, 2.0, 0.0)]


def cone(reading: float, stamp: int = NOW) -> RangeReadings:
    one = [np.full(1, value, np.float32) for value in (0.2, 0.0, 0.0, 0.5, reading)]
    return RangeReadings(stamp, *one)


WANTED, LIMITS = np.ones(1, bool), np.array([[0.1, 0.8]])


def test_an_echo_that_nothing_explains_marks_its_arc() -> None:
    made = costmap()
    made.add_ranges(cone(0.5), Pose2(), WANTED, LIMITS)
    look(made)
    for angle in (-0.2, 0.0, 0.2):
        assert made.occupied[at(made, 0.2 + 0.5 * cos(angle), 0.5 * sin(angle))]
    assert not made.occupied[at(made, 0.5, 0.0)]
    assert not made.occupied[at(made, 0.2 + 0.5 * cos(0.5), 0.5 * sin(0.5))]


def test_an_echo_of_what_the_laser_knows_marks_nothing_more() -> None:
    made = costmap()
    ranges = np.zeros(N_BEAMS, np.float32)
    ranges[12] = 0.72  # a door post at the cone's rim
    made.add_scan(sweep(ranges), standing(), Mount())
    look(made)
    made.add_ranges(cone(0.52), Pose2(), WANTED, LIMITS)
    look(made)
    assert made.occupied.sum() == 1


def test_an_echo_vanishes_when_the_cone_is_clear_or_its_time_is_over() -> None:
    for reading, later in ((0.8, 0.1), (nan, 0.1), (0.0, 3.0)):
        made = costmap(echo_memory=2.0)
        made.add_ranges(cone(0.5), Pose2(), WANTED, LIMITS)
        look(made)
        assert made.occupied.any()
        made.add_ranges(cone(reading, NOW + round(later * NS_PER_S)), Pose2(), WANTED, LIMITS)
        look(made, NOW + round(later * NS_PER_S))
        assert not made.occupied[at(made, 0.7, 0.0)]


def test_what_comes_nearer_than_a_range_sensor_measures_stays() -> None:
    made = costmap(echo_memory=2.0)
    made.add_ranges(cone(0.14), Pose2(), WANTED, LIMITS)
    made.add_ranges(cone(nan, NOW + NS_PER_S // 10), Pose2(), WANTED, LIMITS)
    look(made, NOW + NS_PER_S // 10)
    assert made.occupied[at(made, 0.34, 0.0)]


def test_sensors_that_do_not_count_mark_nothing() -> None:
    made = costmap()
    made.add_ranges(cone(0.5), Pose2(), np.zeros(1, bool), LIMITS)
    made = costmap(scan=False)
    made.add_scan(sweep(1.0), standing(), Mount())
    look(made)
    assert not made.occupied.any()


def test_forgetting_empties_the_window() -> None:
    made = costmap()
    made.add_scan(sweep(1.0), standing(), Mount())
    made.add_ranges(cone(0.5), Pose2(), WANTED, LIMITS)
    made.clear()
    look(made)
    assert not made.occupied.any()
    assert made.field.min() == pytest.approx(20.0)


@pytest.mark.parametrize(("outside", "is_near_kept"), [(False, False), (True, True)])
def test_a_square_is_cleared_or_all_but_it(outside, is_near_kept):
    made = costmap(resolution=0.05)
    ranges = np.full(N_BEAMS, 0.8, np.float32)
    ranges[: N_BEAMS // 2] = 1.6  # to the left
    made.add_scan(sweep(ranges), standing(), Mount())
    near, far = at(made, 0.0, -0.8), at(made, 0.0, 1.6)
    assert made.evidence[near] > 0
    assert made.evidence[far] > 0
    clear_square(made, 0.0, 0.0, 2.0, outside)
    assert (made.evidence[near] > 0) == is_near_kept
    assert (made.evidence[far] > 0) != is_near_kept
    assert (made.hit_at[near] > 0) == is_near_kept
