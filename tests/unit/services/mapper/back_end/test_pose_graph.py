# SPDX-License-Identifier: Apache-2.0
from dataclasses import fields, replace

import msgpack
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from services.mapper.back_end.pose_graph import (
    Graph,
    PoseGraph,
    compose,
    edge_chi2,
    relative_poses,
    transport_covariance,
)
from services.mapper.back_end.solver.optimize import PoseGraphConfig, optimize
from shared.geometry import Pose2, wrapped_all
from tests.unit.services.mapper.graphs import CLOSURE, LAP, ODOMETRY, driven, eight, information

CONFIG = PoseGraphConfig()
numbers = st.floats(-50, 50)
poses = st.builds(Pose2, numbers, numbers, st.floats(-3.1, 3.1))


def row(pose):
    return np.array((pose.x, pose.y, pose.yaw))


def assert_same_poses(a, b, atol):
    assert_allclose(a[:, :2], b[:, :2], rtol=0, atol=atol)
    assert_allclose(wrapped_all(a[:, 2] - b[:, 2]), 0, atol=atol)


@given(poses, poses)
def test_poses_in_arrays_compose_as_poses_do(a, b):
    assert_allclose(compose(row(a), row(b)), row(a @ b), atol=1e-12)
    assert_allclose(relative_poses(row(a), row(b)), row(a.inverse() @ b), atol=1e-9)


@given(poses, poses)
def test_a_covariance_is_carried_as_the_poses_that_it_describes_are(turn, b_from_c):
    """By the derivative: c_from_c' = c_from_b @ b_from_b' @ b_from_c for small motions of b."""
    small = 1e-6
    covariance = np.linalg.inv(information(CLOSURE))
    columns = [row(b_from_c.inverse() @ Pose2(*(small * axis).tolist()) @ b_from_c) / small for axis in np.eye(3)]
    adjoint = np.array(columns).T
    assert_allclose(transport_covariance(b_from_c, covariance), adjoint @ covariance @ adjoint.T, rtol=1e-3, atol=1e-6)


def test_names_rise_and_are_never_given_again():
    graph, _, _ = driven(10, 0)
    graph.remove_node(9)
    assert graph.add_node(Pose2()) == 10
    graph.remove_node(4)
    assert_array_equal(graph.nodes, [0, 1, 2, 3, 5, 6, 7, 8, 10])
    assert graph.pose(5) == Pose2(*graph.poses[4].tolist())
    with pytest.raises(KeyError):
        graph.pose(4)


def test_what_is_no_measurement_is_refused():
    graph, _, _ = driven(3, 0)
    for bad in (np.zeros((3, 3)), np.diag((1.0, 1.0, -1.0)), np.full((3, 3), np.nan), np.eye(3) + np.eye(3, k=1)):
        with pytest.raises(ValueError):
            graph.add_edge(0, 2, Pose2(), bad, loop=True)
    with pytest.raises(ValueError):
        graph.add_edge(1, 1, Pose2(), np.eye(3), loop=True)
    with pytest.raises(KeyError):
        graph.add_edge(0, 7, Pose2(), np.eye(3), loop=True)
    assert graph.n_edges == 2


def test_a_snapshot_does_not_change_with_the_graph():
    graph, _, _ = driven(120, 20)
    before = graph.snapshot()
    kept = {field.name: getattr(before, field.name).copy() for field in fields(before)}
    graph.apply(optimize(before, CONFIG))
    graph.remove_node(30)
    graph.add_node(Pose2())
    for name, array in kept.items():
        assert_array_equal(getattr(before, name), array)
        assert not getattr(before, name).flags.writeable


def test_a_saved_graph_is_the_same_graph():
    """As bytes and back, the names go on where they were, and the optimum has the same bytes."""
    graph, _, _ = driven(150, 20, wrong=0.2)
    graph.remove_node(70)
    graph.apply(optimize(graph.snapshot(), CONFIG))
    saved = graph.snapshot()
    arrays = {f.name: getattr(saved, f.name) for f in fields(saved)}
    pack_map = msgpack.packb({name: (a.dtype.str, a.shape, a.tobytes()) for name, a in arrays.items()})
    unpack_map = msgpack.unpackb(pack_map).items()
    loaded = Graph(**{name: np.frombuffer(data, kind).reshape(shape) for name, (kind, shape, data) in unpack_map})
    again = PoseGraph.of(loaded)
    for name, array in arrays.items():
        assert_array_equal(getattr(again.snapshot(), name), array)
    assert again.add_node(Pose2()) == graph.add_node(Pose2())
    again.add_edge(0, 150, Pose2(), np.eye(3), loop=False)
    assert again.snapshot().edges[-1] > saved.edges[-1]
    assert optimize(loaded, CONFIG).poses.tobytes() == optimize(saved, CONFIG).poses.tobytes()


def test_a_damaged_graph_is_an_error_that_names_the_array():
    graph = driven(20, 0)[0].snapshot()
    broken = graph.poses.copy()
    broken[3, 1] = np.nan
    for name, array in (
        ("poses", broken),
        ("poses", graph.poses[:-1]),
        ("nodes", graph.nodes[::-1].copy()),
        ("edge", graph.i + 100),
        ("information", -graph.information),
        ("loop", graph.loop.astype(np.int64)),
    ):
        field = "i" if name == "edge" else name
        with pytest.raises(ValueError, match=name):
            PoseGraph.of(replace(graph, **{field: array}))


def test_what_was_added_meanwhile_moves_rigidly_with_the_snapshots_last_node():
    graph, _, _ = driven(250, 40)
    older = graph.snapshot()
    last = eight(260)
    for k in range(250, 260):
        step = last[k - 1].inverse() @ last[k]
        graph.add_node(graph.pose(k - 1) @ step)
        graph.add_edge(k - 1, k, step, information(ODOMETRY), loop=False)
    graph.remove_node(120)  # also while the job ran
    graph.remove_node(249)
    before = graph.poses.copy()
    result = optimize(older, CONFIG)
    graph.apply(result)
    known = graph.nodes < 250
    assert_array_equal(graph.poses[known], result.poses[np.isin(older.nodes, graph.nodes)])
    assert np.abs(graph.poses[known] - before[known]).max() > 0.05
    newer = ~known
    assert_allclose(
        relative_poses(graph.poses[newer][:-1], graph.poses[newer][1:]),
        relative_poses(before[newer][:-1], before[newer][1:]),
        atol=1e-12,
    )
    assert_allclose(
        row(Pose2(*result.poses[-1].tolist()).inverse() @ graph.pose(250)),
        row(last[249].inverse() @ last[250]),
        atol=1e-12,
    )


def test_a_closure_found_wrong_stays_off_in_the_graph():
    graph, _, wrong = driven(300, 60, wrong=0.2)
    older = graph.snapshot()
    graph.add_edge(0, 299, Pose2(), information(CLOSURE), loop=True)  # meanwhile
    graph.apply(optimize(older, CONFIG))
    now = graph.snapshot()
    assert not now.on[now.loop][:-1][wrong].any()
    assert now.on.sum() > 299 + 0.9 * (~wrong).sum()
    assert now.on[-1]


@settings(max_examples=20)
@given(st.lists(st.integers(1, 298), min_size=1, max_size=120, unique=True), st.booleans())
def test_removing_nodes_of_a_consistent_graph_moves_nothing(removed, with_loops):
    graph, truth, _ = driven(300, 40 if with_loops else 0, exact=True)
    for node in removed:
        graph.remove_node(node)
    snapshot = graph.snapshot()
    assert_array_equal(snapshot.poses, truth[snapshot.nodes])
    assert edge_chi2(snapshot, snapshot.poses).max() < 1e-9
    result = optimize(snapshot, CONFIG)
    assert_same_poses(result.poses, truth[snapshot.nodes], 1e-9)
    pushed = truth[snapshot.nodes] + 0.02 * np.random.default_rng(0).normal(size=snapshot.poses.shape)
    pushed[snapshot.fixed] = truth[0]
    assert_same_poses(optimize(replace(snapshot, poses=pushed), CONFIG).poses, truth[snapshot.nodes], 1e-5)


def test_removing_a_chains_nodes_leaves_the_optimum_where_it_was():
    """To first order: the closures pull the same on what is left, so it ends within a tenth of what noise moves it."""
    graph, _, _ = driven(300, 0)
    truth = eight(300)
    for k in range(0, 280, 40):
        graph.add_edge(k, 299 - k // 2, truth[k].inverse() @ truth[299 - k // 2], information(CLOSURE), loop=True)
    ends = {0, 299} | set(range(0, 280, 40)) | {299 - k // 2 for k in range(0, 280, 40)}
    whole = optimize(graph.snapshot(), CONFIG)
    moved = np.abs(whole.poses - graph.poses).max()
    graph.apply(whole)
    for node in set(range(300)) - ends:
        graph.remove_node(node)
    thinned = optimize(graph.snapshot(), CONFIG)
    assert moved > 0.2
    assert_same_poses(thinned.poses, whole.poses[sorted(ends)], 0.01)


def test_odometry_still_joins_what_is_left_after_any_removal():
    """Else a wrong closure would have nothing to contradict it."""
    graph, _, _ = driven(300, 80, seed=3)
    for node in range(1, 300, 2):
        graph.remove_node(node)
    snapshot = graph.snapshot()
    odometry = {(int(i), int(j)) for i, j in zip(snapshot.i[~snapshot.loop], snapshot.j[~snapshot.loop])}
    assert odometry == {(k, k + 2) for k in range(0, 298, 2)}


def test_an_hour_in_one_corridor_does_not_grow_the_graph():
    """Each new lap is matched with the first one and thinned out when the next one begins."""
    graph, _, _ = driven(LAP + 1, 0, exact=True)
    lap = eight(LAP + 1)
    sizes = []
    last = LAP
    for _ in range(12):
        new = []
        for k in range(1, LAP + 1, 2):
            node = graph.add_node(lap[k])
            graph.add_edge(last, node, graph.pose(last).inverse() @ lap[k], information(ODOMETRY), loop=False)
            for near in (k - 1, k, min(k + 3, LAP)):
                graph.add_edge(near, node, lap[near].inverse() @ lap[k], information(CLOSURE), loop=True)
            new.append(node)
            last = node
        for node in new[:-1]:
            graph.remove_node(node)
        sizes.append((len(graph.nodes), graph.n_edges))
    nodes, edges = zip(*sizes)
    assert nodes[-1] < LAP + 20
    assert edges[-1] - edges[-2] <= 6
    assert edges[-1] < 5 * LAP


def test_the_node_that_holds_the_map_is_not_removed():
    graph, _, _ = driven(5, 0)
    with pytest.raises(ValueError, match="fixed"):
        graph.remove_node(0)
