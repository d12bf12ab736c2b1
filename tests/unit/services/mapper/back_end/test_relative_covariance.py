# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from services.mapper.back_end.pose_graph import PoseGraph, compose, relative_poses
from services.mapper.back_end.relative_covariance import relative_covariances
from shared.geometry import Pose2
from tests.unit.services.mapper.graphs import CLOSURE, ODOMETRY, driven, information


def chain(n, seed):
    rng = np.random.default_rng(seed)
    graph = PoseGraph()
    graph.add_node(Pose2(3, -2, 1))
    for k in range(1, n):
        step = Pose2(*(rng.normal(size=3) * (1, 1, 0.8)).tolist())
        graph.add_node(graph.pose(k - 1) @ step)
        i, j, step = (k, k - 1, step.inverse()) if rng.random() < 0.5 else (k - 1, k, step)
        graph.add_edge(i, j, step, information(ODOMETRY * rng.uniform(0.3, 1, 3)), loop=False)
    return graph


@pytest.mark.parametrize("seed", range(3))
def test_along_a_chain_it_is_what_many_noisy_drives_scatter(seed):
    """Monte Carlo: samples of all edges, in either direction, and the chain composed from the node."""
    graph = chain(12, seed).snapshot()
    rng = np.random.default_rng(seed)
    n = 40_000
    for start in (0, 5):
        found = relative_covariances(graph, start)
        for target in (0, 11):
            at = np.tile(graph.poses[start], (n, 1))
            step = 1 if target > start else -1
            for k in range(start, target, step):
                e = min(k, k + step)
                error = rng.multivariate_normal(np.zeros(3), np.linalg.inv(graph.information[e]), n)
                i_from_j = compose(np.tile(graph.relative[e], (n, 1)), error)
                forward = graph.i[e] == k
                at = compose(at, i_from_j if forward else relative_poses(i_from_j, np.zeros((n, 3))))
            scatter = np.cov((at - graph.poses[target]).T) if target != start else np.zeros((3, 3))
            scale = np.sqrt(np.outer(np.diag(found[target]), np.diag(found[target])))
            assert_allclose(scatter, found[target], atol=0.03 * scale.max() + 1e-15, rtol=0.03)
            assert_allclose(scatter / np.maximum(scale, 1e-30), found[target] / np.maximum(scale, 1e-30), atol=0.04)


@settings(max_examples=20)
@given(st.integers(0, 1000), st.integers(0, 299))
def test_it_is_symmetric_and_positive_and_zero_at_the_node_itself(seed, node):
    graph, _, _ = driven(seed=seed % 5)
    found = relative_covariances(graph.snapshot(), node)
    assert_array_equal(found, found.transpose(0, 2, 1))
    assert_array_equal(found[node], np.zeros((3, 3)))
    others = np.delete(found, node, axis=0)
    assert (np.linalg.eigvalsh(others)[:, 0] > 0).all()


def determinants(graph, node):
    return np.linalg.det(relative_covariances(graph, node))


@settings(max_examples=50)
@given(st.integers(0, 10**6), st.integers(0, 99), st.integers(0, 99), st.integers(0, 99))
def test_one_more_edge_never_makes_it_larger_at_its_ends_and_leaves_what_is_surer_as_it_is(seed, node, i, j):
    """Farther on it may: the path is chosen greedily, and the best so far need not be the best to a later node."""
    graph, _, _ = driven(100, 0)
    for k in range(0, 60, 20):
        graph.add_edge(k, k + 37, Pose2(), information(CLOSURE), loop=True)
    before = determinants(graph.snapshot(), node)
    if i != j:
        scale = np.random.default_rng(seed).uniform(0.1, 10)
        graph.add_edge(i, j, Pose2(), information(CLOSURE * scale), loop=True)
    after, ends = determinants(graph.snapshot(), node), [i, j]
    assert (after[ends] <= before[ends] * (1 + 1e-6)).all()
    surer = before < after[ends].max() * (1 - 1e-6)
    assert_array_equal(after[surer], before[surer])


def test_closures_make_it_smaller_and_those_that_are_off_do_not():
    graph, _, _ = driven(300, 60)
    snapshot = graph.snapshot()
    without = replace(snapshot, on=~snapshot.loop)
    spread = relative_covariances(without, 299)
    assert np.sqrt(spread[0, 0, 0]) > 0.2
    assert np.sqrt(relative_covariances(snapshot, 299)[:, 0, 0].max()) < 0.6 * np.sqrt(spread[:, 0, 0].max())
    chain_only, _, _ = driven(300, 0)
    assert_allclose(relative_covariances(chain_only.snapshot(), 299), spread)


def test_it_is_never_less_than_what_solving_the_whole_graph_gives():
    """The marginal's determinant, by inverting the dense information of all edges at once."""
    graph, _, _ = driven(120, 40, exact=True)
    snapshot = graph.snapshot()
    n = len(snapshot.nodes)
    whole = np.zeros((3 * n, 3 * n))
    for i, j, block in zip(snapshot.i, snapshot.j, snapshot.information):
        x, y, yaw = relative_poses(snapshot.poses[j], snapshot.poses[i])  # j_from_i
        c, s = np.cos(yaw), np.sin(yaw)
        adjoint = np.array(((c, -s, y), (s, c, -x), (0, 0, 1)))
        jacobian = np.zeros((3, 3 * n))
        jacobian[:, 3 * i : 3 * i + 3], jacobian[:, 3 * j : 3 * j + 3] = -adjoint, np.eye(3)
        whole += jacobian.T @ block @ jacobian
    for node in (0, 77):
        rest = np.delete(np.arange(n), node)
        columns = (3 * rest[:, None] + np.arange(3)).ravel()
        marginal = np.linalg.inv(whole[np.ix_(columns, columns)])
        exact = np.array([np.linalg.det(marginal[3 * k : 3 * k + 3, 3 * k : 3 * k + 3]) for k in range(n - 1)])
        assert (exact <= determinants(snapshot, node)[rest] * (1 + 1e-6)).all()


def test_where_no_way_leads_it_is_infinite():
    graph, _, _ = driven(10, 0)
    graph.add_node(Pose2(5, 5, 0))
    found = relative_covariances(graph.snapshot(), 3)
    assert np.isinf(np.diag(found[10])).all()
    assert np.isfinite(found[:10]).all()
    with pytest.raises(KeyError):
        relative_covariances(graph.snapshot(), 11)
