# SPDX-License-Identifier: Apache-2.0
"""The poses that agree best with what was measured between them, and which closures are wrong."""

import numpy as np
from numba import njit
from pydantic import Field

from services.mapper.least_squares import settled
from services.mapper.pose_graph import Graph, Int64s, Optimised, edge_chi2
from shared.config import Section
from shared.geometry import Bools, Float64s, Pose2

NEGLIGIBLE = 1e-9  # of chi2, for a whole graph: what is left is rounding
NARROWING = 4  # of the squared kernel's width, a round
ROUGH = 3  # steps in a round whose optimum is only the next one's start
SETTLING = 5  # rounds in which closures may still change between on and off


class PoseGraphConfig(Section):
    """Optimisation of the pose graph."""

    gate: float = Field(
        16.0, ge=1, le=10_000, description="squared Mahalanobis distance (3 degrees of freedom) of a closure believed"
    )
    iterations: int = Field(20, ge=1, le=1000, description="Levenberg-Marquardt steps at most, in each round")


def optimised(graph: Graph, config: PoseGraphConfig) -> Optimised:
    """The poses that agree best with all edges, by Levenberg-Marquardt; wrong closures are switched off.

    Closures have a Geman-McClure kernel as wide as the gate. Where one lies outside, which a first closure after a long
    way does too, the kernel begins as wide as the largest residual and is narrowed step by step: graduated
    non-convexity (Yang et al., RA-L 2020, GM). If that first, almost quadratic round satisfies all closures, the rest
    is skipped. If not, those that were off before are asked again too: now there is more to judge them by.
    A fixed node keeps its bits; a part without one is held at its first node.
    """
    loops = graph.loop
    solver = _Solver(graph, config)
    poses, on = graph.poses, graph.on | ~loops
    chi2 = edge_chi2(graph, poses)
    width = _width(chi2[loops & on], config.gate)
    while width > 1:
        poses = solver.solved(poses, on, config.gate * width, rough=True)
        chi2 = edge_chi2(graph, poses)
        needed = _width(chi2[loops & on], config.gate)
        if needed > 1 and not on.all():
            on = np.ones_like(on)
            width = needed = _width(chi2[loops], config.gate)
        else:
            width = min(width / NARROWING, needed)
    for _ in range(SETTLING):
        poses = solver.solved(poses, on, config.gate)
        chi2 = edge_chi2(graph, poses)
        before, on = on, ~loops | (chi2 <= config.gate)
        if (on == before).all():
            break
    start = edge_chi2(graph, graph.poses)
    weights = np.where(loops, on * (config.gate / (config.gate + chi2)) ** 2, 1.0)
    moved = Pose2(*poses[-1].tolist()) @ Pose2(*graph.poses[-1].tolist()).inverse() if len(poses) else Pose2()
    return Optimised(
        graph.nodes, poses, graph.edges, weights, chi2,
        float(start[on].sum()), float(chi2[on].sum()), solver.iterations, moved,
    )  # fmt: skip


class _Solver:
    """Levenberg-Marquardt over those edges of a graph that are wanted."""

    def __init__(self, graph: Graph, config: PoseGraphConfig) -> None:
        self.graph, self.config = graph, config
        self.i, self.j = graph.rows()
        self.useful = ~(graph.fixed[self.i] & graph.fixed[self.j])
        self.iterations = 0

    def solved(self, poses: Float64s, on: Bools, gate: float, rough: bool = False) -> Float64s:
        """The poses (n, 3) at the optimum of the edges that are on, found from `poses`."""
        used = on & self.useful
        if not used.any() or float(edge_chi2(self.graph, poses)[used].sum()) < NEGLIGIBLE:
            return poses
        i, j = self.i[used], self.j[used]
        held = self.graph.fixed | _held(len(poses), i, j, self.graph.fixed)
        found, steps = settled(
            poses.copy(), held, i, j, self.graph.relative[used], self.graph.information[used], self.graph.loop[used],
            gate, ROUGH if rough else self.config.iterations, 1e-5 if rough else 1e-6,
        )  # fmt: skip
        self.iterations += steps
        return np.asarray(found)


def _width(chi2: Float64s, gate: float) -> float:
    """How much wider than the gate the kernel must be to be convex at these residuals; 1 where all are within it."""
    largest = float(chi2.max(initial=0.0))
    return 2 * largest / gate if largest > gate else 1.0


def _held(n: int, i: Int64s, j: Int64s, fixed: Bools) -> Bools:
    """The first node (n,) of each connected part that holds no fixed one."""
    part = connected(n, i, j)
    has_fixed = np.zeros(n, np.bool_)
    has_fixed[part[fixed]] = True
    return np.asarray((part == np.arange(n)) & ~has_fixed)


@njit(cache=True, nogil=True)
def connected(n, i, j):  # type: ignore[no-untyped-def]  # compiled; -> (n,) int64, the first node that each is connected to
    """Union by the lower index, with path halving."""
    parent = np.arange(n)
    for k in range(len(i)):
        a, b = i[k], j[k]
        while parent[a] != a:
            parent[a] = parent[parent[a]]
            a = parent[a]
        while parent[b] != b:
            parent[b] = parent[parent[b]]
            b = parent[b]
        if a < b:
            parent[b] = a
        else:
            parent[a] = b
    for a in range(n):  # a parent is never after its child
        parent[a] = parent[parent[a]]
    return parent
