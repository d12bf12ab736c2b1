# SPDX-License-Identifier: Apache-2.0
"""Partial closures: matches of a keyframe with an earlier visit that saw the place from its other side.

A laser with half a circle of view sees little of what it saw before, where the robot comes back the other way. A
quarter of the beams agree then, hardly any contradict, and the rest end where the submap saw nothing. One such match
may be a wall alone. So partial closures wait until several put the robot at one place, over a few metres of path. They
are less accurate than others, so they count only where they show a drift that others do not correct.

Consistent closures before any counts: Mangelson et al., "Pairwise consistent measurement set maximization", ICRA 2018.
"""

from collections.abc import Sequence

from services.mapper.back_end.loop_closure import Constraint, existing, is_other_pose
from services.mapper.back_end.map_parts import MIN_JOINTS, is_joint, largest_consistent_group
from services.mapper.back_end.pose_graph import PoseGraph

MIN_AGREEING_PATH_M = 3.0  # over which closures agree
MAX_PATH_M = 12.0  # driven, after which a closure no longer confirms others
MIN_DRIFT_M, MIN_DRIFT_RAD = 0.2, 0.04  # that partial closures correct: two of their standard deviations


class PartialClosures:
    """The closures of the last metres: the ones that count, and partial ones that wait."""

    def __init__(self) -> None:
        self._counted: list[Constraint] = []
        self._waiting: list[Constraint] = []

    def add(self, closures: Sequence[Constraint], graph: PoseGraph, driven: Sequence[float]) -> list[Constraint]:
        """Adds the closures of a search. Returns those that count now, with the partial ones that others confirm.

        closures: their nodes exist.  driven: (n,) m, path length up to each node.
        """
        sure = [closure for closure in closures if not closure.is_partial]
        path = dict(zip(graph.nodes.tolist(), driven))
        self._counted, self._waiting = (
            [c for c in existing(graph, several) if driven[-1] - path[c.j] <= MAX_PATH_M]
            for several in ([*self._counted, *sure], [*self._waiting, *(c for c in closures if c.is_partial)])
        )
        if not self._waiting:
            return sure
        newest = graph.pose(int(graph.nodes[-1]))
        recent = [*self._counted, *self._waiting]
        poses = [graph.pose(c.i) @ c.i_from_j @ (graph.pose(c.j).inverse() @ newest) for c in recent]
        group = largest_consistent_group(poses)
        paths = {path[recent[k].j] for k in group}
        agrees = is_joint(len(paths), len(recent) - len(group), expected=True)
        is_long = max(paths) - min(paths) >= MIN_AGREEING_PATH_M
        shows_drift = is_other_pose(poses[group[len(group) // 2]], newest, MIN_DRIFT_M, MIN_DRIFT_RAD)
        needs_them = sum(not recent[k].is_partial for k in group) < MIN_JOINTS
        if not (agrees and is_long and shows_drift and needs_them):
            return sure
        confirmed = [k - len(self._counted) for k in group if k >= len(self._counted)]
        closures = [self._waiting[k] for k in confirmed]
        self._waiting = [closure for k, closure in enumerate(self._waiting) if k not in confirmed]
        self._counted += closures
        return sure + closures
