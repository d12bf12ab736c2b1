# SPDX-License-Identifier: Apache-2.0
"""The transform between two saved maps of one building, or the reason why there is none that is certain.

Each place of the second map is searched on the whole first map, as a robot without a pose is. Every pose that it may
have there proposes a transform. A transform is then judged by all places of the second map that it puts onto known
space of the first. They must match there: few beams may end in free space or pass a wall. So a place that
looks alike elsewhere proposes a wrong transform, and the rest of the map contradicts it. Where a second transform
holds too, as in a row of equal rooms, none is certain.

Proposals and their agreement: Mangelson et al., ICRA 2018, as for parts of one map. The judgement by overlap is our
own; the test against the second best is derived from the ratio test of Lowe, IJCV 2004, section 7.1.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from services.mapper.back_end.pose_graph import pose_of
from services.mapper.config import MapperConfig
from services.mapper.front_end.submap import Submap
from services.mapper.localization.global_localization import MIN_POINTS, KeyframeGroup, MapSurface, find_poses
from services.mapper.maps.map_file import SavedMap
from shared.config import UserError
from shared.geometry import Pose2, wrapped
from shared.types import Float64s

PLACE_M = 2.0  # side of the cells of the second map that are one place each
MAX_PLACES = 60  # that are searched on the first map
PLACE_RADIUS_M = 3.0  # around a place: its keyframes
SAME_M, SAME_RAD = 0.3, 0.15  # difference of two transforms that count as one, at a place
BEND_PER_M = 0.03  # m per m between two places, by which maps may be bent
MAX_CANDIDATES = 5  # transforms that are judged
MAX_WINDOWS = 3_000_000  # of a place's search: 2 s of CPU; a place that needs more looks like many others
MIN_KNOWN_RATIO = 0.5  # of a place's beams that must end in known space of the first map, to judge it
MAX_CONTRADICTIONS = 0.1  # of a place's beams in known space, to count as matching
MIN_PLACES = 4  # that must match
MIN_SPREAD_M = 5.0  # between them: one room alone may have a double
MAX_RIVAL_RATIO = 0.34  # places that match by another transform, as a share of those that match by the best
MAX_MISMATCHES = 0.15  # of the judged places


@dataclass(frozen=True, slots=True)
class MapPlace:
    """A place of the second map.  xy: (2,) m in its frame.  poses: plausible first_from_second, best first."""

    xy: Float64s
    group: KeyframeGroup
    poses: tuple[Pose2, ...]


@dataclass(frozen=True, slots=True)
class Overlap:
    """What the places of the second map say of a transform.

    matching, judged: rows of the places that match, and of all in known space.
    contradictions: share of the beams of all judged places that contradict the first map.
    spread: m between the farthest places that match.
    """

    first_from_second: Pose2
    matching: tuple[int, ...]
    judged: tuple[int, ...]
    contradictions: float
    spread: float

    @property
    def holds(self) -> bool:
        """Whether the known space that both maps share does not contradict this transform."""
        mismatches = len(self.judged) - len(self.matching)
        return bool(self.matching) and mismatches <= MAX_MISMATCHES * len(self.judged)


def find_overlap(first: SavedMap, second: SavedMap, config: MapperConfig, range_max: float) -> Overlap:
    """Returns the transform by which the second map lies on the first, and what they have in common.

    range_max: m, of the laser.  Raises UserError where no transform is certain.
    """
    surface = MapSurface(first, config.registration, config.occupancy, range_max)
    places = find_places(surface, second, config)
    candidates = candidate_transforms(places)
    submap, _ = surface.submap_and_pyramid(config.global_localization.search)
    overlaps = [judge(submap, places, pose) for pose in candidates]
    return certain_overlap(overlaps, len(places))


def certain_overlap(overlaps: Sequence[Overlap], n_places: int) -> Overlap:
    """Returns the only transform that holds. Raises UserError with the reason where there is none, or another one."""
    hint = "both maps must show several rooms that look alike nowhere else: drive more of what they share"
    if not overlaps:
        raise UserError(f"none of its {n_places} places is found there", hint)
    overlaps = sorted(overlaps, key=lambda overlap: (-overlap.holds, -len(overlap.matching)))
    best = overlaps[0]
    if not best.holds:
        raise UserError(
            f"{len(best.judged) - len(best.matching)} of {len(best.judged)} places that lie on it contradict it",
            "another building, another floor of it, or was much furniture moved?",
        )
    if len(best.matching) < MIN_PLACES or best.spread < MIN_SPREAD_M:
        raise UserError(
            f"only {len(best.matching)} of its {n_places} places, {best.spread:.0f} m apart, are found there", hint
        )
    rivals = [len(overlap.matching) for overlap in overlaps[1:] if overlap.holds]
    if rivals and max(rivals) > MAX_RIVAL_RATIO * len(best.matching):
        raise UserError(
            f"it may lie there in two ways: {len(best.matching)} places match by one, {max(rivals)} by another",
            "rows of equal rooms look alike: drive on until both maps show what is there once",
        )
    return best


def find_places(surface: MapSurface, second: SavedMap, config: MapperConfig) -> list[MapPlace]:
    """Returns the places of the second map with the poses that each may have on the first."""
    search = config.global_localization.search.model_copy(update={"max_windows": MAX_WINDOWS})
    localization = config.global_localization.model_copy(update={"search": search})
    positions = second.graph.poses[:, :2]
    places = []
    for row in place_rows(positions):
        distance = np.hypot(*(positions - positions[row]).T)
        near = np.argsort(distance, kind="stable")[: localization.n_keyframes]
        near = near[distance[near] <= PLACE_RADIUS_M][::-1]  # the place itself is the newest
        keyframes = [
            replace(second.keyframes[k], local_from_base=pose_of(second.graph.poses[k])) for k in near.tolist()
        ]
        if sum(len(keyframe.normals) for keyframe in keyframes) < MIN_POINTS:
            continue
        hypotheses, _ = find_poses(surface, keyframes, (), localization)
        poses = tuple(hypothesis.map_from_local for hypothesis in hypotheses if hypothesis.is_plausible)
        places.append(MapPlace(positions[row], KeyframeGroup.of(keyframes), poses))
    return places


def place_rows(positions: Float64s) -> list[int]:
    """Returns the row of one node for each cell of PLACE_M, at most MAX_PLACES evenly chosen.  positions: (n, 2) m."""
    _, rows = np.unique(np.floor(positions / PLACE_M).astype(np.int64), axis=0, return_index=True)
    rows = np.sort(rows)
    if len(rows) > MAX_PLACES:
        rows = rows[np.linspace(0, len(rows) - 1, MAX_PLACES).round().astype(np.int64)]
    return [int(row) for row in rows]


def candidate_transforms(places: Sequence[MapPlace]) -> list[Pose2]:
    """Returns transforms, each that with which most of the remaining proposals agree; at most MAX_CANDIDATES."""
    proposals = [(place.xy, pose) for place in places for pose in place.poses]
    candidates: list[Pose2] = []
    while proposals and len(candidates) < MAX_CANDIDATES:
        groups = [[k for k, other in enumerate(proposals) if is_same(one, other)] for one in proposals]
        group = max(groups, key=len)
        candidates.append(proposals[groups.index(group)][1])
        proposals = [proposal for k, proposal in enumerate(proposals) if k not in group]
    return candidates


def is_same(one: tuple[Float64s, Pose2], other: tuple[Float64s, Pose2]) -> bool:
    """Whether two proposals, each a place (2,) m and a transform, put both places at the same poses, but for a bend."""
    (xy, a), (other_xy, b) = one, other
    limit = SAME_M + BEND_PER_M * float(np.hypot(*(xy - other_xy)))
    both = np.array((xy, other_xy))
    return float(np.hypot(*(a @ both - b @ both).T).max()) <= limit and abs(wrapped(a.yaw - b.yaw)) <= SAME_RAD


def judge(submap: Submap, places: Sequence[MapPlace], first_from_second: Pose2) -> Overlap:
    """Returns what all places say of a transform, each after its match from there.  submap: of the first map."""
    matching, judged, n_known, n_contradicting = [], [], 0, 0
    for row, place in enumerate(places):
        known, contradicting, total = beam_counts(submap, place, first_from_second)
        if known < MIN_KNOWN_RATIO * total:
            continue
        judged.append(row)
        n_known, n_contradicting = n_known + known, n_contradicting + contradicting
        if contradicting <= MAX_CONTRADICTIONS * known:
            matching.append(row)
    xy = np.array([places[row].xy for row in matching]).reshape(-1, 2)
    spread = float(np.hypot(*(xy[:, None] - xy[None]).reshape(-1, 2).T).max(initial=0.0))
    return Overlap(first_from_second, tuple(matching), tuple(judged), n_contradicting / max(n_known, 1), spread)


def beam_counts(submap: Submap, place: MapPlace, first_from_second: Pose2) -> tuple[int, int, int]:
    """Returns how many beams of a place agree or contradict, how many contradict, and how many it has."""
    group = place.group
    start = first_from_second @ group.newest
    match = group.register(submap, start)
    is_near = is_same((place.xy, first_from_second), (place.xy, match.map_from_base @ group.newest.inverse()))
    pose = match.map_from_base if is_near else start
    known = contradicting = 0
    for keyframe, newest_from_base, (points, normals) in zip(group.keyframes, group.newest_from_each, group.surfaces):
        if not len(points):
            continue
        measured = submap.registrar.evaluate(points, normals, pose @ newest_from_base)
        others = points[~measured.inliers]
        origins = measured.map_from_base @ np.broadcast_to(keyframe.origin, others.shape)
        n = int(submap.grid.contradicts(origins, measured.map_from_base @ others).sum())
        contradicting += n
        known += n + int(measured.inliers.sum())
    return known, contradicting, len(group.points)
