# SPDX-License-Identifier: Apache-2.0
import gtsam
import numpy as np
import pytest
from numpy.testing import assert_array_equal

from services.mapper.back_end.pose_graph import edge_chi2
from services.mapper.back_end.solver.levenberg_marquardt import levenberg_marquardt
from shared.geometry import wrapped_all
from tests.unit.services.mapper.graphs import driven

GATE = 16.0


def by_gtsam(graph, robust):
    """By gtsam 4.3, whose residual is the logarithm of ours: equal to first order, so optima differ a little."""
    noise = gtsam.noiseModel
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    kernel = noise.mEstimator.GemanMcClure(np.sqrt(GATE))
    for i, j, relative, information, loop in zip(graph.i, graph.j, graph.relative, graph.information, robust):
        model = noise.Gaussian.Information(information, False)
        model = noise.Robust.Create(kernel, model) if loop else model
        factors.add(gtsam.BetweenFactorPose2(int(i), int(j), gtsam.Pose2(*relative), model))
    for k, pose in enumerate(graph.poses):
        values.insert(k, gtsam.Pose2(*pose))
    factors.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(*graph.poses[0]), noise.Isotropic.Sigma(3, 1e-7)))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-14)
    parameters.setAbsoluteErrorTol(1e-14)
    return gtsam.utilities.extractPose2(gtsam.LevenbergMarquardtOptimizer(factors, values, parameters).optimize())


def by_us(graph, robust):
    i, j = (np.array(rows) for rows in graph.rows())
    arrays = graph.poses.copy(), graph.fixed.copy(), i, j, graph.relative.copy(), graph.information.copy(), robust
    return levenberg_marquardt(*arrays, GATE, 200, 1e-14)


@pytest.mark.parametrize("seed", range(3))
def test_the_optimum_of_least_squares_is_gtsams(seed):
    graph = driven(seed=seed)[0].snapshot()
    robust = np.zeros(len(graph.edges), np.bool_)
    found, steps = by_us(graph, robust)
    off = found - by_gtsam(graph, robust)
    assert np.abs(found - graph.poses).max() > 0.3
    assert np.abs(off[:, :2]).max() < 1e-3
    assert np.abs(wrapped_all(off[:, 2])).max() < 3e-4
    assert steps < 10  # quadratic convergence: the derivatives are right


def test_the_optimum_with_a_kernel_is_gtsams():
    """From near it: where the cost has several minima, two solvers may end in different ones."""
    graph = driven()[0]
    robust = graph.snapshot().loop.copy()
    snapshot = graph.snapshot()
    start, _ = by_us(snapshot, np.zeros_like(robust))
    snapshot.poses.flags.writeable = True
    snapshot.poses[:] = start
    found, _ = by_us(snapshot, robust)
    off = found - by_gtsam(snapshot, robust)
    assert np.abs(found - start).max() > 0.01
    assert np.abs(off[:, :2]).max() < 1e-3
    assert np.abs(wrapped_all(off[:, 2])).max() < 3e-4


def test_what_is_held_keeps_its_bits_and_what_no_edge_touches_too():
    graph = driven()[0].snapshot()
    held = graph.fixed.copy()
    held[100:150] = True
    first = graph.i < 200
    first &= graph.j < 200
    i, j = graph.rows()
    rest = graph.relative[first], graph.information[first], graph.loop[first]
    found, _ = levenberg_marquardt(graph.poses.copy(), held, i[first], j[first], *rest, GATE, 50, 1e-8)
    assert_array_equal(found[100:150], graph.poses[100:150])
    assert_array_equal(found[200:], graph.poses[200:])
    assert edge_chi2(graph, found)[first].sum() < edge_chi2(graph, graph.poses)[first].sum()
