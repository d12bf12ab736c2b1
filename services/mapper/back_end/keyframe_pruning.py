# SPDX-License-Identifier: Apache-2.0
"""Choice of the keyframe to remove, so that the graph grows with the mapped area and not with time.

Each place keeps a bounded number of views, as in Konolige and Bowman, "Towards lifelong visual maps", IROS 2009. Which
one is removed is our own rule: the oldest. Kretzschmar and Stachniss (IJRR 2012) remove the least informative one.
"""

from collections.abc import Sequence

import numpy as np

from services.mapper.back_end.pose_graph import PoseGraph
from shared.geometry import wrapped_all

MAX_VISIT_CROWDS = 10
"""A keyframe is of an earlier visit after this many times `max_keyframes` newer ones, also if the robot only turns."""


def redundant_keyframe(
    graph: PoseGraph,
    driven: Sequence[float],
    max_keyframes: int,
    place_size: float,
    min_path: float,
    first: int,
    protected: Sequence[int],
) -> int | None:
    """Returns the row of the oldest keyframe at the newest one's place; None below `max_keyframes` of earlier visits.

    driven: (n,) path length up to each node, m.
    place_size: m in x and y, and rad in yaw, within which keyframes count as one place.
    min_path: path length after which a keyframe is of an earlier visit, m.
    first: first row that counts.  protected: names of nodes that stay, as fixed nodes do.
    """
    poses, nodes, path = graph.poses, graph.nodes, np.array(driven)
    here = (np.abs(poses[:, :2] - poses[-1, :2]) < place_size).all(axis=1)
    here &= np.abs(wrapped_all(poses[:, 2] - poses[-1, 2])) < place_size
    here[:first] = False
    is_earlier = (path[-1] - path > min_path) | (nodes[-1] - nodes > MAX_VISIT_CROWDS * max_keyframes)
    rows = np.flatnonzero(here & is_earlier & ~graph.fixed & ~np.isin(nodes, protected))
    return int(rows[0]) if len(rows) >= max_keyframes else None
