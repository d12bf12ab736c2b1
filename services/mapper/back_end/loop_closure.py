# SPDX-License-Identifier: Apache-2.0
"""Loop closure: matches the newest keyframe with submaps of earlier visits, and rejects doubtful matches.

Candidates come from the covariances of the pose graph (Olson, "Robust and efficient robotic mapping", 2008).
Branch and bound gives start poses (Hess et al., ICRA 2016, section V-B), and registration refines them. A closure is
rejected where too few beams agree, where beams contradict the submap, or where another pose fits nearly as well.
The pose graph's robust kernel rejects closures that contradict the others.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from math import pi, sqrt
from typing import ClassVar, Self

import numpy as np
from pydantic import Field

from services.mapper.back_end.branch_and_bound import BranchAndBoundConfig, Pyramid, build_pyramid, search
from services.mapper.back_end.keyframe import Keyframe
from services.mapper.back_end.pose_graph import Graph, PoseGraph, pose_of, rotate_matrix
from services.mapper.back_end.relative_covariance import relative_covariances
from services.mapper.front_end.registration import Match, Prior, RegistrationConfig
from services.mapper.front_end.submap import Submap
from services.mapper.front_end.tracking_result import MIN_BEAMS
from services.mapper.grid.occupancy import OccupancyConfig
from shared.config import Section
from shared.geometry import Pose2, wrapped
from shared.types import Bools, Float64s, Int64s

WEAK_INFORMATION = 1e-2 * np.eye(3)
"""Information of an unknown pose: standard deviations of 10 m and 10 rad."""
GRAPH_SHARE = 1.5  # memory of the graph that grows, by doubling, as a share of its snapshot's
MIN_SIGMA_TURN_RAD, MIN_TURN_RAD, MAX_TURN_RAD = 0.03, 0.2, 0.5  # of a window about a guess
MIN_PARTIAL_RATIO = 0.2  # beams that agree with a partial closure, as a share of all
MAX_PARTIAL_CONTRADICTION = 0.2  # beams that contradict it, as a share of those that agree
MAX_PARTIAL_RIVAL_RATIO = 0.5  # margin of another pose, as a share of the best one's
PARTIAL_SIGMAS = 0.1, 0.02  # m, rad: minimum standard deviations of a partial closure
CLUTTER_RATIO = 0.02  # share of the beams that may contradict any pose
MIN_RIVAL_M, MIN_RIVAL_RAD = 0.3, 0.2  # distance from the best pose from which another pose is a rival


class LoopClosureConfig(Section):
    """Loop closure."""

    RENAMED: ClassVar[dict[str, str]] = {
        "every": "search_interval", "apart": "min_path_between", "view": "view_radius", "passes": "max_visits",
        "around": "block_size", "sigmas": "window_sigmas", "least": "min_window", "farthest": "max_window",
        "share": "min_inlier_ratio", "balance": "min_inlier_margin", "unlike": "max_rival_ratio", "score": "min_score",
        "noise": "min_sigma", "noise_turn": "min_sigma_turn",
    }  # fmt: skip

    enabled: bool = Field(
        True, description="search earlier visits; without it a map's errors grow, and on a saved map the pose gets poor"
    )
    search_interval: float = Field(0.5, ge=0.05, le=20, description="m driven between two searches for closures")
    min_path_between: float = Field(12.0, ge=1, le=1000, description="m, path length that separates two visits")
    view_radius: float = Field(3.0, ge=0.2, le=50, description="m between two places from where the same is seen")
    max_visits: int = Field(2, ge=1, le=20, description="earlier visits that a search tries")
    block_size: int = Field(10, ge=1, le=100, description="keyframes before and after a place that are matched with it")
    window_sigmas: float = Field(3.0, ge=0.5, le=6, description="standard deviations about the guess that are searched")
    min_window: float = Field(1.5, ge=0.1, le=30, description="m about the guess that are searched, at least")
    max_window: float = Field(3.0, ge=0.3, le=30, description="m about the guess that are searched, at most")
    max_drift_ratio: float = Field(
        0.1, ge=0, le=0.5,
        description="m of drift per m of path for which places beyond that are searched too; 0 searches none",
    )  # fmt: skip
    min_inlier_ratio: float = Field(0.65, ge=0, le=1, description="minimum share of the beams that agree")
    min_inlier_margin: float = Field(
        0.55, ge=0, le=1, description="minimum of agreeing beams less contradicting ones, as a share of all"
    )
    max_rival_ratio: float = Field(
        0.9, ge=0, le=1, description="maximum margin of another pose, as a share of the best pose's"
    )
    min_score: float = Field(0.3, ge=0, le=1, description="minimum score of a start pose from branch and bound")
    min_sigma: float = Field(0.04, ge=0.001, le=1, description="m, minimum standard deviation of a closure")
    min_sigma_turn: float = Field(0.01, ge=0.0005, le=1, description="rad, the same for its turn")
    search: BranchAndBoundConfig = BranchAndBoundConfig()


@dataclass(frozen=True, slots=True)
class Constraint:
    """The pose of node j in the frame of node i, with information (3, 3) of (x, y, yaw) in the frame of j.

    is_partial: few beams agree with it, so it counts once others agree (see doubtful_closures.py).
    """

    i: int
    j: int
    i_from_j: Pose2
    information: Float64s
    is_partial: bool = False


def existing(graph: PoseGraph, constraints: Sequence[Constraint]) -> list[Constraint]:
    """Returns the constraints whose nodes were not removed since the search."""
    nodes = set(graph.nodes.tolist())
    return [constraint for constraint in constraints if constraint.i in nodes and constraint.j in nodes]


class SubmapCache:
    """Submaps of the keyframes around a place, in `local`, with their pyramids; built on demand.

    Only jobs use it, and jobs run one by one in the order in which they were ordered, live as in a replay. So a submap
    has the same content in both, whether it was built before or after one of its keyframes was removed.
    range_max: m, of the laser.
    """

    MAX_BYTES = 30_000_000  # with the graph and its keyframes, so that memory stays as these become more
    MIN_BYTES = 8_000_000  # about 8 submaps in a room, 1 in a hall

    def __init__(
        self, registration: RegistrationConfig, occupancy: OccupancyConfig, range_max: float, config: LoopClosureConfig
    ) -> None:
        self._settings, self._config = (registration, occupancy, range_max), config
        self._cached: dict[int, tuple[Submap, Pyramid]] = {}

    def around(self, graph: Graph, keyframes: Sequence[Keyframe], row: int) -> tuple[Submap, Pyramid]:
        """Returns the submap, and its pyramid, that holds the node of a row in its middle third.

        keyframes: (n,) of the graph's nodes.
        """
        nodes, block_size = graph.nodes, self._config.block_size
        block = int(nodes[row]) // block_size
        begin, end = (int(np.searchsorted(nodes, (block + k) * block_size)) for k in (-1, 2))
        is_complete = end < len(nodes)
        entry = self._cached.pop(block, None)
        if entry is None:
            submap = Submap(*self._settings)
            for keyframe in keyframes[begin:end]:
                submap.add_keyframe(keyframe, keyframe.local_from_base)
            submap.remove_crossed_points()
            submap.grid.make_read_only()
            points = submap.registrar.map.points[: submap.registrar.map.n, :2]
            points = points[np.isfinite(points[:, 0])]
            entry = submap, build_pyramid(np.ascontiguousarray(points), self._config.search)
        if is_complete:
            self._cached[block] = entry
            n_bytes = GRAPH_SHARE * sum(getattr(graph, field.name).nbytes for field in fields(graph))
            n_bytes += sum(keyframe.n_bytes for keyframe in keyframes)
            limit = max(self.MIN_BYTES, self.MAX_BYTES - n_bytes)
            while len(self._cached) > 1 and self.n_bytes > limit:
                del self._cached[next(iter(self._cached))]
        return entry

    @property
    def n_bytes(self) -> int:
        """Memory of the cached submaps, bytes."""
        return sum(submap.n_bytes + pyramid.levels.nbytes for submap, pyramid in self._cached.values())


def find_loop_closures(
    graph: Graph,
    covariances: Float64s,
    keyframes: Sequence[Keyframe],
    driven: Float64s,
    submaps: SubmapCache,
    config: LoopClosureConfig,
    part: int = 0,
) -> list[Constraint]:
    """Returns the loop closures of the newest keyframe, one for each earlier visit at most.

    part: name of the first node of a part that only odometry joins to the nodes before. Of these, the ones that are
    beyond the widest window are left out.
    covariances: (n, 3, 3) of the nodes relative to the newest.
    keyframes, driven: (n,) of the graph's nodes; driven is the path length up to each, m.
    """
    last = len(graph.nodes) - 1
    closures = []
    is_left_out = (graph.nodes < part) & is_beyond_window(covariances, driven, config)
    for row in earlier_visits(graph.poses, covariances, driven, config, is_left_out) if config.enabled else ():
        closure = match_loop_closure(graph, keyframes, row, last, covariances[row], submaps, config)
        if closure is not None:
            closures.append(closure)
    return closures


def visits_before(
    graph: Graph, keyframes: Sequence[Keyframe], driven: Float64s, node: int
) -> tuple[Graph, Float64s, Sequence[Keyframe], Float64s]:
    """Returns the first four arguments of `find_loop_closures` for an earlier node, as the present graph has them.

    keyframes, driven: (n,) of the graph's nodes.
    """
    n = int(np.searchsorted(graph.nodes, node)) + 1
    covariances = relative_covariances(graph, node)[:n]
    return graph.subgraph_before(node + 1), covariances, keyframes[:n], driven[:n]


def is_beyond_window(covariances: Float64s, driven: Float64s, config: LoopClosureConfig) -> Bools:
    """Returns (n,) whether a node is of an earlier visit, and the widest window does not cover its drift.

    far_closures.py searches them. Nodes that no edge joins to the last one are not among them.
    covariances: (n, 3, 3) relative to the last node.  driven: (n,) m.
    """
    reach = config.window_sigmas * np.sqrt(np.maximum(covariances[:, 0, 0], covariances[:, 1, 1]))
    is_earlier = driven[-1] - driven > config.min_path_between
    return np.asarray(is_earlier & (reach > config.max_window) & np.isfinite(reach) & (config.max_drift_ratio > 0))


def earlier_visits(
    poses: Float64s, covariances: Float64s, driven: Float64s, config: LoopClosureConfig, is_left_out: Bools
) -> list[int]:
    """Returns rows of the nodes, one for each visit, that the last node may be near; most certain and nearest first.

    poses: (n, 3) m, m, rad in `map`.  covariances: (n, 3, 3) relative to the last node.  driven: (n,) m.
    is_left_out: (n,).
    """
    distance = np.hypot(*(poses[:, :2] - poses[-1, :2]).T)
    sigma = np.sqrt(np.maximum(covariances[:, 0, 0], covariances[:, 1, 1]))
    reach = np.minimum(config.window_sigmas * sigma, config.max_window)
    is_earlier = (driven[-1] - driven > config.min_path_between) & ~is_left_out
    near: Int64s = np.flatnonzero(is_earlier & (distance < config.view_radius + reach))
    if not len(near):
        return []
    visits = np.split(near, np.flatnonzero(np.diff(driven[near]) > config.view_radius) + 1)
    nearest = [int(visit[np.argmin(distance[visit])]) for visit in visits]
    nearest.sort(key=lambda row: (config.window_sigmas * sigma[row] + distance[row], row))
    return nearest[: config.max_visits]


@dataclass(frozen=True, slots=True)
class SearchWindow:
    """The poses of a keyframe that a match tries.

    map_from_base: a guess, with standard deviations sigma (m) and sigma_turn (rad).
    reach, turn: half of the window's width about it in x and y, m, and in yaw, rad.
    min_score, max_steps: of branch and bound.  is_even: no pose in the window is more likely than another.
    """

    map_from_base: Pose2
    sigma: float
    sigma_turn: float
    reach: float
    turn: float
    min_score: float
    max_steps: int
    is_even: bool = False

    @classmethod
    def of(
        cls, map_from_base: Pose2, covariance: Float64s, n_sigmas: float, max_reach: float, config: LoopClosureConfig
    ) -> Self:
        """Returns the window of so many standard deviations of a covariance (3, 3).  max_reach: m."""
        # a wrong closure makes the graph too certain; a wide window still finds the closures that outvote it
        sigma = min(sqrt(max(covariance[0, 0], covariance[1, 1])), max_reach)  # infinite without any edge
        sigma = max(sigma, config.min_window / n_sigmas)
        sigma_turn = min(sqrt(covariance[2, 2]), pi)
        return cls(
            map_from_base,
            sigma,
            max(sigma_turn, MIN_SIGMA_TURN_RAD),
            min(n_sigmas * sigma, max_reach),
            min(max(n_sigmas * sigma_turn, MIN_TURN_RAD), MAX_TURN_RAD),
            config.min_score,
            config.search.max_windows,
        )


@dataclass(frozen=True, slots=True)
class PlaceMatch:
    """The best pose of keyframe `last` in the submap around keyframe `row`, and the other poses that were tried.

    margin: agreeing beams less contradicting ones, as a share of all.  score: the best one of branch and bound.
    rivals: map_from_base by the pose of keyframe `row`, and margin, of the poses that differ from the best one.
    """

    match: Match
    margin: float
    score: float
    row_from_last: Pose2
    rivals: list[tuple[Pose2, float]]

    def is_accepted(self, config: LoopClosureConfig, share: float = 1.0) -> bool:
        """Whether enough beams agree, and no other pose fits nearly as well.  share: of the beams that must agree."""
        ratio, margin = share * config.min_inlier_ratio, share * config.min_inlier_margin
        fits = self.match.inlier_ratio >= ratio and self.margin >= margin
        return fits and all(other <= config.max_rival_ratio * self.margin for _, other in self.rivals)

    @property
    def is_partial(self) -> bool:
        """Whether a part of the beams agrees, hardly any contradict, and no other pose fits half as well."""
        ratio = self.match.inlier_ratio
        fits = ratio >= MIN_PARTIAL_RATIO and ratio - self.margin <= MAX_PARTIAL_CONTRADICTION * ratio
        return fits and all(other <= MAX_PARTIAL_RIVAL_RATIO * self.margin for _, other in self.rivals)

    def constraint(
        self, graph: Graph, row: int, last: int, config: LoopClosureConfig, is_partial: bool = False
    ) -> Constraint:
        """Returns the closure between two rows of the graph."""
        sigmas = PARTIAL_SIGMAS if is_partial else (config.min_sigma, config.min_sigma_turn)
        information = information_in_own_frame(
            self.match.information, self.match.map_from_base.yaw, WEAK_INFORMATION, *sigmas
        )
        return Constraint(int(graph.nodes[row]), int(graph.nodes[last]), self.row_from_last, information, is_partial)


def match_loop_closure(
    graph: Graph,
    keyframes: Sequence[Keyframe],
    row: int,
    last: int,
    covariance: Float64s,
    submaps: SubmapCache,
    config: LoopClosureConfig,
) -> Constraint | None:
    """Matches keyframe `last` with the submap around keyframe `row`; None if the match is rejected.

    covariance: (3, 3) of node `row` relative to node `last`.
    """
    window = SearchWindow.of(pose_of(graph.poses[last]), covariance, config.window_sigmas, config.max_window, config)
    found = match_place(graph, keyframes, row, last, window, submaps, config)
    if found is None or not ((is_accepted := found.is_accepted(config)) or found.is_partial):
        return None
    return found.constraint(graph, row, last, config, not is_accepted)


def match_place(
    graph: Graph,
    keyframes: Sequence[Keyframe],
    row: int,
    last: int,
    window: SearchWindow,
    submaps: SubmapCache,
    config: LoopClosureConfig,
) -> PlaceMatch | None:
    """Returns the best pose of keyframe `last` in the submap around keyframe `row`.

    None if it has too few beams, or so many poses fit that the search does not end in time.
    """
    if len(keyframes[last].normals) < MIN_BEAMS:
        return None
    submap, pyramid = submaps.around(graph, keyframes, row)
    keyframe, local_from_row = keyframes[last], keyframes[row].local_from_base
    map_from_row = pose_of(graph.poses[row])
    guess = local_from_row @ (map_from_row.inverse() @ window.map_from_base)
    points, normals = keyframe.surface()
    settings = config.search.model_copy(update={"max_windows": window.max_steps})
    candidates, n_steps = search(points, pyramid, guess, window.reach, window.turn, window.min_score, settings)
    if n_steps > window.max_steps:
        return None
    tried = []
    for start in (guess, *(candidate.pose for candidate in candidates)):
        prior = Prior(start if window.is_even else guess, window.sigma, window.sigma_turn)
        match = submap.registrar.register(points, normals, start, prior)
        tried.append((submap.inlier_margin(match, keyframe.origin, points), match))
    margin, match = max(tried, key=lambda one: one[0])
    pose = match.map_from_base
    row_from_local = local_from_row.inverse()
    rivals = [
        (map_from_row @ row_from_local @ other.map_from_base, other_margin)
        for other_margin, other in tried
        if is_other_pose(pose, other.map_from_base, MIN_RIVAL_M, MIN_RIVAL_RAD)
    ]
    score = max((candidate.score for candidate in candidates), default=0.0)
    return PlaceMatch(match, margin, score, row_from_local @ pose, rivals)


def evidence_ratio(best: float, rival: float) -> float:
    """Returns the evidence against a pose as a share of that against another pose, by their margins, -1..1.

    A pose that fits well where the other fits badly has nearly 0; two that fit alike have 1 or more. It is derived from
    the ratio test of Lowe, IJCV 2004, section 7.1.
    """
    return (1 - best + CLUTTER_RATIO) / max(1 - rival, CLUTTER_RATIO)


def is_other_pose(a: Pose2, b: Pose2, distance: float, turn: float) -> bool:
    """Whether two poses differ by more than a distance, m, or a turn, rad."""
    return a.distance(b) > distance or abs(wrapped(a.yaw - b.yaw)) > turn


def information_in_own_frame(
    information: Float64s, yaw: float, prior_information: Float64s, min_sigma: float, min_sigma_turn: float
) -> Float64s:
    """Returns the information (3, 3) of a pose in its own axes, limited by a minimum noise.

    information: (3, 3) in the axes of the map, in which the pose has this yaw, rad.
    prior_information: (3, 3), in the pose's own axes.
    min_sigma, min_sigma_turn: standard deviations that are added, m and rad.
    """
    own = rotate_matrix(information, -yaw) + prior_information
    covariance = np.linalg.inv(own) + np.diag((min_sigma**2, min_sigma**2, min_sigma_turn**2))
    out = np.linalg.inv(covariance)
    return np.asarray((out + out.T) / 2)
