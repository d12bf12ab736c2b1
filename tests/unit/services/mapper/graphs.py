# SPDX-License-Identifier: Apache-2.0
"""Made-up pose graphs: a robot that drives a figure of eight again and again, and sees where it has been."""

import numpy as np

from services.mapper.back_end.map_parts import gap_information
from services.mapper.back_end.pose_graph import PoseGraph
from shared.geometry import Pose2
from shared.types import Float64s

ODOMETRY = np.array((0.01, 0.01, 0.005))  # m, m, rad
CLOSURE = np.array((0.03, 0.03, 0.01))
LAP = 100  # keyframes
N_PARTS = 10


def information(sigma: Float64s) -> Float64s:
    """(3, 3), not diagonal, so that a wrong frame is noticed."""
    skewed = np.array(((1.0, 0.4, 0.0), (0.4, 1.5, -0.3), (0.0, -0.3, 1.2)))
    return skewed / np.outer(sigma, sigma)


def noise(rng: np.random.Generator, sigma: Float64s) -> Pose2:
    return Pose2(*rng.multivariate_normal(np.zeros(3), np.linalg.inv(information(sigma))).tolist())


def eight(n: int) -> list[Pose2]:
    """Where the robot truly is."""
    t = 2 * np.pi * np.arange(n) / LAP
    x, y = 8 * np.sin(t), 5 * np.sin(2 * t)
    yaw = np.arctan2(10 * np.cos(2 * t), 8 * np.cos(t))
    return [Pose2(*row) for row in np.column_stack((x, y, yaw)).tolist()]


def driven(
    n: int = 300, n_loops: int = 60, wrong: float = 0.0, exact: bool = False, seed: int = 0
) -> tuple[PoseGraph, Float64s, np.ndarray]:
    """The graph as odometry places it, the true poses (n, 3), and which closures are wrong (n_loops,)."""
    rng = np.random.default_rng(seed)
    truth = eight(n)
    graph = PoseGraph()
    pose = truth[0]
    graph.add_node(pose)
    for k in range(1, n):
        step = truth[k - 1].inverse() @ truth[k]
        step = step if exact else step @ noise(rng, ODOMETRY)
        pose = truth[k] if exact else pose @ step
        graph.add_node(pose)
        graph.add_edge(k - 1, k, step, information(ODOMETRY), loop=False)
    is_wrong = rng.random(n_loops) < wrong
    for bad in is_wrong:
        j = int(rng.integers(LAP + 5, n))
        i = j - LAP * int(rng.integers(1, j // LAP + 1)) + int(rng.integers(-4, 5))
        i = int(rng.integers(0, j - 20)) if bad else max(i, 0)
        seen = truth[i].inverse() @ truth[j]
        if bad:
            seen = Pose2(*rng.uniform(-1.5, 1.5, 3).tolist())
        elif not exact:
            seen = seen @ noise(rng, CLOSURE)
        graph.add_edge(i, j, seen, information(CLOSURE), loop=True)
    return graph, np.array([(p.x, p.y, p.yaw) for p in truth]), is_wrong


def in_parts(seed: int, size: int, n_sigmas: float) -> PoseGraph:
    """Parts of `size` keyframes that odometry joins, and true closures between the last one and an early one.

    n_sigmas: standard deviation of odometry's errors, as a factor of what its edges claim. The last part is moved to
    where the closures put it, as the mapper does.
    """
    rng = np.random.default_rng(seed)
    gap = gap_information(2.0, 2.0)
    gap_sigmas = n_sigmas / np.sqrt(np.diag(gap))
    graph, truth = PoseGraph(), [Pose2()]
    graph.add_node(truth[0])
    for k in range(N_PARTS * size):
        is_gap = k % size == 0 and k > 0
        truth.append(truth[-1] @ Pose2(0.5, 0, np.pi / (2.25 * size) if k >= 3 * size else 0.0))
        error = Pose2(*rng.normal(0, gap_sigmas).tolist()) if is_gap else noise(rng, ODOMETRY)
        step = truth[k].inverse() @ truth[k + 1] @ error
        graph.add_node(graph.pose(k) @ step)
        graph.add_edge(k, k + 1, step, gap if is_gap else information(ODOMETRY), loop=is_gap)
    i, j = int(rng.integers(1, 5)) * size, N_PARTS * size - 9
    for k in range(9):
        seen = truth[i + k].inverse() @ truth[j + k] @ noise(rng, CLOSURE)
        graph.add_edge(i + k, j + k, seen, information(CLOSURE), loop=True)
    pose = graph.pose(i) @ truth[i].inverse() @ truth[j]
    graph.move_nodes(N_PARTS * size - size + 1, pose @ graph.pose(j).inverse())
    return graph
