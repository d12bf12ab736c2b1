# SPDX-License-Identifier: Apache-2.0
from itertools import pairwise
from math import floor

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from services.mapper.grid.occupancy import TILE_ARRAYS, Occupancy, OccupancyConfig
from shared.codec import Envelope, encode
from shared.grid import OCCUPIED_FROM, OccupancyGrid, update_of_cells
from shared.runners.transport import oversize

CONFIG = OccupancyConfig()
HIT, MISS = round(100 * CONFIG.hit), round(100 * CONFIG.miss)
NONE = np.full((1, 2), np.nan)
xs = st.floats(-6, 6).map(lambda v: round(v, 3) + 0.00037)  # off the cells' borders, and off their corners
ys = st.floats(-6, 6).map(lambda v: round(v, 3) + 0.00071)


def draw(grid, beams, silent=None):
    """Draws beams [(ox, oy, ex, ey)] as one scan."""
    rows = np.array(beams, float).reshape(-1, 4)
    ends = np.ascontiguousarray(rows[:, 2:])
    grid.insert_scan(np.ascontiguousarray(rows[:, :2]), ends, np.full_like(ends, np.nan) if silent is None else silent)


def cells_of(grid):
    """{(row, column): percent} of the known cells, as readers get them."""
    grid.next_update(0)
    reader = OccupancyGrid()
    reader.apply(grid.all_tiles(0))
    rows, columns = np.nonzero(reader.cells >= 0)
    row0, column0 = reader.first_row * 64, reader.first_column * 64
    return {(int(r) + row0, int(c) + column0): int(reader.cells[r, c]) for r, c in zip(rows, columns)}


def crossed(ox, oy, ex, ey, resolution=0.05):
    """The cells that a beam passes, by brute force: every interval between two borders has its cell."""
    shares = {0.0, 1.0}
    for o, e in ((ox, ex), (oy, ey)):
        low, high = sorted((o, e))
        for k in range(floor(low / resolution), floor(high / resolution) + 2):
            if e != o and 0 < (k * resolution - o) / (e - o) < 1:
                shares.add((k * resolution - o) / (e - o))
    ordered = sorted(shares)
    middles = [(a + b) / 2 for a, b in pairwise(ordered) if b - a > 1e-9]
    passed = {(floor((oy + m * (ey - oy)) / resolution), floor((ox + m * (ex - ox)) / resolution)) for m in middles}
    return passed - {(floor(ey / resolution), floor(ex / resolution))}


@settings(max_examples=60)
@given(st.lists(st.tuples(xs, ys, xs, ys), min_size=1, max_size=12))
def test_a_scan_is_that_of_brute_force_ray_casting(beams):
    grid = Occupancy(CONFIG, 1)
    draw(grid, beams)
    hits = {(floor(ey / 0.05), floor(ex / 0.05)) for _, _, ex, ey in beams}
    free = set().union(*(crossed(*beam) for beam in beams)) - hits
    assert cells_of(grid) == dict.fromkeys(hits, HIT) | dict.fromkeys(free, MISS)


def test_a_hit_wins_over_the_beams_that_cross_it_in_the_same_scan():
    grid = Occupancy(CONFIG, 1)
    draw(grid, [(0, 0.02, 3, 0.02)] * 20 + [(0, 0.02, 1.52, 0.02)])
    assert cells_of(grid)[0, 30] == HIT


def test_a_thing_that_left_fades_within_seconds_however_long_it_stood():
    grid = Occupancy(CONFIG, 1)
    for _ in range(500):
        draw(grid, [(0, 0.02, 1.52, 0.02)])
    assert cells_of(grid)[0, 30] == 96
    for _ in range(10):
        draw(grid, [(0, 0.02, 3, 0.02)])
    assert cells_of(grid)[0, 30] <= 25


def test_one_echo_is_no_wall_yet_but_two_are():
    grid = Occupancy(CONFIG, 1)
    for percent_of in (lambda p: p < OCCUPIED_FROM, lambda p: p >= OCCUPIED_FROM):
        draw(grid, [(0, 0.02, 1.52, 0.02)])
        assert percent_of(cells_of(grid)[0, 30])


@given(st.integers(0, 100))
def test_however_noisy_its_ranges_a_wall_is_as_thick_as_the_cells_it_lies_in(seed):
    """A wall at 2.01 m, near its cell's border, by ranges with a standard deviation of 2 cm."""
    grid = Occupancy(CONFIG, 1)
    rng = np.random.default_rng(seed)
    for _ in range(300):
        draw(grid, [(0, 0.02, 2.01 + min(max(rng.normal(0, 0.02), -0.08), 0.08), 0.02)])
    occupied = [column for (_, column), share in cells_of(grid).items() if share >= OCCUPIED_FROM]
    assert 40 in occupied or 39 in occupied
    assert set(occupied) <= {39, 40, 41}
    assert len(occupied) <= 2


def test_what_is_behind_a_wall_by_more_than_its_noise_is_drawn():
    grid = Occupancy(CONFIG, 1)
    for _ in range(3):
        draw(grid, [(0, 0.02, 2.01, 0.02)])
        draw(grid, [(0, 0.02, 2.01 + CONFIG.hit_depth + 0.05, 0.02)])
    assert cells_of(grid)[0, 43] >= OCCUPIED_FROM


def test_a_wall_that_was_drawn_too_near_gives_way_to_where_it_is():
    grid = Occupancy(CONFIG, 1)
    for _ in range(5):
        draw(grid, [(0, 0.02, 1.8, 0.02)])
    for _ in range(20):
        draw(grid, [(0, 0.02, 2.01, 0.02)])
    assert [c for (_, c), share in cells_of(grid).items() if share >= OCCUPIED_FROM] == [40]


def test_a_beam_without_an_echo_says_nothing_unless_its_reach_is_given():
    grid = Occupancy(CONFIG, 1)
    draw(grid, [(0, 0.02, np.nan, np.nan)])
    assert cells_of(grid) == {}
    draw(grid, [(0, 0.02, np.nan, np.nan)], silent=np.array([(2.0, 0.02)]))
    assert set(cells_of(grid).values()) == {MISS}
    assert len(cells_of(grid)) == 40


def test_what_lies_beyond_the_range_is_not_drawn():
    grid = Occupancy(OccupancyConfig(range_max=2.0), 1)
    draw(grid, [(0, 0.02, 3, 0.02)])
    assert cells_of(grid) == {}


scans = st.lists(st.tuples(st.integers(0, 10**6), st.floats(-40, 40), st.floats(-40, 40), st.booleans()), max_size=8)


@settings(max_examples=30)
@given(scans)
def test_a_readers_grid_equals_the_mappers_after_any_updates(drawn):
    grid, reader = Occupancy(CONFIG, 7), OccupancyGrid()
    versions = []
    for seed, x, y, published in drawn:
        rng = np.random.default_rng(seed)
        origin = np.array((x, y)) + rng.normal(size=2)
        draw(grid, np.column_stack((np.tile(origin, (20, 1)), origin + rng.normal(scale=6, size=(20, 2)))))
        if published and (update := grid.next_update(0)) is not None:
            reader.apply(update)
            versions.append(update.version)
    if (last := grid.next_update(0)) is not None:
        reader.apply(last)
        versions.append(last.version)
    late = OccupancyGrid()
    late.apply(grid.all_tiles(0))
    assert versions == sorted(set(versions))
    assert_array_equal(reader.cells, late.cells)
    assert (reader.x0, reader.y0, reader.version) == (late.x0, late.y0, late.version)


@settings(max_examples=30)
@given(st.lists(st.tuples(st.integers(0, 10**6), st.floats(0.4, 2.8), st.floats(0.4, 2.8)), min_size=1, max_size=6))
def test_edits_that_are_none_and_a_saved_map_change_nothing_of_what_is_drawn_and_asked(scans):
    """Also where all lies in the tile (0, 0)."""
    plain, edited = Occupancy(CONFIG, 1), Occupancy(CONFIG, 1)
    for seed, x, y in scans:
        angles = np.random.default_rng(seed).uniform(-np.pi, np.pi, 40)
        beams = np.column_stack((np.full(40, x), np.full(40, y), x + 0.3 * np.cos(angles), y + 0.3 * np.sin(angles)))
        edited.set_edits({})
        for grid in (plain, edited):
            draw(grid, beams)
    points = np.random.default_rng(0).uniform(0.4, 2.8, (200, 2))
    centre = np.tile(scans[-1][1:], (200, 1))
    edited.set_edits({})
    assert_array_equal(edited.is_free(points, 0), plain.is_free(points, 0))
    edited.set_edits({})
    assert_array_equal(edited.contradicts(centre, points), plain.contradicts(centre, points))
    assert cells_of(edited) == cells_of(plain)
    loaded = Occupancy(CONFIG, 2)
    loaded.load(plain.all_tiles(0))
    assert_array_equal(loaded.is_free(points, 0), plain.is_free(points, 0))


def test_nothing_is_published_when_nothing_changed():
    grid = Occupancy(CONFIG, 1)
    assert grid.next_update(0) is None
    draw(grid, [(0, 0.02, 1, 0.02)])
    assert grid.next_update(0) is not None
    assert grid.next_update(0) is None
    for _ in range(30):
        draw(grid, [(0, 0.02, 1, 0.02)])
    grid.next_update(0)
    draw(grid, [(0, 0.02, 1, 0.02)])  # as sure as it can be: drawn, and the same
    assert grid.next_update(0) is None


def test_only_changed_tiles_are_sent():
    grid = Occupancy(CONFIG, 1)
    draw(grid, [(0.1, 0.1, 30, 0.1)])
    assert len(grid.next_update(0).rows) == 10
    draw(grid, [(0.1, 0.1, 1, 0.1)])
    assert len(grid.next_update(0).rows) == 1


def test_a_hall_is_published_in_messages_that_are_small_enough():
    size = 33 * 64  # 106 m
    cells = np.zeros((size, size), np.int8)
    cells[:3] = cells[:, -3:] = 96
    grid, reader = Occupancy(CONFIG, 1), OccupancyGrid()
    grid.load(update_of_cells(cells, 0.05, 0.0, 0.0))
    updates = list(iter(lambda: grid.next_update(5), None))
    for update in updates:
        assert not oversize(encode(update, Envelope("mapper", "x", 0, 0)))
        reader.apply(update)
    assert sum(len(update.rows) for update in updates) == len(grid.tile_index) == 33 * 33
    assert [update.version for update in updates] == [1, 2, 3]
    late = OccupancyGrid()
    late.apply(grid.all_tiles(0))
    assert_array_equal(reader.cells, late.cells)
    draw(grid, [(1.0, 1.0, 1.5, 1.0)] * 5)
    assert len(grid.next_update(6).rows) == 1


def test_a_saved_map_is_published_as_it_was_saved():
    grid = Occupancy(CONFIG, 1)
    for k in range(6):
        draw(grid, [(0, 0.1 * k, 4, 0.3 * k), (0, 0, -5, 1 - k)])
    grid.next_update(0)
    saved = grid.all_tiles(0)
    again = Occupancy(CONFIG, 2)
    again.load(saved)
    loaded = again.next_update(0)
    assert loaded.map_id == 2
    assert_array_equal(loaded.rows, saved.rows)
    assert_array_equal(loaded.columns, saved.columns)
    assert_array_equal(loaded.cells, saved.cells)


def test_a_beam_contradicts_the_map_in_known_free_space_and_behind_a_wall():
    grid = Occupancy(CONFIG, 1)
    fan = [(0.02, 0.02, 3.02, 0.05 * k + 0.02) for k in range(-30, 31)]
    for _ in range(5):
        draw(grid, fan)
    ends = np.array(((1.5, 0.02), (3.02, 0.02), (3.6, 0.02), (-2.0, 0.02), (3.1, 0.02)))
    assert_array_equal(grid.contradicts(np.full((5, 2), 0.02), ends), (True, False, True, False, False))
    assert_array_equal(grid.is_free(ends, 1), (True, False, False, False, False))


def test_the_grid_grows_in_every_direction():
    grid = Occupancy(CONFIG, 1)
    for x, y in ((50, 50), (-50, 50), (-50, -50), (50, -50)):
        draw(grid, [(x, y, x + 3, y + 1)])
    reader = OccupancyGrid()
    reader.apply(grid.next_update(0))
    for x, y in ((51.5, 50.5), (-48.5, 50.5), (-48.5, -49.5), (51.5, -49.5)):
        assert reader.cells[reader.cell(x, y)] == MISS


def test_after_another_drawing_took_its_place_readers_see_that_and_get_only_what_differs():
    grid, other, reader = Occupancy(CONFIG, 1), Occupancy(CONFIG, 0), OccupancyGrid()
    draw(grid, [(0, 0.02, 1.52, 0.02), (0, 0.02, -20.0, 7.0)])
    reader.apply(grid.next_update(0))
    draw(grid, [(0, 0.02, 0.5, 2.0)])  # not published, so no update has to remove it
    draw(other, [(0, 0.02, 1.52, 0.02), (0, 0.02, 9.0, 9.0)])
    expected = OccupancyGrid()
    expected.apply(other.next_update(0))
    grid.replace_with(other)
    update = grid.next_update(1)
    assert (update.map_id, update.version) == (1, 2)
    reader.apply(update)
    rows, columns = np.nonzero(reader.cells >= 0)
    shown = reader.cells[rows, columns]
    r, c = np.nonzero(expected.cells >= 0)
    assert_array_equal(shown, expected.cells[r, c])
    same = Occupancy(CONFIG, 0)
    draw(same, [(0, 0.02, 1.52, 0.02), (0, 0.02, 9.0, 9.0)])
    same.update_cells()
    grid.replace_with(same)
    assert grid.next_update(2) is None
    draw(grid, [(0, 0.02, 9.0, 9.0)])
    assert grid.next_update(3) is not None, "it is drawn on"


def test_a_read_only_grid_answers_as_before_and_takes_less_than_half_the_memory():
    rng = np.random.default_rng(0)
    ends = np.column_stack((rng.uniform(-3, 3, 300), rng.uniform(-0.1, 0.1, 300)))
    origins = np.tile((0.0, 0.02), (300, 1))
    for beams in ([], [(0, 0.02, 1.52, 0.02), (0, 0.02, -20.0, 7.0)]):
        grid, same = Occupancy(CONFIG, 1), Occupancy(CONFIG, 1)
        for _ in range(4):
            draw(grid, beams)
            draw(same, beams)
        grid.make_read_only()
        sizes = [sum(getattr(each, name).nbytes for name in TILE_ARRAYS) for each in (grid, same)]
        assert sizes[0] < 0.5 * sizes[1]
        assert_array_equal(grid.contradicts(origins, ends), same.contradicts(origins, ends))
        assert_array_equal(grid.is_free(ends, 1), same.is_free(ends, 1))
        assert_array_equal(grid.is_near_occupied(ends), same.is_near_occupied(ends))
    assert grid.contradicts(origins, ends).any()
    with pytest.raises(RuntimeError, match="read-only"):
        draw(grid, [(0, 0.02, 1.0, 1.0)])
