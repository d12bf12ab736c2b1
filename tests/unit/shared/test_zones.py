# SPDX-License-Identifier: Apache-2.0
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from shared.geometry import Pose2
from shared.messages import ZoneKind, Zones
from shared.polygon import contains, distances_to_outline
from shared.zones import KeepOut, ZoneConfig, forbidding, mark_cells, polygon_of

coordinates = st.floats(-3, 9)
polygons = st.lists(st.tuples(coordinates, coordinates), min_size=3, max_size=8).map(np.array)
SQUARE = ((2.0, 1.0), (4.0, 1.0), (4.0, 3.0), (2.0, 3.0))


def zone(name="a", corners=SQUARE, **asks):
    return ZoneConfig(corners=corners, **asks).zone(name)


@settings(deadline=None, max_examples=40)
@given(polygons, st.floats(-1, 1), st.floats(-1, 1), st.sampled_from([0.1, 0.25, 0.7]))
@example(np.array([(0.0, 0.0), (0.0, 2.2e-309), (1.0, 0.0)]), 0.0, 0.0, 0.1)  # an edge whose slope overflows
def test_cells_are_marked_whose_centre_is_inside_and_those_that_the_outline_goes_through_and_no_others(
    polygon, x0, y0, resolution
):
    cells = np.zeros((20, 24), bool)
    mark_cells(cells, x0, y0, resolution, polygon)
    rows, columns = np.indices(cells.shape)
    centres = np.column_stack((x0 + (columns.ravel() + 0.5) * resolution, y0 + (rows.ravel() + 0.5) * resolution))
    within = contains(polygon, centres).reshape(cells.shape)
    near = distances_to_outline(polygon, centres).reshape(cells.shape)
    sure = near > 1e-9  # at an edge through a centre either answer is right
    assert cells[within & sure].all()
    assert (near[cells & ~within] <= resolution * 0.5**0.5 + 1e-9).all()
    along = np.linspace(0, 1, 400)[:, None]
    edges = np.concatenate([a + along * (b - a) for a, b in zip(polygon, np.roll(polygon, -1, axis=0))])
    deep = inside_of_cells(edges, x0, y0, resolution, cells.shape)
    assert cells[tuple(deep.T)].all()


def inside_of_cells(points, x0, y0, resolution, shape):
    """(k, 2) rows and columns of the cells in whose inner half points lie: a line's sampling cannot miss those."""
    places = (points - (x0, y0)) / resolution
    index = np.floor(places).astype(int)
    deep = (np.abs(places - index - 0.5) < 0.2).all(axis=1) & (index >= 0).all(axis=1)
    deep &= (index[:, 0] < shape[1]) & (index[:, 1] < shape[0])
    return index[deep][:, ::-1]


def test_a_zone_thinner_than_a_cell_leaves_no_gap():
    cells = np.zeros((20, 20), bool)
    mark_cells(cells, 0.0, 0.0, 1.0, np.array([[0.1, 3.3], [19.9, 16.7], [19.9, 16.71], [0.1, 3.31]]))
    assert cells.any(axis=0).all()
    columns = [np.flatnonzero(column) for column in cells.T]
    assert all(set(range(a.min(), a.max() + 1)) & set(range(b.min() - 1, b.max() + 2)) for a, b in pairwise(columns))


def test_what_lies_a_thousand_kilometres_out_marks_what_is_here_or_nothing():
    cells = np.zeros((8, 8), bool)
    mark_cells(cells, 0.0, 0.0, 0.05, np.array([[9e5, 9e5], [1e6, 9e5], [1e6, 1e6]]))
    assert not cells.any()
    mark_cells(cells, 0.0, 0.0, 0.05, np.array([[-1e6, -1e6], [1e6, -1e6], [1e6, 1e6], [-1e6, 1e6]]))
    assert cells.all()


@pytest.mark.parametrize(
    ("asks", "words"),
    [
        ({"corners": SQUARE[:2]}, "3 to"),
        ({"corners": ((0, 0), (1, 1), (2, 2))}, "no area"),
        ({"corners": ((0, 0), (2, 2), (2, 0), (0, 2.5))}, "cross"),
        ({"corners": ((0, 0), (2e6, 2), (2, 0))}, "farther out"),
        ({"corners": SQUARE, "speed": 1.0, "percent": 50}, "not both"),
        ({"corners": SQUARE, "speed": 0.0}, "greater"),
        ({"corners": SQUARE, "percent": 101}, "less"),
    ],
)
def test_what_is_no_zone_is_told(asks, words):
    with pytest.raises(ValidationError, match=words):
        ZoneConfig(**asks)


def test_without_a_speed_it_is_kept_out_of_and_a_percentage_is_a_share():
    assert zone().kind is ZoneKind.KEEP_OUT
    assert (zone(speed=0.3).kind, zone(speed=0.3).speed, zone(speed=0.3).share) == (ZoneKind.SLOW, 0.3, 1.0)
    assert (zone(percent=50).kind, zone(percent=50).share) == (ZoneKind.SLOW, 0.5)
    zones = zone(speed=0.3), zone("b"), zone("c")
    assert forbidding(zones, (Pose2(3, 2), Pose2(5, 2))) == [zones[1], None]
    assert forbidding((), (Pose2(3, 2),)) == [None]
    assert forbidding(zones, ()) == []


def test_a_robot_in_a_keep_out_zone_may_leave_it_and_it_holds_again_when_all_of_the_robot_is_out():
    keep_out = KeepOut(0.5)
    other = tuple((x + 10, y) for x, y in SQUARE)
    keep_out.take(Zones(0, (zone(), zone("b", other), zone("slow", speed=1.0))))
    assert [len(keep_out.holding), len(keep_out.entered)] == [2, 0]
    assert not keep_out.moved(Pose2(1.9, 2.0))  # beside it, even where its outline is inside
    assert keep_out.moved(Pose2(2.1, 2.0))
    assert (keep_out.entered[0] == polygon_of(zone())).all()
    assert not keep_out.moved(Pose2(1.6, 2.0))
    assert len(keep_out.entered) == 1
    assert keep_out.moved(Pose2(1.4, 2.0))
    assert len(keep_out.holding) == 2
    assert not keep_out.moved(Pose2(1.6, 2.0))


def test_a_zone_that_is_being_left_stays_open_where_others_change():
    keep_out = KeepOut(0.5)
    other = tuple((x + 10, y) for x, y in SQUARE)
    keep_out.take(Zones(0, (zone(),)))
    keep_out.moved(Pose2(2.1, 2.0))
    keep_out.take(Zones(0, (zone("b", other), zone())))
    assert not keep_out.moved(Pose2(1.6, 2.0))
    assert [len(keep_out.holding), len(keep_out.entered)] == [1, 1]
    assert (keep_out.entered[0] == polygon_of(zone())).all()
    keep_out.take(Zones(0, (zone("b", other),)))
    assert len(keep_out.entered) == 0
