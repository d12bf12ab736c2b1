# SPDX-License-Identifier: Apache-2.0
from itertools import pairwise, permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from services.navigator.tour import tours


def places(seed, n):
    rng = np.random.default_rng(seed)
    at = rng.uniform(0, 20, (n, 2))
    return np.hypot(*at.T), np.hypot(*(at[:, None] - at).transpose(2, 0, 1))


def best(first, between, start):
    """By trying every order."""
    rest = [i for i in range(len(first)) if i != start]
    ways = ((start, *order) for order in permutations(rest))
    return first[start] + min(sum(between[a, b] for a, b in pairwise(way)) for way in ways)


@settings(max_examples=60)
@given(st.integers(0, 2**32), st.integers(1, 6))
def test_tours_are_never_shorter_than_the_shortest_and_hardly_longer(seed, n):
    first, between = places(seed, n)
    found = tours(first, between)
    exact = np.array([best(first, between, start) for start in range(n)])
    assert (found >= exact - 1e-9).all()
    assert (found <= 1.2 * exact).all()
    assert found.min() <= 1.1 * exact.min()


def test_on_a_line_the_tour_is_exact():
    at = np.array([3.0, -1.0, 7.0, 5.0])
    found = tours(np.abs(at), np.abs(at[:, None] - at))
    assert found == pytest.approx([3 + 4 + 8, 1 + 8, 7 + 8, 5 + 2 + 8])


def test_places_that_nobody_can_get_to_from_each_other_end_it_all_the_same():
    between = np.full((12, 12), 1e6)
    np.fill_diagonal(between, 0.0)
    assert np.isfinite(tours(np.ones(12), between)).all()


def test_without_places_there_is_no_tour():
    assert len(tours(np.zeros(0), np.zeros((0, 0)))) == 0
