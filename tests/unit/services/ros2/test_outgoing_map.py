# SPDX-License-Identifier: Apache-2.0
"""The whole map is sent in time, and a change of it makes the last whole map the present one."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from services.ros2.outgoing_map import GRID_UPDATE, MAP_AGAIN_NS, OutgoingMap
from services.ros2.ros_types import Distro, ros_types
from shared import sample_messages
from shared.grid import update_of_cells
from shared.messages import TILE_CELLS
from shared.ros_messages import RosFrames, RosMessages

STAMP, INTERVAL_NS = 1_700_000_000_123_456_789, 1_000_000_000
MAKE = RosMessages(ros_types(Distro.JAZZY).types, RosFrames())
EMPTY = np.zeros((TILE_CELLS, TILE_CELLS), np.int8)


def map_of(cells: np.ndarray = EMPTY) -> OutgoingMap:
    made = OutgoingMap(MAKE, INTERVAL_NS)
    made.add(sample_messages.map_update(STAMP, cells))
    return made


def laid_over(whole, change) -> np.ndarray:
    """The cells of a whole map after a change, as a ROS node lays one over the other."""
    cells = whole.data.reshape(whole.info.height, whole.info.width).copy()
    part = np.asarray(change.data).reshape(change.height, change.width)
    cells[change.y : change.y + change.height, change.x : change.x + change.width] = part
    return cells


def test_the_map_is_due_after_a_change_once_an_interval_and_again_after_a_while():
    one = OutgoingMap(MAKE, INTERVAL_NS)
    assert one.due(STAMP) is None
    update = sample_messages.map_update(STAMP, EMPTY)
    one.add(update)
    assert one.due(STAMP).info.width == 64
    assert one.due(STAMP + 10) is None
    one.add(update)
    assert one.due(STAMP + 500_000_000) is None
    assert one.due(STAMP + 1_000_000_000) is not None
    assert one.due(STAMP + MAP_AGAIN_NS) is None
    assert one.due(STAMP + 1_000_000_000 + MAP_AGAIN_NS) is not None


def test_a_new_subscriber_makes_the_map_due():
    one = map_of()
    assert one.due(STAMP) is not None
    assert one.due(STAMP + 1) is None
    one.send_now()
    assert one.due(STAMP + 2) is not None


@given(arrays(np.int8, (2, TILE_CELLS, TILE_CELLS), elements=st.integers(-1, 100), fill=st.just(0)))
def test_the_last_whole_map_with_the_newest_change_over_it_is_the_present_map(both):
    one = map_of()
    whole = one.due(STAMP)
    for cells in both:
        one.add(sample_messages.map_update(STAMP, cells))
        change = one.change()
        present = EMPTY if change is None else laid_over(whole, change)
        np.testing.assert_array_equal(present, cells)


def test_a_change_is_the_smallest_rectangle_of_the_cells_that_differ():
    one = map_of()
    one.due(STAMP)
    cells = EMPTY.copy()
    cells[3, 5], cells[10, 7] = 100, -1
    one.add(sample_messages.map_update(STAMP + 1, cells))
    change = one.change()
    assert (change.x, change.y, change.width, change.height) == (5, 3, 3, 8)
    assert change.data[0] == 100
    assert (change.header.frame_id, change.header.stamp.nanosec) == ("map", 123_456_790)


@pytest.mark.parametrize("distro", Distro)
def test_a_change_comes_back_the_same_from_cdr(distro):
    types = ros_types(distro)
    one = OutgoingMap(RosMessages(types.types, RosFrames()), INTERVAL_NS)
    one.add(sample_messages.map_update(STAMP, EMPTY))
    one.due(STAMP)
    one.add(sample_messages.map_update(STAMP, np.eye(TILE_CELLS, dtype=np.int8)))
    data = types.encode(one.change())
    assert types.encode(types.decode(data, GRID_UPDATE)) == data


def test_there_is_no_change_without_a_whole_map_and_none_where_no_cell_differs():
    one = map_of()
    assert one.change() is None
    one.due(STAMP)
    assert one.change() is None


def test_a_map_that_grew_is_sent_whole():
    one = map_of()
    one.due(STAMP)
    one.add(replace(update_of_cells(EMPTY + 1, 0.05, 64 * 0.05, 0.0), map_id=1))
    assert one.change() is None
    assert one.due(STAMP + INTERVAL_NS).info.width == 128
