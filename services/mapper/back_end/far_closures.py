# SPDX-License-Identifier: Apache-2.0
"""Far closures: loop closures after a long path, where the pose has drifted out of the ordinary window.

The search for closures covers a few metres. After a long path outdoors, or over parts that only odometry joins, the
robot may be tens of metres off. So places within its drift are searched as well, one at a time. The drift is about the
graph's pose and, in turn, about that by odometry alone: matches of plants may be wrong by more. One match so wide may
be wrong, as buildings repeat themselves. It is a hypothesis: the next keyframes are matched where it puts them. Its
closures count once enough of them agree over a long enough path, and more of their keyframes fit nowhere else as well
than do. The best match is compared first, as a keyframe of plants or of one wall fits at many places.

Consistent closures before any counts: Mangelson et al., ICRA 2018. One hypothesis at a time, and its comparison with
all other places, are our own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from services.mapper.back_end.keyframe import Keyframe
from services.mapper.back_end.loop_closure import (
    Constraint,
    LoopClosureConfig,
    PlaceMatch,
    SearchWindow,
    SubmapCache,
    evidence_ratio,
    existing,
    is_beyond_window,
    is_other_pose,
    match_place,
    visits_before,
)
from services.mapper.back_end.map_parts import is_joint, largest_consistent_group
from services.mapper.back_end.pose_graph import Graph, PoseGraph, pose_of
from shared.geometry import Pose2
from shared.types import Float64s, Int64s

MAX_PLACES = 200  # within the drift, that a hypothesis is compared with: some seconds of CPU
SEARCH_INTERVAL_M = 1.0  # driven between two searches without a hypothesis
N_IN_TURN = 2  # places that a search tries without a hypothesis, beside the nearest one
MIN_SCORE = 0.5  # of branch and bound at a place; a match with fewer beams is not accepted
MAX_STEPS = 100_000  # of branch and bound at a place: 0.1 s
MAX_SIGMAS = 3.0  # of the drift that is searched: a place beyond two of them may be a rival
MIN_AGREEING_PATH_M = 3.0  # over which closures agree
MIN_PATH_PER_OFFSET = 0.05  # m more of that path for each m by which they move the robot
FIRST_SHARE, FOLLOWING_SHARE = 0.85, 0.75  # of the beams that must agree with a closure: for a hypothesis, and after it
MAX_EXTRA_MISSES = 3  # keyframes that do not fit where the hypothesis puts them, beyond as many as fit
MISSES_PER_RIVAL = 4  # that a keyframe counts for if it fits at another place as well
MAX_RIVAL_RATIO = 0.8  # margin of another place, as a share of the hypothesis'
MAX_EVIDENCE_RATIO = 0.35  # evidence against the hypothesis, as a share of that against another place
HYPOTHESIS_COVARIANCE = np.zeros((3, 3))
"""Of a keyframe by its hypothesis: the smallest window of a closure is wide enough."""
SAME_PLACE_M, SAME_PLACE_RAD = 1.0, 0.2  # difference of poses that count as one, as old places have errors of their own


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """Pose of the newest keyframe by the far closures until now.

    best: once enough of them agree, the best match that was not compared with all places yet.
    """

    map_from_base: Pose2
    best: Constraint | None = None


@dataclass(frozen=True, slots=True)
class FarSearch:
    """Result of one search.

    closure, margin: of the newest keyframe.  has_missed: it does not fit where the hypothesis puts it.
    is_unique: the hypothesis' best match was compared with all places, and no other fits as well.
    is_ambiguous: one of them does, or they are too many.
    """

    closure: Constraint | None = None
    margin: float = 0.0
    has_missed: bool = False
    is_unique: bool = False
    is_ambiguous: bool = False
    compared: int | None = None  # name of the best match's node


class FarClosures:
    """The hypothesis: far closures that wait until enough of them agree."""

    def __init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        self.waiting: list[Constraint] = []
        self.margins: dict[int, float] = {}  # of the closures that were not compared with all places, by node
        self.n_misses = self.n_more_unique = 0  # the latter: matches without a rival less those with one

    def hypothesis(self, graph: PoseGraph, driven: Sequence[float]) -> Hypothesis | None:
        """Returns the hypothesis; None if there is none.  driven: (n,) m, path length up to each node."""
        group, poses, newest = self._agreeing(graph)
        if not group:
            return None
        rows = np.searchsorted(graph.nodes, [self.waiting[k].j for k in group])
        pose = poses[group[-1]]
        path = driven[int(rows[-1])] - driven[int(rows[0])]
        is_long = path >= MIN_AGREEING_PATH_M + MIN_PATH_PER_OFFSET * newest.distance(pose)
        if not (is_long and is_joint(len(group), len(poses) - len(group), expected=False)):
            return Hypothesis(pose)
        to_compare = [c for c in (self.waiting[k] for k in group) if c.j in self.margins]
        return Hypothesis(pose, max(to_compare, key=lambda c: self.margins[c.j], default=None))

    def _agreeing(self, graph: PoseGraph) -> tuple[list[int], list[Pose2], Pose2]:
        """Returns the indices of the closures that agree, the newest node's pose by each closure, and by the graph."""
        newest = graph.pose(int(graph.nodes[-1]))
        self.waiting = existing(graph, self.waiting)
        poses = [graph.pose(c.i) @ c.i_from_j @ (graph.pose(c.j).inverse() @ newest) for c in self.waiting]
        return largest_consistent_group(poses), poses, newest

    def add(self, search: FarSearch, graph: PoseGraph) -> list[Constraint]:
        """Adds the result of a search. Returns the closures that agree once they count; else none."""
        self.n_misses += search.has_missed + MISSES_PER_RIVAL * search.is_ambiguous
        self.n_more_unique += search.is_unique - search.is_ambiguous
        if search.compared is not None:
            self.margins.pop(search.compared, None)
        if search.closure is not None:
            self.waiting.append(search.closure)
            self.margins[search.closure.j] = search.margin
        counts = search.is_unique and self.n_more_unique > 0
        closures = [self.waiting[k] for k in self._agreeing(graph)[0]] if counts else []
        if closures or self.n_misses > len(self.waiting) + MAX_EXTRA_MISSES:
            self._begin()
        return closures


def find_far_closure(
    graph: Graph,
    covariances: Float64s,
    keyframes: Sequence[Keyframe],
    driven: Float64s,
    submaps: SubmapCache,
    config: LoopClosureConfig,
    hypothesis: Hypothesis | None,
) -> FarSearch:
    """Matches the newest keyframe where the hypothesis puts it; without one, with some places within the drift.

    covariances: (n, 3, 3) of the nodes relative to the newest.
    keyframes, driven: (n,) of the graph's nodes; driven is the path length up to each, m.
    """
    limits = drift_limits(covariances, driven, config)
    search = _Search(graph, keyframes, submaps, config, covariances, limits)
    if hypothesis is not None:
        followed = search.follow(hypothesis)
        if hypothesis.best is None:
            return followed
        is_unique = _is_unique(graph, keyframes, driven, submaps, config, hypothesis.best)
        return replace(followed, compared=hypothesis.best.j, is_unique=is_unique, is_ambiguous=not is_unique)
    n_searches = int(driven[-1] / SEARCH_INTERVAL_M)
    guesses = by_graph(graph), by_odometry(graph, keyframes)
    for map_from_last in guesses if n_searches % 2 else guesses[::-1]:
        places = distant_places(graph.poses, map_from_last, limits, config)
        if len(places):
            return search.in_turn(places, map_from_last, n_searches // 2)
    return FarSearch()


def _is_unique(
    graph: Graph,
    keyframes: Sequence[Keyframe],
    driven: Float64s,
    submaps: SubmapCache,
    config: LoopClosureConfig,
    closure: Constraint,
) -> bool:
    """Whether the later keyframe of a closure fits at no other place as well.

    It is compared with the nodes before it: within its drift, and where it cannot be. A building in which it fits at
    another of these looks alike, and so the match proves little.  Others as for `find_far_closure`.
    """
    before, covariances, keyframes, driven = visits_before(graph, keyframes, driven, closure.j)
    limits = drift_limits(covariances, driven, config)
    search = _Search(before, keyframes, submaps, config, covariances, limits)
    pose = pose_of(graph.poses[int(np.searchsorted(graph.nodes, closure.i))]) @ closure.i_from_j
    found = search.near(pose)
    if found is None:
        return False
    n_places = 0
    for map_from_last in (by_graph(before), by_odometry(before, keyframes)):
        places = distant_places(before.poses, map_from_last, limits, config)
        n_places += len(places)
        if len(places) > MAX_PLACES or any(
            search.has_rival(place, pose_of(map_from_last[place]), *found) for place in places.tolist()
        ):
            return False
    if n_places == 0:
        return False
    elsewhere = at_each_node(before)
    places = distant_places(before.poses, elsewhere, limits, config)
    places = places[:: -(-len(places) // MAX_PLACES)]
    return not any(search.has_rival(place, pose_of(elsewhere[place]), *found, config.view_radius) for place in places)


@dataclass(frozen=True, slots=True)
class _Search:
    """Matches the newest keyframe. Arguments as for `find_far_closure`.  limits: (n,) of `drift_limits`."""

    graph: Graph
    keyframes: Sequence[Keyframe]
    submaps: SubmapCache
    config: LoopClosureConfig
    covariances: Float64s
    limits: Float64s

    def within_drift(
        self, row: int, map_from_last: Pose2, min_score: float, max_reach: float = inf
    ) -> PlaceMatch | None:
        """Returns the match with the place of a row, within the drift of a guess; None if too many poses fit.

        max_reach: m, of the window.
        """
        drifted = self.covariances[row], MAX_SIGMAS, min(float(self.limits[row]), max_reach)
        window = SearchWindow.of(map_from_last, *drifted, self.config)
        return self._match(row, replace(window, min_score=min_score, max_steps=MAX_STEPS, is_even=True))

    def in_turn(self, places: Int64s, map_from_last: Float64s, turn: int) -> FarSearch:
        """Matches with the nearest place, and with others in turn.  map_from_last: (n, 3) guesses, by node."""
        chosen = np.append(0, (N_IN_TURN * turn + np.arange(N_IN_TURN)) % len(places))
        for row in np.unique(places[chosen]).tolist():
            found = self.within_drift(row, pose_of(map_from_last[row]), MIN_SCORE)
            if found is not None and found.is_accepted(self.config, FIRST_SHARE):
                closure = found.constraint(self.graph, row, len(self.graph.nodes) - 1, self.config)
                return FarSearch(closure, found.margin)
        return FarSearch()

    def _match(self, row: int, window: SearchWindow) -> PlaceMatch | None:
        last = len(self.graph.nodes) - 1
        return match_place(self.graph, self.keyframes, row, last, window, self.submaps, self.config)

    def follow(self, hypothesis: Hypothesis) -> FarSearch:
        """Matches where the hypothesis puts the keyframe."""
        found = self.near(hypothesis.map_from_base)
        if found is None:
            return FarSearch(has_missed=True)
        row, best = found
        return FarSearch(best.constraint(self.graph, row, len(self.graph.nodes) - 1, self.config), best.margin)

    def near(self, map_from_base: Pose2) -> tuple[int, PlaceMatch] | None:
        """Returns the row of a place near a pose, and the best match there; None if too few beams agree."""
        if not (self.limits > 0).any():
            return None
        config = self.config
        window = SearchWindow.of(map_from_base, HYPOTHESIS_COVARIANCE, config.window_sigmas, config.max_window, config)
        matches = [(row, self._match(row, window)) for row in self._nearest_rows(map_from_base)]
        fits = [(m.margin, row, m) for row, m in matches if m is not None and m.is_accepted(config, FOLLOWING_SHARE)]
        return max(fits, key=lambda one: one[:2])[1:] if fits else None

    def has_rival(self, place: int, map_from_last: Pose2, row: int, best: PlaceMatch, max_reach: float = inf) -> bool:
        """Whether the keyframe fits at another pose at a place nearly as well as at its best pose, near a row.

        Where the robot is on new ground, the best of many similar places fits not much better than the next. Beams
        that contradict it show that, so it must have little evidence against it compared with its rivals. A pose that
        no hypothesis would follow is none of them.
        """
        found = self.within_drift(
            place, map_from_last, max(self.config.min_score, MAX_RIVAL_RATIO * best.score), max_reach
        )
        if found is None:
            return True
        pose = self._pose(row, best)
        min_margin = FOLLOWING_SHARE * self.config.min_inlier_margin
        return any(
            is_other_pose(pose, other, SAME_PLACE_M, SAME_PLACE_RAD)
            and (margin > MAX_RIVAL_RATIO * best.margin or evidence_ratio(best.margin, margin) > MAX_EVIDENCE_RATIO)
            and margin >= min_margin
            for other, margin in ((self._pose(place, found), found.margin), *found.rivals)
        )

    def _pose(self, row: int, found: PlaceMatch) -> Pose2:
        return pose_of(self.graph.poses[row]) @ found.row_from_last

    def _nearest_rows(self, pose: Pose2) -> list[int]:
        """Rows of the distant node that is nearest to a pose, and of the nearest one of another place."""
        poses: Float64s = self.graph.poses
        rows: Int64s = np.flatnonzero(self.limits > 0)
        rows = rows[np.argsort(np.hypot(*(poses[rows, :2] - (pose.x, pose.y)).T), kind="stable")]
        others = rows[np.hypot(*(poses[rows, :2] - poses[rows[0], :2]).T) > self.config.view_radius]
        return [int(rows[0]), *others[:1].tolist()]


def drift_limits(covariances: Float64s, driven: Float64s, config: LoopClosureConfig) -> Float64s:
    """Returns (n,) m, the error of each node relative to the last one that is searched at most.

    It is 0 for nodes that the ordinary search covers.  covariances: (n, 3, 3) relative to the last node.
    driven: (n,) m.
    """
    sigma = np.sqrt(np.maximum(covariances[:, 0, 0], covariances[:, 1, 1]))
    drift = np.minimum(MAX_SIGMAS * sigma, config.max_window + config.max_drift_ratio * (driven[-1] - driven))
    return np.where(is_beyond_window(covariances, driven, config), drift, 0.0)


def by_graph(graph: Graph) -> Float64s:
    """Returns (n, 3) m, m, rad: for each node, the last one's pose in `map`, which is the same."""
    return np.broadcast_to(graph.poses[-1], graph.poses.shape)


def at_each_node(graph: Graph) -> Float64s:
    """Returns (n, 3) m, m, rad: for each node, a pose there that looks where the last one looks, in `map`."""
    return np.column_stack((graph.poses[:, :2], np.full(len(graph.poses), graph.poses[-1, 2])))


def by_odometry(graph: Graph, keyframes: Sequence[Keyframe]) -> Float64s:
    """Returns (n, 3) m, m, rad: for each node, the last one's pose in `map` by odometry alone since that node.

    It is NaN where odometry is not known.
    """
    poses = np.array(
        [
            (np.nan, np.nan, np.nan) if (k := keyframe.by_odometry) is None else (k.x, k.y, k.yaw)
            for keyframe in keyframes
        ]
    )
    turn = graph.poses[:, 2] - poses[:, 2]
    c, s = np.cos(turn), np.sin(turn)
    x, y, _ = (poses[-1] - poses).T
    return np.column_stack((graph.poses[:, 0] + c * x - s * y, graph.poses[:, 1] + s * x + c * y, turn + poses[-1, 2]))


def distant_places(poses: Float64s, map_from_last: Float64s, limits: Float64s, config: LoopClosureConfig) -> Int64s:
    """Returns rows (k,) of nodes, one for each place, where the last node may be by its drift; nearest first.

    poses: (n, 3) m, m, rad in `map`.  map_from_last: (n, 3) guesses of the last node's pose.
    limits: (n,) of `drift_limits`.
    """
    distance = np.hypot(*(poses[:, :2] - map_from_last[:, :2]).T)
    rows: Int64s = np.flatnonzero((limits > 0) & (distance < config.view_radius + limits))
    rows = rows[np.argsort(distance[rows], kind="stable")]
    places: list[int] = []
    while len(rows):
        places.append(int(rows[0]))
        rows = rows[np.hypot(*(poses[rows, :2] - poses[rows[0], :2]).T) > config.view_radius]
    return np.array(places, np.int64)
