# SPDX-License-Identifier: Apache-2.0
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from services.mapper.back_end.solver.sparse_cholesky import elimination_order, factorize, solve


def system(n, m, chained, seed):
    """Blocks (n, n, 3, 3) of J'J with m random pairs, doubles among them; and the pairs."""
    rng = np.random.default_rng(seed)
    i, j = rng.integers(0, n, m), rng.integers(0, n, m)
    if chained:
        i, j = np.concatenate((i, np.arange(n - 1))), np.concatenate((j, np.arange(1, n)))
    i, j = i[i != j], j[i != j]
    dense = np.zeros((3 * n, 3 * n))
    for a, b in zip(i, j):
        jacobian = np.zeros((3, 3 * n))
        jacobian[:, 3 * a : 3 * a + 3], jacobian[:, 3 * b : 3 * b + 3] = rng.normal(size=(2, 3, 3))
        dense += jacobian.T @ jacobian
    return dense.reshape(n, 3, n, 3).transpose(0, 2, 1, 3), i, j


@settings(max_examples=60)
@given(st.integers(1, 40), st.integers(0, 80), st.booleans(), st.integers(0, 10**6))
def test_the_solution_is_the_dense_one(n, m, chained, seed):
    blocks, i, j = system(n, m, chained, seed)
    place, first, rows = elimination_order(n, i, j)
    assert_array_equal(np.sort(place), np.arange(n))
    by_turn = blocks[np.argsort(place)][:, np.argsort(place)]
    columns = np.repeat(np.arange(n), np.diff(first))
    assert (rows > columns).all()
    below = by_turn[rows, columns]
    outside = np.tril(np.abs(by_turn).sum(axis=(2, 3)), -1)
    outside[rows, columns] = 0
    assert not outside.any()
    inverse, lower, definite = factorize(first, rows, by_turn[np.arange(n), np.arange(n)].copy(), below, 0.1)
    assert definite
    right = np.random.default_rng(seed).normal(size=(n, 3))
    found = right.copy()
    solve(first, rows, inverse, lower, found)
    dense = by_turn.transpose(0, 2, 1, 3).reshape(3 * n, 3 * n) + 0.1 * np.eye(3 * n)
    assert_allclose(found.ravel(), np.linalg.solve(dense, right.ravel()), rtol=1e-6, atol=1e-8)


def test_what_is_not_positive_definite_is_noticed():
    blocks, i, j = system(10, 20, True, 0)
    place, first, rows = elimination_order(10, i, j)
    turn = np.argsort(place)
    columns = np.repeat(np.arange(10), np.diff(first))
    by_turn = blocks[turn][:, turn]
    diagonal = by_turn[np.arange(10), np.arange(10)].copy()
    assert not factorize(first, rows, diagonal, by_turn[rows, columns], -1.0)[2]


def test_a_chain_and_a_tree_do_not_fill():
    n = 200
    _, _, rows = elimination_order(n, np.arange(n - 1), np.arange(1, n))
    assert len(rows) == n - 1
    _, _, rows = elimination_order(n, (np.arange(1, n) - 1) // 2, np.arange(1, n))
    assert len(rows) == n - 1
