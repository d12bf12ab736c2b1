# SPDX-License-Identifier: Apache-2.0
"""Doubtful closures: loop closures that count once others put the robot at the same place, over a few metres of path.

Partial closures are matches with an earlier visit that saw the place from its other side. A laser with half a circle of
view sees little of what it saw before, where the robot comes back the other way. A quarter of the beams agree then,
hardly any contradict, and the rest end where the submap saw nothing. One such match may be a wall alone. They are less
accurate than others, so they count only where they show a drift that others do not correct.

Closures that move the robot far are doubtful, too. A robot may come up to a place from ground that it has not mapped.
The submap does not hold this ground, and the next stretch of a corridor may fit in its place. Such matches agree with
each other only until the robot is at the place.

Consistent closures before any counts: Mangelson et al., "Pairwise consistent measurement set maximization", ICRA 2018.
"""

from collections.abc import Sequence

from services.mapper.back_end.loop_closure import Constraint, existing, is_other_pose
from services.mapper.back_end.map_parts import MIN_JOINTS, is_joint, largest_consistent_group
from services.mapper.back_end.pose_graph import PoseGraph

MIN_AGREEING_PATH_M = 3.0  # over which closures agree
MAX_SURE_OFFSET_M = 2.75  # by which a closure moves the robot without others that confirm it over as much more path
MAX_PATH_M = 12.0  # driven, after which a closure no longer confirms others
MIN_DRIFT_M, MIN_DRIFT_RAD = 0.2, 0.04  # that partial closures correct: two of their standard deviations


class DoubtfulClosures:
    """The closures of the last metres: the ones that count, and doubtful ones that wait."""

    def __init__(self) -> None:
        self._counted: list[Constraint] = []
        self._waiting: list[Constraint] = []

    def add(
        self,
        closures: Sequence[Constraint],
        confirmed: Sequence[Constraint],
        graph: PoseGraph,
        driven: Sequence[float],
    ) -> list[Constraint]:
        """Adds the closures of a search. Returns those that count now, with the doubtful ones that others confirm.

        closures, confirmed: their nodes exist; the latter count at once.  driven: (n,) m, path length up to each node.
        """
        sure, doubtful = list(confirmed), list[Constraint]()
        for closure in existing(graph, [*self._waiting, *closures]):
            is_sure = not closure.is_partial and _offset(closure, graph) <= MAX_SURE_OFFSET_M
            (sure if is_sure else doubtful).append(closure)
        path = dict(zip(graph.nodes.tolist(), driven))
        self._counted, self._waiting = (
            [c for c in several if driven[-1] - path[c.j] <= MAX_PATH_M]
            for several in (existing(graph, [*self._counted, *sure]), doubtful)
        )
        if not self._waiting:
            return sure
        newest = graph.pose(int(graph.nodes[-1]))
        recent = [*self._counted, *self._waiting]
        poses = [graph.pose(c.i) @ c.i_from_j @ (graph.pose(c.j).inverse() @ newest) for c in recent]
        group = largest_consistent_group(poses)
        pose = poses[group[len(group) // 2]]
        paths = {path[recent[k].j] for k in group}
        agrees = is_joint(len(paths), len(recent) - len(group), expected=True)
        offset = newest.distance(pose)
        min_path = MIN_AGREEING_PATH_M + (offset if offset > MAX_SURE_OFFSET_M else 0.0)
        is_long = max(paths) - min(paths) >= min_path
        shows_drift = is_other_pose(pose, newest, MIN_DRIFT_M, MIN_DRIFT_RAD)
        if not (agrees and is_long and shows_drift):
            return sure
        needs_partial = sum(not recent[k].is_partial for k in group) < MIN_JOINTS
        waiting = {k - len(self._counted) for k in group if needs_partial or not recent[k].is_partial}
        found = [closure for k, closure in enumerate(self._waiting) if k in waiting]
        self._waiting = [closure for k, closure in enumerate(self._waiting) if k not in waiting]
        self._counted += found
        return sure + found


def _offset(closure: Constraint, graph: PoseGraph) -> float:
    """m, by which a closure moves its later node."""
    return (graph.pose(closure.i) @ closure.i_from_j).distance(graph.pose(closure.j))
