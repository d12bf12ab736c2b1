# SPDX-License-Identifier: Apache-2.0
"""Robust optimization of a pose graph: the poses that fit the constraints best, and the closures that are rejected."""

from typing import ClassVar

import numpy as np
from numba import njit
from pydantic import Field

from services.mapper.back_end.pose_graph import Graph, OptimizationResult, edge_chi2
from services.mapper.back_end.solver.levenberg_marquardt import levenberg_marquardt
from shared.config import Section
from shared.geometry import Pose2
from shared.types import Bools, Float64s, Int64s

NEGLIGIBLE_CHI2 = 1e-9  # of a whole graph: only rounding errors are left
KERNEL_SHRINK = 4  # factor of the squared kernel width from round to round
N_ROUGH_STEPS = 3  # in a round with a narrower kernel that is not the last one
MAX_FINAL_ROUNDS = 5  # in which closures may still be accepted or rejected


class PoseGraphConfig(Section):
    """Optimization of the pose graph."""

    RENAMED: ClassVar[dict[str, str]] = {"gate": "max_closure_chi2", "iterations": "max_iterations"}

    max_closure_chi2: float = Field(
        16.0, ge=1, le=10_000, description="squared Mahalanobis distance (3 degrees of freedom) of an accepted closure"
    )
    max_iterations: int = Field(20, ge=1, le=1000, description="Levenberg-Marquardt steps in each round, at most")


def optimize(graph: Graph, config: PoseGraphConfig) -> OptimizationResult:
    """Returns the poses that fit all edges best, by Levenberg-Marquardt, and rejects wrong closures.

    Closures have a Geman-McClure kernel of the gate's width. The first closure after a long path may lie outside of it,
    as a wrong one does. Then the kernel begins with the largest residual's width, and is narrowed step by step:
    graduated non-convexity (Yang et al., RA-L 2020, GNC-GM). The first, almost quadratic round converges, as a narrower
    kernel rejects what is not yet at its optimum. If that round satisfies all closures, the rest is skipped. If not,
    closures that were rejected before are tried again.
    No rejection divides the graph: where one closure alone joins two sections, nothing can contradict it.
    A fixed node keeps its bits; in a component without one, the first node is fixed.
    """
    loops = graph.loop
    solver = _Solver(graph, config)
    poses, on = graph.poses, graph.on | ~loops
    chi2 = edge_chi2(graph, poses)
    width = _kernel_scale(chi2[loops & on], config.max_closure_chi2)
    narrows = False
    while width > 1:
        poses = solver.solve(poses, on, config.max_closure_chi2 * width, rough=narrows)
        chi2 = edge_chi2(graph, poses)
        needed = _kernel_scale(chi2[loops & on], config.max_closure_chi2)
        if needed > 1 and not on.all():
            on = np.ones_like(on)
            width, narrows = _kernel_scale(chi2[loops], config.max_closure_chi2), False
        else:
            width, narrows = min(width / KERNEL_SHRINK, needed), True
    for _ in range(MAX_FINAL_ROUNDS):
        poses = solver.solve(poses, on, config.max_closure_chi2)
        chi2 = edge_chi2(graph, poses)
        before, on = on, solver.with_bridges(~loops | (chi2 <= config.max_closure_chi2), chi2)
        if (on == before).all():
            break
    start = edge_chi2(graph, graph.poses)
    weights = np.where(loops, on * (config.max_closure_chi2 / (config.max_closure_chi2 + chi2)) ** 2, 1.0)
    moved = Pose2(*poses[-1].tolist()) @ Pose2(*graph.poses[-1].tolist()).inverse() if len(poses) else Pose2()
    return OptimizationResult(
        nodes=graph.nodes, poses=poses, edges=graph.edges, weights=weights, chi2=chi2,
        before=float(start[on].sum()), after=float(chi2[on].sum()), iterations=solver.iterations, moved=moved,
    )  # fmt: skip


class _Solver:
    """Levenberg-Marquardt over a selection of the edges of a graph."""

    def __init__(self, graph: Graph, config: PoseGraphConfig) -> None:
        self.graph, self.config = graph, config
        self.i, self.j = graph.rows()
        self.useful = ~(graph.fixed[self.i] & graph.fixed[self.j])
        self.iterations = 0

    def solve(self, poses: Float64s, on: Bools, gate: float, rough: bool = False) -> Float64s:
        """Returns the poses (n, 3) at the optimum of the edges that are on.  poses: the start.  gate: chi2."""
        used = on & self.useful
        if not used.any() or float(edge_chi2(self.graph, poses)[used].sum()) < NEGLIGIBLE_CHI2:
            return poses
        i, j = self.i[used], self.j[used]
        is_fixed = self.graph.fixed | _anchors(len(poses), i, j, self.graph.fixed)
        optimum, steps = levenberg_marquardt(
            poses.copy(), is_fixed, i, j, self.graph.relative[used], self.graph.information[used],
            self.graph.loop[used], gate, N_ROUGH_STEPS if rough else self.config.max_iterations,
            1e-5 if rough else 1e-6,
        )  # fmt: skip
        self.iterations += steps
        return np.asarray(optimum)

    def with_bridges(self, on: Bools, chi2: Float64s) -> Bools:
        """Returns the edges that are on, and of the others those that join what is apart, the smallest chi2 first."""
        component = connected_components(len(self.graph.poses), self.i[on], self.j[on])
        on, rejected = on.copy(), np.flatnonzero(~on)
        for edge in rejected[np.argsort(chi2[rejected], kind="stable")].tolist():
            a, b = component[self.i[edge]], component[self.j[edge]]
            if a != b:
                component[component == max(a, b)] = min(a, b)
                on[edge] = True
        return on


def _kernel_scale(chi2: Float64s, gate: float) -> float:
    """Returns the factor of the gate at which the kernel is convex for all residuals; 1 where all are within it."""
    largest = float(chi2.max(initial=0.0))
    return 2 * largest / gate if largest > gate else 1.0


def _anchors(n: int, i: Int64s, j: Int64s, fixed: Bools) -> Bools:
    """Returns (n,) bool: the first node of each connected component without a fixed one."""
    component = connected_components(n, i, j)
    has_fixed = np.zeros(n, np.bool_)
    has_fixed[component[fixed]] = True
    return np.asarray((component == np.arange(n)) & ~has_fixed)


@njit(cache=True, nogil=True)
def connected_components(n, i, j):  # type: ignore[no-untyped-def]  # compiled; -> (n,) int64, the first node of each node's component
    """Union-find by the lower index, with path halving (Tarjan and van Leeuwen 1984).

    n: number of nodes.  i, j: (m,) int64, rows of the nodes that each edge joins.
    """
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
