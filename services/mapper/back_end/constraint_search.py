# SPDX-License-Identifier: Apache-2.0
"""Search for constraints at the newest keyframes, as a Job: loop closures near and far, and pairwise constraints.

It runs beside the scans, as the constraint builder of Cartographer does (Hess et al., ICRA 2016, section V). The
methods and their sources are in loop_closure.py, far_closures.py and pairwise_constraints.py.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import inf

import numpy as np

from services.mapper.back_end.doubtful_closures import DoubtfulClosures
from services.mapper.back_end.far_closures import (
    SEARCH_INTERVAL_M,
    FarClosures,
    FarSearch,
    Hypothesis,
    find_far_closure,
)
from services.mapper.back_end.keyframe import Keyframe
from services.mapper.back_end.loop_closure import (
    Constraint,
    LoopClosureConfig,
    SubmapCache,
    find_loop_closures,
    visits_before,
)
from services.mapper.back_end.map_parts import joined_nodes
from services.mapper.back_end.pairwise_constraints import PairwiseConfig, find_pairwise_constraints
from services.mapper.back_end.pose_graph import Graph, PoseGraph
from services.mapper.back_end.relative_covariance import relative_covariances
from services.mapper.front_end.registration import RegistrationConfig
from shared.types import Bools, Float64s

N_AGAIN = 3  # earlier keyframes that one search looks at again
AGAIN_SPACING_M = 1.0  # driven between two of them
MIN_DRIFT_M = 0.75  # shown by a closure, half of the smallest window: before it, others may have been out of theirs


@dataclass(frozen=True, slots=True)
class SearchOrder:
    """What a search looks for, beside closures of the newest keyframe.

    last_searched: name of the newest node whose pairwise constraints were searched before.
    searches_far: whether to search far closures.  hypothesis: of these.
    again: names of earlier nodes whose closures are searched again.
    part: name of the first node of a part that only odometry joins to the rest; 0 where closures do.
    """

    last_searched: int
    searches_far: bool = False
    hypothesis: Hypothesis | None = None
    again: tuple[int, ...] = ()
    part: int = 0


@dataclass(frozen=True, slots=True)
class FoundConstraints:
    """Result of one search."""

    closures: list[Constraint]
    pairwise: list[Constraint]
    far: FarSearch


class ConstraintSearch:
    """What was searched, and what the next search looks for."""

    def __init__(self) -> None:
        self.searched_at = self.searched_far_at = 0.0  # m driven, at the last search
        self.last_searched = -1  # name of the newest node whose pairwise constraints were searched
        self.far_closures = FarClosures()
        self.doubtful_closures = DoubtfulClosures()
        self.again: list[int] = []  # names of nodes whose closures are to be searched again, the next one last
        self.drifted_from = inf  # m driven, where a drift began that the next optimum corrects

    def is_due(self, driven: Sequence[float], interval: float) -> bool:
        """Whether to search at the newest node.  driven: (n,) m, path length up to each.  interval: m."""
        return len(driven) > 1 and driven[-1] - self.searched_at >= interval

    def next_order(
        self, graph: PoseGraph, driven: Sequence[float], first_node: int, is_fixed: bool, is_joined: bool
    ) -> SearchOrder:
        """Returns the order of a search at the newest node.

        driven: (n,) m.  first_node: name of the first node of the session.  is_fixed: the map does not change.
        is_joined: closures join the session to the rest.
        """
        self.searched_at, newest = driven[-1], int(graph.nodes[-1])
        before, self.last_searched = max(self.last_searched, first_node - 1), newest
        if is_fixed:
            return SearchOrder(newest)
        again, self.again = self.again[-N_AGAIN:], self.again[:-N_AGAIN]
        existing = set(graph.nodes.tolist())
        hypothesis = self.far_closures.hypothesis(graph, driven)
        again = [node for node in again if node in existing]
        searches_far = hypothesis is not None or driven[-1] - self.searched_far_at >= SEARCH_INTERVAL_M
        if searches_far:
            self.searched_far_at = driven[-1]
        return SearchOrder(before, searches_far, hypothesis, tuple(again), 0 if is_joined else first_node)

    def search_again(
        self, graph: Graph, driven: Sequence[float], gaps: frozenset[tuple[int, int]], closed_at: float
    ) -> None:
        """Orders another search for closures of the nodes that were too far off for them until now, newest first.

        driven: (n,) m.  gaps: edges (i, j) of odometry alone.  closed_at: m driven, at the last closure.
        """
        self._add_again(graph, driven, ~joined_nodes(graph, gaps) | (np.array(driven) > closed_at))

    def on_closure(self, off: float, closed_at: float) -> None:
        """Notes a closure that moves its keyframe by `off`, m.  closed_at: m driven, at the closure before."""
        if off > MIN_DRIFT_M:
            self.drifted_from = min(self.drifted_from, closed_at)

    def search_drifted(self, graph: PoseGraph, driven: Sequence[float]) -> None:
        """Orders another search for closures of the nodes whose drift an optimum has corrected.  driven: (n,) m."""
        if self.drifted_from < inf:
            self._add_again(graph.snapshot(), driven, np.array(driven) > self.drifted_from)
        self.drifted_from = inf

    def _add_again(self, graph: Graph, driven: Sequence[float], chosen: Bools) -> None:
        """Adds one node for each metre of those chosen, (n,).  driven: (n,) m."""
        added, place = set(self.again), -1
        for node, path in zip(graph.nodes[chosen].tolist(), np.array(driven)[chosen].tolist()):
            if int(path / AGAIN_SPACING_M) != place:
                added.add(node)
                place = int(path / AGAIN_SPACING_M)
        self.again = sorted(added)


def search_constraints(
    graph: Graph,
    keyframes: Sequence[Keyframe],
    driven: Float64s,
    submaps: SubmapCache,
    closure_config: LoopClosureConfig,
    registration: RegistrationConfig,
    pairwise_config: PairwiseConfig,
    order: SearchOrder,
) -> FoundConstraints:
    """Returns the loop closures of the newest keyframe, and the pairwise constraints of all new keyframes.

    keyframes, driven: (n,) of the graph's nodes; driven is the path length up to each, m.
    """
    covariances = relative_covariances(graph, int(graph.nodes[-1]))
    visits = graph, covariances, keyframes, driven, submaps, closure_config
    again = [visits_before(graph, keyframes, driven, node) for node in order.again]
    searches_far = order.searches_far and closure_config.enabled
    pairwise = find_pairwise_constraints(
        graph, covariances, keyframes, order.last_searched, registration, pairwise_config
    )
    return FoundConstraints(
        [
            *find_loop_closures(*visits, order.part),
            *(closure for earlier in again for closure in find_loop_closures(*earlier, submaps, closure_config)),
        ],
        list(pairwise),
        find_far_closure(*visits, order.hypothesis) if searches_far else FarSearch(),
    )
