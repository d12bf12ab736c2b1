# SPDX-License-Identifier: Apache-2.0
"""The map of the Python API: its free points, against every cell by brute force."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from zenav.client.robot_connection import MAX_FREE, MapArray

SIZE = 0.5  # m a cell: few cells, so that all of them can be compared


@given(
    arrays(
        np.int8, st.tuples(st.integers(1, 7), st.integers(1, 7)), elements=st.sampled_from([-1, 0, 20, 30, 31, 100])
    ),
    st.floats(0, 2),
)
def test_a_point_is_free_where_no_other_cell_reaches_into_its_clearance(cells, clearance):
    grid = MapArray(cells, SIZE, -1.0, 2.0)
    found = {(round(x, 6), round(y, 6)) for x, y in grid.free_points(clearance)}
    rows, columns = np.indices(cells.shape)
    framed = np.pad(cells, 1, constant_values=-1)
    bad = np.argwhere((framed < 0) | (framed > MAX_FREE)) - 1
    for row, column in zip(rows.ravel(), columns.ravel(), strict=True):
        nearest = np.hypot(*(bad - (row, column)).T).min() * SIZE
        place = round(-1.0 + (column + 0.5) * SIZE, 6), round(2.0 + (row + 0.5) * SIZE, 6)
        if abs(nearest - clearance - SIZE / 2) > 1e-9:
            assert (place in found) == (nearest > clearance + SIZE / 2)


def test_a_map_without_free_cells_has_no_free_point():
    assert MapArray(np.full((3, 3), -1, np.int8), SIZE, 0.0, 0.0).free_points(0.0).shape == (0, 2)
