# SPDX-License-Identifier: Apache-2.0
"""The distance field against its definition."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_array_equal

from shared.distance_field import distance_field
from shared.types import Bools, Float32s

small_grids = st.tuples(st.integers(1, 12), st.integers(1, 12)).flatmap(
    lambda shape: arrays(np.bool_, shape, elements=st.integers(0, 5).map(lambda n: n == 0))
)
resolutions = st.sampled_from([0.025, 0.05, 0.1, 1.0])


def brute_force(occupied: Bools, resolution: float) -> Float32s:
    """Every cell against every occupied cell."""
    rows, columns = np.nonzero(occupied)
    if not len(rows):
        return np.full(occupied.shape, np.inf, np.float32)
    row, column = np.indices(occupied.shape)
    squared = (row[..., None] - rows) ** 2 + (column[..., None] - columns) ** 2
    return (resolution * np.sqrt(squared.min(axis=2).astype(float))).astype(np.float32)


@settings(deadline=None)
@given(small_grids, resolutions)
def test_the_field_is_the_brute_force_minimum(occupied: Bools, resolution: float) -> None:
    assert_array_equal(distance_field(occupied, resolution), brute_force(occupied, resolution))


@settings(deadline=None)
@given(small_grids)
def test_turning_the_grid_turns_the_field(occupied: Bools) -> None:
    turned = np.ascontiguousarray(np.rot90(occupied))
    assert_array_equal(distance_field(turned, 1.0), np.rot90(distance_field(occupied, 1.0)))


def test_a_large_sparse_grid_is_the_brute_force_minimum() -> None:
    rng = np.random.default_rng(3)
    occupied = np.zeros((150, 230), bool)
    occupied[rng.integers(0, 150, 60), rng.integers(0, 230, 60)] = True
    assert_array_equal(distance_field(occupied, 0.05), brute_force(occupied, 0.05))


def test_a_grid_of_nothing_is_infinitely_far() -> None:
    assert np.isinf(distance_field(np.zeros((4, 7), bool), 0.05)).all()


def test_a_grid_without_cells_has_a_field_without_cells() -> None:
    for shape in ((0, 0), (0, 3), (3, 0)):
        assert distance_field(np.zeros(shape, bool), 0.05).shape == shape
