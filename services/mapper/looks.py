# SPDX-License-Identifier: Apache-2.0
"""A look back, as a Job: whether the newest keyframe closes a loop, and what the new ones share with earlier ones."""

from collections.abc import Sequence
from dataclasses import dataclass

from services.mapper.keyframe import Keyframe
from services.mapper.loop_closure import Blocks, Loop, LoopConfig, loops_of
from services.mapper.pose_graph import Graph
from services.mapper.registration import RegistrationConfig
from services.mapper.ties import TieConfig, ties_of
from services.mapper.uncertainty import uncertainty_from
from shared.geometry import Float64s


@dataclass(frozen=True, slots=True)
class Looked:
    """What one look found."""

    loops: list[Loop]
    ties: list[Loop]


def looked(
    graph: Graph,
    keyframes: Sequence[Keyframe],
    driven: Float64s,
    blocks: Blocks,
    loops: LoopConfig,
    tied_to: int,
    registration: RegistrationConfig,
    ties: TieConfig,
) -> Looked:
    """Looks from the newest keyframe. keyframes, and driven, (n,) m up to each, go with the graph's nodes.

    tied_to: name of the last node whose ties are known.
    """
    covariances = uncertainty_from(graph, int(graph.nodes[-1]))
    return Looked(
        loops_of(graph, covariances, keyframes, driven, blocks, loops),
        list(ties_of(graph, covariances, keyframes, tied_to, registration, ties)),
    )
