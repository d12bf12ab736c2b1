# SPDX-License-Identifier: Apache-2.0
"""Search for constraints at the newest keyframes, as a Job: loop closures, and pairwise constraints nearby.

It runs beside the scans, as the constraint builder of Cartographer does (Hess et al., ICRA 2016, section V). The two
methods and their sources are in loop_closure.py and pairwise_constraints.py.
"""

from collections.abc import Sequence
from dataclasses import dataclass

from services.mapper.back_end.keyframe import Keyframe
from services.mapper.back_end.loop_closure import Constraint, LoopClosureConfig, SubmapCache, find_loop_closures
from services.mapper.back_end.pairwise_constraints import PairwiseConfig, find_pairwise_constraints
from services.mapper.back_end.pose_graph import Graph
from services.mapper.back_end.relative_covariance import relative_covariances
from services.mapper.front_end.registration import RegistrationConfig
from shared.types import Float64s


@dataclass(frozen=True, slots=True)
class FoundConstraints:
    """Result of one search."""

    closures: list[Constraint]
    pairwise: list[Constraint]


def search_constraints(
    graph: Graph,
    keyframes: Sequence[Keyframe],
    driven: Float64s,
    submaps: SubmapCache,
    closure_config: LoopClosureConfig,
    last_searched: int,
    registration: RegistrationConfig,
    pairwise_config: PairwiseConfig,
) -> FoundConstraints:
    """Returns the loop closures of the newest keyframe, and the pairwise constraints of all new keyframes.

    keyframes, driven: (n,) of the graph's nodes; driven is the path length up to each, m.
    last_searched: name of the newest node whose pairwise constraints were searched before.
    """
    covariances = relative_covariances(graph, int(graph.nodes[-1]))
    return FoundConstraints(
        find_loop_closures(graph, covariances, keyframes, driven, submaps, closure_config),
        list(find_pairwise_constraints(graph, covariances, keyframes, last_searched, registration, pairwise_config)),
    )
