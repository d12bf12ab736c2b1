# SPDX-License-Identifier: Apache-2.0
"""Keyframes matched one by one with others that saw the same walls, from wherever they were taken.

The front end matches with a submap that many keyframes drew, so its errors are theirs: what the first ones in a room
were turned by, all that follow are. Pairs err independently, and a few a keyframe hold a whole building straight (Lu &
Milios, "Globally consistent range scan alignment", 1997).
"""

from collections.abc import Iterator, Sequence

import numpy as np
from pydantic import Field

from services.mapper.keyframe import Keyframe
from services.mapper.loop_closure import LITTLE, Loop, in_own_frame
from services.mapper.pose_graph import Graph, Int64s, pose_of
from services.mapper.registration import LineRegistrar, Match, Prior, RegistrationConfig
from services.mapper.tracking_result import MIN_BEAMS
from shared.config import Section
from shared.geometry import Float64s, Pose2, wrapped


class TieConfig(Section):
    """Ties between keyframes."""

    partners: int = Field(4, ge=0, le=100, description="earlier keyframes, drawn by lot, that each is matched with")
    one_in: int = Field(2, ge=1, le=100, description="of as many keyframes, one is a partner: the graph stays sparse")
    reach: float = Field(4.0, ge=0.2, le=50, description="m to them at most")
    sure: float = Field(0.1, ge=0.01, le=1, description="m, standard deviation of where they are at most")
    gate: float = Field(0.2, ge=0.02, le=1, description="m, farthest match of two points, and farthest move")
    kernel: float = Field(0.03, ge=0.005, le=1, description="m, scale of the Geman-McClure kernel")
    share: float = Field(0.3, ge=0, le=1, description="of the beams that must agree")
    noise: float = Field(0.005, ge=0.001, le=1, description="m, standard deviation of a tie at least")
    noise_turn: float = Field(0.002, ge=0.0003, le=1, description="rad, of its turn")


SHARP = 0.03  # m between two points of one sweep
TURNED = 0.05  # rad that a match may turn a keyframe
WEAK = 0.1, 0.05  # m, rad, standard deviations of where the graph says it is: the beams are to tell


def ties_of(
    graph: Graph,
    covariances: Float64s,
    keyframes: Sequence[Keyframe],
    since: int,
    registration: RegistrationConfig,
    config: TieConfig,
) -> Iterator[Loop]:
    """Ties of the keyframes of all nodes after `since` to earlier ones, drawn by lot.

    covariances: (n, 3, 3) of the nodes as seen from the newest.  keyframes: the nodes'.
    """
    known = np.sqrt(np.maximum(covariances[:, 0, 0], covariances[:, 1, 1])) < config.sure
    partner = known & (graph.nodes % config.one_in == 0)
    settings = registration.model_copy(
        update={"gate": config.gate, "final_gate": config.gate, "kernel": config.kernel, "spacing": SHARP}
    )
    for row in range(int(np.searchsorted(graph.nodes, since, side="right")), len(graph.nodes)):
        away = np.hypot(*(graph.poses[:row, :2] - graph.poses[row, :2]).T)
        near: Int64s = np.flatnonzero(partner[:row] & (away < config.reach))
        lot = np.random.default_rng(int(graph.nodes[row]))
        for other in lot.choice(near, min(config.partners, len(near)), replace=False, shuffle=False).tolist():
            tie = tied(graph, keyframes, other, row, settings, config)
            if tie is not None:
                yield tie


def tied(
    graph: Graph, keyframes: Sequence[Keyframe], i: int, j: int, settings: RegistrationConfig, config: TieConfig
) -> Loop | None:
    """The tie between the nodes of two rows, if the beams of both saw enough of the same."""
    registrar = LineRegistrar(settings, 0.0)
    registrar.extend(*keyframes[i].surface())
    guess = pose_of(graph.poses[i]).inverse() @ pose_of(graph.poses[j])
    match: Match = registrar.register(*keyframes[j].surface(), guess, Prior(guess, *WEAK))
    found: Pose2 = match.map_from_base
    if match.agree.sum() < 2 * MIN_BEAMS or match.share < config.share:
        return None
    if found.distance(guess) > config.gate or abs(wrapped(found.yaw - guess.yaw)) > TURNED:
        return None
    information = in_own_frame(match.information, found.yaw, LITTLE, config.noise, config.noise_turn)
    return Loop(int(graph.nodes[i]), int(graph.nodes[j]), found, information)
