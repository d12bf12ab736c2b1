# SPDX-License-Identifier: Apache-2.0
"""Constraints between single keyframes that saw the same walls.

The front end matches with a submap of many keyframes, so its errors are correlated. All keyframes in a room share the
yaw error of the first ones. Errors of single pairs are independent. A few pairs per keyframe keep a whole building
straight. Source: Lu and Milios, "Globally consistent range scan alignment for environment mapping", 1997.
"""

from collections.abc import Iterator, Sequence
from typing import ClassVar

import numpy as np
from pydantic import Field

from services.mapper.back_end.keyframe import Keyframe
from services.mapper.back_end.loop_closure import WEAK_INFORMATION, Constraint, information_in_own_frame
from services.mapper.back_end.pose_graph import Graph, pose_of
from services.mapper.front_end.registration import LineRegistrar, Match, Prior, RegistrationConfig
from services.mapper.front_end.tracking_result import MIN_BEAMS
from shared.config import Section
from shared.geometry import Pose2, wrapped
from shared.types import Float64s, Int64s


class PairwiseConfig(Section):
    """Constraints between pairs of keyframes."""

    RENAMED: ClassVar[dict[str, str]] = {
        "partners": "n_partners", "one_in": "partner_stride", "reach": "max_distance", "sure": "max_sigma",
        "gate": "max_correspondence", "share": "min_inlier_ratio", "noise": "min_sigma", "noise_turn": "min_sigma_turn",
    }  # fmt: skip

    n_partners: int = Field(4, ge=0, le=100, description="earlier keyframes, chosen at random, to match each with")
    partner_stride: int = Field(
        2, ge=1, le=100, description="one of as many keyframes can be a partner, which keeps the graph sparse"
    )
    max_distance: float = Field(4.0, ge=0.2, le=50, description="m between two partners, at most")
    max_sigma: float = Field(0.25, ge=0.01, le=1, description="m, maximum standard deviation of a partner's pose")
    max_correspondence: float = Field(
        0.2, ge=0.02, le=1, description="m, maximum distance of two matched points, and of a correction"
    )
    kernel: float = Field(0.03, ge=0.005, le=1, description="m, scale of the Geman-McClure kernel")
    min_inlier_ratio: float = Field(0.3, ge=0, le=1, description="minimum share of the beams that agree")
    min_sigma: float = Field(0.005, ge=0.001, le=1, description="m, minimum standard deviation of a constraint")
    min_sigma_turn: float = Field(0.002, ge=0.0003, le=1, description="rad, the same for its turn")


POINT_SPACING_M = 0.03  # between two points of one sweep
MAX_TURN_RAD = 0.05  # correction of a keyframe's yaw
PRIOR_SIGMAS = 0.1, 0.05  # m, rad: a weak prior about the graph's pose, so that the beams decide


def find_pairwise_constraints(
    graph: Graph,
    covariances: Float64s,
    keyframes: Sequence[Keyframe],
    last_searched: int,
    registration: RegistrationConfig,
    config: PairwiseConfig,
) -> Iterator[Constraint]:
    """Yields constraints from the keyframes after node `last_searched` to earlier ones, chosen at random.

    covariances: (n, 3, 3) of the nodes relative to the newest.  keyframes: (n,) of the graph's nodes.
    The node's name is the seed of the choice, so a replay chooses the same.
    """
    certain = np.sqrt(np.maximum(covariances[:, 0, 0], covariances[:, 1, 1])) < config.max_sigma
    is_partner = certain & (graph.nodes % config.partner_stride == 0)
    gate = config.max_correspondence
    settings = registration.model_copy(
        update={"gate": gate, "final_gate": gate, "kernel": config.kernel, "spacing": POINT_SPACING_M}
    )
    for row in range(int(np.searchsorted(graph.nodes, last_searched, side="right")), len(graph.nodes)):
        distance = np.hypot(*(graph.poses[:row, :2] - graph.poses[row, :2]).T)
        near: Int64s = np.flatnonzero(is_partner[:row] & (distance < config.max_distance))
        rng = np.random.default_rng(int(graph.nodes[row]))
        for other in rng.choice(near, min(config.n_partners, len(near)), replace=False, shuffle=False).tolist():
            constraint = pairwise_constraint(graph, keyframes, other, row, settings, config)
            if constraint is not None:
                yield constraint


def pairwise_constraint(
    graph: Graph, keyframes: Sequence[Keyframe], i: int, j: int, settings: RegistrationConfig, config: PairwiseConfig
) -> Constraint | None:
    """Returns the constraint between the nodes of rows i and j; None if too few beams agree, or it moves them far."""
    registrar = LineRegistrar(settings, 0.0)
    registrar.add_points(*keyframes[i].surface())
    guess = pose_of(graph.poses[i]).inverse() @ pose_of(graph.poses[j])
    match: Match = registrar.register(*keyframes[j].surface(), guess, Prior(guess, *PRIOR_SIGMAS))
    i_from_j: Pose2 = match.map_from_base
    if match.inliers.sum() < 2 * MIN_BEAMS or match.inlier_ratio < config.min_inlier_ratio:
        return None
    turn = abs(wrapped(i_from_j.yaw - guess.yaw))
    if i_from_j.distance(guess) > config.max_correspondence or turn > MAX_TURN_RAD:
        return None
    information = information_in_own_frame(
        match.information, i_from_j.yaw, WEAK_INFORMATION, config.min_sigma, config.min_sigma_turn
    )
    return Constraint(int(graph.nodes[i]), int(graph.nodes[j]), i_from_j, information)
