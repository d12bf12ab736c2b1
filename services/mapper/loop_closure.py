# SPDX-License-Identifier: Apache-2.0
"""Where the robot has been before: a keyframe is matched with what was drawn there on an earlier pass.

Candidates come from the pose graph's own uncertainty; what is found counts only where the beams agree, contradict
nothing, and could lie nowhere else. Whether a closure agrees with all others is for the pose graph to say.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import sqrt

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from services.mapper.branch_and_bound import BranchAndBoundConfig, Pyramid, drawn, search
from services.mapper.keyframe import Keyframe
from services.mapper.occupancy import OccupancyConfig
from services.mapper.pose_graph import Graph, pose_of, turned
from services.mapper.registration import Match, Prior, RegistrationConfig
from services.mapper.submap import Submap
from services.mapper.tracking_result import MIN_BEAMS
from shared.config import Section
from shared.geometry import Float64s, Pose2, wrapped

Int64s = NDArray[np.int64]


LITTLE = 1e-2 * np.eye(3)
"""Information of a pose that nothing is known about: 10 m, 10 rad."""


class LoopConfig(Section):
    """Loop closure."""

    every: float = Field(0.5, ge=0.05, le=20, description="m driven between two looks for closures")
    apart: float = Field(12.0, ge=1, le=1000, description="m of driving that make a place an earlier visit's")
    view: float = Field(3.0, ge=0.2, le=50, description="m between two places from where the same is seen")
    passes: int = Field(2, ge=1, le=20, description="earlier visits that a look tries")
    around: int = Field(10, ge=1, le=100, description="keyframes before and after a place that are matched with it")
    sigmas: float = Field(2.0, ge=0.5, le=6, description="standard deviations around the guess that are searched")
    least: float = Field(1.5, ge=0.1, le=30, description="m around the guess that are searched at least")
    farthest: float = Field(3.0, ge=0.3, le=30, description="m around the guess that are searched at most")
    share: float = Field(0.65, ge=0, le=1, description="of the beams that must agree")
    balance: float = Field(0.55, ge=0, le=1, description="agreeing beams less contradicting ones, as a share of all")
    unlike: float = Field(0.9, ge=0, le=1, description="the second best place may have this share of its balance")
    score: float = Field(0.3, ge=0, le=1, description="of a pose of the window, from which it is tried")
    noise: float = Field(0.04, ge=0.001, le=1, description="m, standard deviation of a closure at least")
    noise_turn: float = Field(0.01, ge=0.0005, le=1, description="rad, of its turn")
    search: BranchAndBoundConfig = BranchAndBoundConfig()


@dataclass(frozen=True, slots=True)
class Loop:
    """A closure: node j seen from node i, with information (3, 3) in the frame of j."""

    i: int
    j: int
    i_from_j: Pose2
    information: Float64s


class Blocks:
    """Submaps of the keyframes around a place, in `local`, made when first asked for and kept while they are used.

    Only Jobs touch it, and Jobs run one by one in the order in which they were ordered, live as in a replay: so what a
    block holds, made before or after a keyframe in it was given up, is the same there.
    """

    MOST_BYTES = 60_000_000  # kept: some 60 blocks of a room's range, 8 of a hall's

    def __init__(
        self, registration: RegistrationConfig, occupancy: OccupancyConfig, range_max: float, config: LoopConfig
    ) -> None:
        self._settings, self._config = (registration, occupancy, range_max), config
        self._made: dict[int, tuple[Submap, Pyramid]] = {}

    def about(self, nodes: Int64s, keyframes: Sequence[Keyframe], row: int) -> tuple[Submap, Pyramid]:
        """The block, and its pictures, that holds a node in its middle third. nodes: (n,) names, of the keyframes."""
        around = self._config.around
        block = int(nodes[row]) // around
        begin, end = (int(np.searchsorted(nodes, (block + k) * around)) for k in (-1, 2))
        whole = end < len(nodes)
        found = self._made.pop(block, None)
        if found is None:
            submap = Submap(*self._settings)
            for keyframe in keyframes[begin:end]:
                submap.take(keyframe, keyframe.local_from_base)
            submap.forget()
            submap.grid.trim()
            points = submap.registrar.map.points[: submap.registrar.map.n, :2]
            points = points[np.isfinite(points[:, 0])]
            found = submap, drawn(np.ascontiguousarray(points), self._config.search)
        if whole:
            self._made[block] = found
            while len(self._made) > 1 and self.n_bytes > self.MOST_BYTES:
                del self._made[next(iter(self._made))]
        return found

    @property
    def n_bytes(self) -> int:
        """What is kept takes so much memory."""
        return sum(submap.n_bytes + pyramid.levels.nbytes for submap, pyramid in self._made.values())


def loops_of(
    graph: Graph,
    covariances: Float64s,
    keyframes: Sequence[Keyframe],
    driven: Float64s,
    blocks: Blocks,
    config: LoopConfig,
) -> list[Loop]:
    """What closes at the newest keyframe. keyframes, and driven, (n,) m up to each, go with the graph's nodes.

    covariances: (n, 3, 3) of the nodes as seen from the newest.
    """
    last = len(graph.nodes) - 1
    found = []
    for row in earlier_visits(graph.poses, covariances, driven, config):
        loop = closed(graph, keyframes, row, last, covariances[row], blocks, config)
        if loop is not None:
            found.append(loop)
    return found


def earlier_visits(poses: Float64s, covariances: Float64s, driven: Float64s, config: LoopConfig) -> list[int]:
    """Rows of the nodes, one a visit, that the last node may see the place of; the surest and nearest first."""
    away = np.hypot(*(poses[:, :2] - poses[-1, :2]).T)
    sigma = np.sqrt(np.maximum(covariances[:, 0, 0], covariances[:, 1, 1]))
    reach = np.minimum(config.sigmas * sigma, config.farthest)
    near: Int64s = np.flatnonzero((driven[-1] - driven > config.apart) & (away < config.view + reach))
    if not len(near):
        return []
    visits = np.split(near, np.flatnonzero(np.diff(driven[near]) > config.view) + 1)
    nearest = [int(visit[np.argmin(away[visit])]) for visit in visits]
    nearest.sort(key=lambda row: (config.sigmas * sigma[row] + away[row], row))
    return nearest[: config.passes]


def closed(
    graph: Graph,
    keyframes: Sequence[Keyframe],
    row: int,
    last: int,
    covariance: Float64s,
    blocks: Blocks,
    config: LoopConfig,
) -> Loop | None:
    """The closure between the nodes of two rows, if the beams of the last one find its place by the other."""
    if len(keyframes[last].points) < MIN_BEAMS:
        return None
    submap, pyramid = blocks.about(graph.nodes, keyframes, row)
    keyframe, place = keyframes[last], keyframes[row].local_from_base
    guess = place @ (pose_of(graph.poses[row]).inverse() @ pose_of(graph.poses[last]))
    # a wrong closure makes the graph too sure: only who looks farther finds those that outvote it
    sigma = max(sqrt(max(covariance[0, 0], covariance[1, 1])), config.least / config.sigmas)
    sigma_turn = sqrt(covariance[2, 2])
    prior = Prior(guess, sigma, max(sigma_turn, 0.03))
    reach = min(config.sigmas * sigma, config.farthest)
    turn = min(max(config.sigmas * sigma_turn, 0.1), 0.5)
    points, normals = keyframe.surface()
    candidates = search(points, pyramid, guess, reach, turn, config.score, config.search)
    best: tuple[float, Match] | None = None
    tried = []
    for start in (guess, *(candidate.pose for candidate in candidates)):
        match = submap.registrar.register(points, normals, start, prior)
        balance = submap.balance(match, keyframe.origin, points)
        tried.append((balance, match.map_from_base))
        if best is None or balance > best[0]:
            best = balance, match
    if best is None or best[1].share < config.share or best[0] < config.balance:
        return None
    balance, match = best
    found = match.map_from_base
    for second, pose in tried:
        elsewhere = pose.distance(found) > 0.3 or abs(wrapped(pose.yaw - found.yaw)) > 0.2
        if elsewhere and second > config.unlike * balance:
            return None
    information = in_own_frame(match.information, found.yaw, LITTLE, config.noise, config.noise_turn)
    return Loop(int(graph.nodes[row]), int(graph.nodes[last]), place.inverse() @ found, information)


def in_own_frame(information: Float64s, yaw: float, known: Float64s, noise: float, noise_turn: float) -> Float64s:
    """Information (3, 3) of a pose in its own axes from that in its map's, `known` besides, and so much noise at least.

    known: (3, 3) in its own axes.  noise, noise_turn: m and rad, standard deviations.
    """
    own = turned(information, -yaw) + known
    covariance = np.linalg.inv(own) + np.diag((noise**2, noise**2, noise_turn**2))
    out = np.linalg.inv(covariance)
    return np.asarray((out + out.T) / 2)
