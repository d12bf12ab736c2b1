# SPDX-License-Identifier: Apache-2.0
"""Global localization: the robot's pose on a saved map without a first guess.

The newest keyframes are matched together with the whole map, by branch and bound and registration. A pose is accepted
after several searches along a path gave the same pose, and no other pose fits nearly as well.

Start poses: Hess et al., ICRA 2016, section V-B. The acceptance is our own. Its comparison with the second best pose is
derived from the ratio test of Lowe, IJCV 2004, section 7.1.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot, inf, pi, sqrt
from typing import ClassVar

import numpy as np
from pydantic import Field

from services.mapper.back_end.branch_and_bound import (
    BranchAndBoundConfig,
    Pyramid,
    build_pyramid,
    search,
    search_cost,
)
from services.mapper.back_end.keyframe import Keyframe
from services.mapper.back_end.loop_closure import evidence_ratio
from services.mapper.front_end.registration import Match, Prior, RegistrationConfig
from services.mapper.front_end.submap import Submap
from services.mapper.grid.edit_cells import edit_masks, erased_points
from services.mapper.grid.occupancy import OccupancyConfig
from services.mapper.maps.map_file import SavedMap
from shared.config import Section
from shared.geometry import Pose2, wrapped
from shared.service import Job, Out
from shared.types import Float64s

MAX_POINTS = 2000  # of all keyframes together, for registration
MIN_POINTS = 30  # of a keyframe that is evaluated
MAX_SAME_POSE_M, MAX_SAME_POSE_RAD = 0.3, 0.15  # difference of two hypotheses that count as one
LOOKUPS_PER_S = 1e10  # cells that a search reads in a second of CPU
WINDOWS_PER_S = 1.4e6  # windows that it evaluates in a second of CPU
MAX_PART_WINDOWS = 200_000  # of a search for a part of the map: with more, it looks like many places
MAX_LOOKUPS = 2e10  # of a search for a part; a wider window is reduced to this
MAX_PART_INTERVAL_M = 12.0  # between two searches for a part
MAX_REST_NS = 60_000_000_000  # between two searches
REST_RATIO = 1.0  # rest per CPU time of a search, while the robot waits for its pose
PART_REST_RATIO = 20.0  # the same while the robot maps meanwhile


class GlobalLocalizationConfig(Section):
    """Global localization on a saved map."""

    RENAMED: ClassVar[dict[str, str]] = {
        "every": "search_interval", "keyframes": "n_keyframes", "looks": "min_searches", "way": "min_path",
        "alone": "min_unrivalled", "score": "min_score", "share": "min_inlier_ratio", "balance": "min_inlier_margin",
        "worst": "min_keyframe_margin", "unlike": "max_rival_ratio", "sureness": "min_eigenvalue_ratio",
        "wide": "far_rival_distance", "near": "window", "near_turn": "window_turn",
        "near_looks": "max_window_searches", "kept": "max_pending_keyframes",
    }  # fmt: skip

    search_interval: float = Field(0.4, ge=0, le=20, description="m driven between two searches")
    n_keyframes: int = Field(15, ge=1, le=100, description="newest keyframes that are matched together")
    min_searches: int = Field(3, ge=1, le=100, description="searches in a row that must give the same pose")
    min_path: float = Field(1.2, ge=0, le=100, description="m driven during these searches, at least")
    min_unrivalled: int = Field(
        2, ge=1, le=100, description="of these searches, the last in a row that must give no other pose"
    )
    min_score: float = Field(0.5, ge=0, le=1, description="minimum score of a start pose from branch and bound")
    min_inlier_ratio: float = Field(0.65, ge=0, le=1, description="minimum share of the beams that agree")
    min_inlier_margin: float = Field(
        0.6, ge=0, le=1, description="minimum of agreeing beams less contradicting ones, as a share of all"
    )
    min_keyframe_margin: float = Field(0.35, ge=0, le=1, description="minimum of the same for each keyframe")
    max_rival_ratio: float = Field(
        0.35, ge=0, le=1, description="evidence against the best pose, as a share of that against the second best"
    )
    min_eigenvalue_ratio: float = Field(
        0.01, ge=0, le=1, description="minimum ratio of the eigenvalues of the position's information"
    )
    far_rival_distance: float = Field(
        3.0, ge=0.5, le=100, description="m from the best pose beyond which a second rival is searched"
    )
    window: float = Field(1.5, ge=0.1, le=20, description="m, maximum error of a given pose")
    window_turn: float = Field(0.6, ge=0.05, le=3.1, description="rad, maximum error of its yaw")
    max_window_searches: int = Field(
        3, ge=1, le=100, description="failed searches about a given pose, until the whole map is searched"
    )
    max_pending_keyframes: int = Field(
        200, ge=10, le=100_000, description="keyframes that are stored until the robot is localized"
    )
    search: BranchAndBoundConfig = BranchAndBoundConfig(min_rival_ratio=0.7, max_windows=50_000_000)


@dataclass(frozen=True, slots=True)
class PoseHypothesis:
    """A pose that was evaluated.

    margin: mean over the keyframes of inliers less contradicting beams, as a share of all.
    is_plausible: all criteria hold that concern this pose alone.
    """

    map_from_local: Pose2
    margin: float
    is_plausible: bool


class MapSurface:
    """A whole saved map for matching, in `map`, built at the first use: without what was erased, and without walls.

    It caches what can be computed again, so a job that uses it stays pure.
    """

    def __init__(
        self, saved: SavedMap, registration: RegistrationConfig, occupancy: OccupancyConfig, range_max: float
    ) -> None:
        self._saved, self._settings = saved, (registration, occupancy, range_max)
        self._cached: tuple[Submap, Pyramid] | None = None

    def submap_and_pyramid(self, config: BranchAndBoundConfig) -> tuple[Submap, Pyramid]:
        """Returns the submap for registration and the pyramid for the search."""
        if self._cached is None:
            submap, saved = Submap(*self._settings), self._saved
            edits = edit_masks(saved.edits, saved.tiles.resolution)
            for keyframe, row in zip(saved.keyframes, saved.graph.poses.tolist()):
                pose, (points, normals) = Pose2(*row), keyframe.surface()
                if edits:
                    remains = ~erased_points(edits, pose @ points, saved.tiles.resolution)
                    points, normals = points[remains], normals[remains]
                submap.add_points(pose, points, normals)
            submap.grid.load(saved.tiles)
            submap.grid.set_edits(edits)
            points = submap.registrar.map.points[: submap.registrar.map.n, :2]
            self._cached = submap, build_pyramid(np.ascontiguousarray(points), config)
        return self._cached


@dataclass(frozen=True, slots=True)
class KeyframeGroup:
    """Keyframes of one place that are matched together.

    newest: local_from_base of the newest one.
    newest_from_each, surfaces: of each keyframe; points and normals (k, 2) m in its `base`.
    points, normals: (n, 2) m of all of them, in the newest one's `base`.
    """

    keyframes: tuple[Keyframe, ...]
    newest: Pose2
    newest_from_each: list[Pose2]
    surfaces: list[tuple[Float64s, Float64s]]
    points: Float64s
    normals: Float64s

    @classmethod
    def of(cls, keyframes: Sequence[Keyframe]) -> "KeyframeGroup":
        """Returns the group; the last keyframe is the newest."""
        newest = keyframes[-1].local_from_base
        newest_from_each = [newest.inverse() @ keyframe.local_from_base for keyframe in keyframes]
        surfaces = [keyframe.surface() for keyframe in keyframes]
        points = np.concatenate([pose @ p for pose, (p, _) in zip(newest_from_each, surfaces)])
        normals = np.concatenate([Pose2(0, 0, pose.yaw) @ n for pose, (_, n) in zip(newest_from_each, surfaces)])
        return cls(tuple(keyframes), newest, newest_from_each, surfaces, points, normals)

    def register(self, submap: Submap, start: Pose2) -> Match:
        """Returns the match of at most MAX_POINTS with a submap.  start: map_from_base of the newest."""
        stride = -(-len(self.points) // MAX_POINTS)
        some, some_normals = np.ascontiguousarray(self.points[::stride]), np.ascontiguousarray(self.normals[::stride])
        return submap.registrar.register(some, some_normals, start, Prior(start, 0.5, 0.2))


def find_poses(
    surface: MapSurface,
    keyframes: Sequence[Keyframe],
    guesses: Sequence[Pose2],
    config: GlobalLocalizationConfig,
    window_about: Pose2 | None = None,
    part_about: Pose2 | None = None,
) -> tuple[list[PoseHypothesis], float]:
    """Returns hypotheses of map_from_local for all keyframes together, best first, and the CPU time, s, by estimate.

    guesses: map_from_local that are evaluated too.
    window_about: a given map_from_local; only `window` about it is searched.
    part_about: map_from_local of a part; its surroundings are searched where the whole map is too large.
    """
    submap, pyramid = surface.submap_and_pyramid(config.search)
    group = KeyframeGroup.of(keyframes)
    points, newest = group.points, group.newest
    if len(points) < MIN_POINTS or submap.registrar.map.n < MIN_POINTS:
        return [], 0.0
    height, width = pyramid.levels[0].shape
    centre = Pose2(width * pyramid.resolution / 2 + pyramid.x0, height * pyramid.resolution / 2 + pyramid.y0)
    reach, turn = max(width, height) * pyramid.resolution / 2, pi
    if window_about is not None:
        centre, reach, turn = window_about @ newest, config.window, config.window_turn
    starts = [guess @ newest for guess in guesses]
    cost = search_cost(points, pyramid, reach, turn, config.search)
    max_windows = config.search.max_windows if part_about is None else MAX_PART_WINDOWS
    if part_about is not None and cost > MAX_LOOKUPS:
        centre, reach, cost = part_about @ newest, reach * sqrt(MAX_LOOKUPS / cost), round(MAX_LOOKUPS)
    settings = config.search.model_copy(update={"max_windows": max_windows})
    candidates, n_windows = search(
        points, pyramid, centre, reach, turn, config.min_score, settings, (config.far_rival_distance,)
    )
    seconds = cost / LOOKUPS_PER_S + n_windows / WINDOWS_PER_S
    starts += [candidate.pose for candidate in candidates if candidate.pose not in starts]
    hypotheses: list[PoseHypothesis] = []
    for start in starts:
        hypothesis = _evaluate(group.register(submap, start), submap, group, config)
        if not any(is_same_pose(hypothesis.map_from_local, other.map_from_local, newest) for other in hypotheses):
            hypotheses.append(hypothesis)
    return sorted(hypotheses, key=lambda hypothesis: -hypothesis.margin), seconds


def _evaluate(match: Match, submap: Submap, group: KeyframeGroup, config: GlobalLocalizationConfig) -> PoseHypothesis:
    """Returns the hypothesis of a match of all keyframes, evaluated by each keyframe."""
    margins, inlier_ratios = [], []
    for keyframe, newest_from_base, (points, normals) in zip(group.keyframes, group.newest_from_each, group.surfaces):
        if len(points) < MIN_POINTS:
            continue
        measured = submap.registrar.evaluate(points, normals, match.map_from_base @ newest_from_base)
        margins.append(submap.inlier_margin(measured, keyframe.origin, points))
        inlier_ratios.append(measured.inlier_ratio)
    map_from_local = match.map_from_base @ group.newest.inverse()
    if not margins:
        return PoseHypothesis(map_from_local, 0.0, False)
    eigenvalues = np.linalg.eigvalsh(match.information[:2, :2])
    margin = float(np.mean(margins))
    is_plausible = (
        margin >= config.min_inlier_margin
        and float(np.mean(inlier_ratios)) >= config.min_inlier_ratio
        and min(margins) >= config.min_keyframe_margin
        and float(eigenvalues[0]) >= config.min_eigenvalue_ratio * float(eigenvalues[1])
    )
    return PoseHypothesis(map_from_local, margin, bool(is_plausible))


def is_same_pose(a: Pose2, b: Pose2, local_from_base: Pose2) -> bool:
    """Whether two map_from_local put the robot at the same pose."""
    pose_a, pose_b = a @ local_from_base, b @ local_from_base
    return pose_a.distance(pose_b) <= MAX_SAME_POSE_M and abs(wrapped(pose_a.yaw - pose_b.yaw)) <= MAX_SAME_POSE_RAD


class GlobalLocalizer:
    """Collects keyframes while the pose is unknown, orders searches, and decides when the pose is certain.

    range_max: m, of the laser.
    """

    def __init__(
        self,
        config: GlobalLocalizationConfig,
        registration: RegistrationConfig,
        occupancy: OccupancyConfig,
        range_max: float,
    ) -> None:
        self.config = config
        self._settings = registration, occupancy, range_max
        self.epoch = 0
        self.rest: tuple[int, int] | None = None  # ns, stamps of keyframes from which and until which no search begins
        self.load(None)

    def load(self, saved: SavedMap | None, part_about: Pose2 | None = None) -> None:
        """Searches the robot on this map; None ends all searches.

        part_about: map_from_local of a part that is searched on the rest of the map. Then the robot maps meanwhile.
        """
        self.surface = MapSurface(saved, *self._settings) if saved is not None else None
        self.start(part_about=part_about)

    def edit(self, saved: SavedMap) -> None:
        """Goes on with the same map with other edits."""
        if self.surface is not None:
            self.surface = MapSurface(saved, *self._settings)

    def start(self, window_about: Pose2 | None = None, part_about: Pose2 | None = None) -> None:
        """Begins to search: the whole map, or about a given map_from_local, where one search is enough.

        part_about: as for `load`.
        """
        self.epoch += 1
        self.is_searching = self.surface is not None
        self.has_job = False
        self.pending: list[tuple[Keyframe, Match, float]] = []  # arguments of `BackEnd.add_keyframe`
        self.driven = 0.0  # m
        self.searched_at = -inf  # m driven, at the last search
        self.guesses: tuple[Pose2, ...] = ()
        self.window_about, self.n_failed = window_about, 0  # searches there
        self.part_about = part_about  # about which to search where the map is large
        self.tracks: list[tuple[Pose2, float, int]] = []  # pose, m driven at its first search, number of searches
        self.n_unrivalled = 0  # searches in a row that gave one pose alone
        self.n_fruitless = 0  # searches in a row that gave no plausible pose

    def add_keyframe(self, keyframe: Keyframe, match: Match, odometry_scale: float) -> Out:
        """Stores a keyframe, with the arguments of `BackEnd.add_keyframe`, and orders a search when due."""
        if self.pending:
            step = self.pending[-1][0].local_from_base.inverse() @ keyframe.local_from_base
            self.driven += hypot(step.x, step.y)
        self.pending.append((keyframe, match, odometry_scale))
        del self.pending[: -self.config.max_pending_keyframes]
        is_due = self.driven - self.searched_at >= self._interval and not self._rests(keyframe.stamp)
        if self.surface is not None and not self.has_job and is_due:
            self.searched_at, self.has_job = self.driven, True
            newest = tuple(pending for pending, _, _ in self.pending[-self.config.n_keyframes :])
            order = self.epoch, self.surface, newest, self.guesses, self.config, self.window_about, self.part_about
            yield Job(_search, order, "on_localized", 0.5)

    @property
    def _interval(self) -> float:
        """m driven between two searches. For a part that may be on new ground, it grows while they find nothing."""
        interval = self.config.search_interval
        if self.part_about is None:
            return interval
        return max(interval, min((1 + self.n_fruitless) * interval, MAX_PART_INTERVAL_M))

    def _rests(self, stamp: int) -> bool:
        """Whether the next search waits because the last one was long; never after the clock was set back."""
        return self.rest is not None and self.rest[0] <= stamp < self.rest[1]

    def accepted_pose(self, result: tuple[int, list[PoseHypothesis], float]) -> Pose2 | None:
        """Applies the result of a search; returns map_from_local once it is certain."""
        epoch, hypotheses, seconds = result
        if epoch != self.epoch:
            return None
        self.has_job = False
        stamp = self.pending[-1][0].stamp
        rest_ratio = REST_RATIO if self.part_about is None else PART_REST_RATIO
        self.rest = stamp, stamp + min(round(rest_ratio * seconds * 1e9), MAX_REST_NS)
        self.guesses = tuple(hypothesis.map_from_local for hypothesis in hypotheses[:4])
        local_from_base, before, self.tracks = self.pending[-1][0].local_from_base, self.tracks, []
        for pose in (hypothesis.map_from_local for hypothesis in hypotheses if hypothesis.is_plausible):
            new = pose, self.searched_at, 0
            _, since, n = next((old for old in before if is_same_pose(pose, old[0], local_from_base)), new)
            self.tracks.append((pose, since, n + 1))
        self.n_fruitless = 0 if self.tracks else self.n_fruitless + 1
        if not hypotheses or not hypotheses[0].is_plausible or not self._is_unrivalled(hypotheses):
            self.n_unrivalled = 0
            self.n_failed += 1
            if self.n_failed >= self.config.max_window_searches:
                self.window_about = None
            return None
        pose, since, n = self.tracks[0]
        self.n_unrivalled = min(self.n_unrivalled + 1, n)
        is_stable = n >= self.config.min_searches and self.searched_at - since >= self.config.min_path
        if self.window_about is None and (self.n_unrivalled < self.config.min_unrivalled or not is_stable):
            if is_stable and self.part_about is None:
                self.rest = None  # the next search confirms the pose
            return None
        self.is_searching = False
        return pose

    def _is_unrivalled(self, hypotheses: Sequence[PoseHypothesis]) -> bool:
        """Whether the evidence against every other pose exceeds what moved furniture explains.

        In a row of similar rooms, the right one may fit worse than its neighbour after a box was moved. So the evidence
        against the best pose must be a small share of that against the next.
        """
        best, rival = hypotheses[0].margin, hypotheses[1].margin if len(hypotheses) > 1 else 0.0
        return evidence_ratio(best, rival) <= self.config.max_rival_ratio


def _search(
    epoch: int,
    surface: MapSurface,
    keyframes: Sequence[Keyframe],
    guesses: Sequence[Pose2],
    config: GlobalLocalizationConfig,
    window_about: Pose2 | None,
    part_about: Pose2 | None,
) -> tuple[int, list[PoseHypothesis], float]:
    return epoch, *find_poses(surface, keyframes, guesses, config, window_about, part_about)
