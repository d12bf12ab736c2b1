# SPDX-License-Identifier: Apache-2.0
"""Which keyframe to give up, so that the graph grows with the area and not with time?"""

from collections.abc import Sequence

import numpy as np

from services.mapper.pose_graph import PoseGraph
from shared.geometry import wrapped_all

LONG_AGO = 10  # crowds of keyframes after which one is no longer of this visit, also where the robot only turns


def crowded(
    graph: PoseGraph, driven: Sequence[float], most: int, reach: float, apart: float, first: int, kept: Sequence[int]
) -> int | None:
    """The row of the oldest keyframe at the newest one's place, where `most` of earlier visits are there; else None.

    driven: (n,) m up to each node.  reach: m, and rad, that make it one place.  apart: m of driving that make a visit
    an earlier one.  first: row before which nothing counts.  kept: names of nodes that stay, as the first one does.
    """
    poses, nodes, ways = graph.poses, graph.nodes, np.array(driven)
    here = (np.abs(poses[:, :2] - poses[-1, :2]) < reach).all(axis=1)
    here &= np.abs(wrapped_all(poses[:, 2] - poses[-1, 2])) < reach
    here[:first] = False
    gone = (ways[-1] - ways > apart) | (nodes[-1] - nodes > LONG_AGO * most)
    old = np.flatnonzero(here & gone & ~np.isin(nodes, kept))
    old = old[old > 0]  # the first one holds the map
    return int(old[0]) if len(old) >= most else None
