# SPDX-License-Identifier: Apache-2.0
"""The map drawn again from its keyframes, a slice a Job: what is sure first, then what may only add to it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from services.mapper.keyframe import Keyframe
from services.mapper.occupancy import Occupancy
from services.mapper.parts import MIN_KEYFRAMES, fits, joined_nodes
from services.mapper.pose_graph import Graph
from shared.geometry import Bools, Float64s, Pose2

SLICE = 100  # keyframes that one job draws: 0.2 s, looks for closures go on in between


@dataclass(frozen=True, slots=True)
class Drawing:
    """The part of the map that is drawn again, and the keyframes, at poses (n, 3) in `map`, that are still to be drawn.

    sure: (n,) False where one is drawn only if it fits what is drawn already.  node: the newest that is in the grid or
    among them.
    """

    grid: Occupancy
    keyframes: tuple[Keyframe, ...]
    poses: Float64s
    sure: Bools
    node: int


def newer(drawing: Drawing, graph: Graph, keyframes: Sequence[Keyframe], gaps: frozenset[tuple[int, int]]) -> Drawing:
    """A finished drawing, to go on with the keyframes that came meanwhile. keyframes: (n,) of the graph's nodes.

    First those of the parts that are joined to the rest; then those of others that are long enough.
    gaps: edges (i, j) that are odometry's alone.
    """
    first, n = int(np.searchsorted(graph.nodes, drawing.node, side="right")), len(keyframes)
    joined = joined_nodes(graph, gaps) if gaps else np.ones(n, np.bool_)
    rows = np.arange(first, n)
    long = _in_long_parts(graph, gaps)
    rows = np.concatenate((rows[joined[first:]], rows[~joined[first:] & long[first:]]))
    chosen = tuple(keyframes[row] for row in rows.tolist())
    return Drawing(drawing.grid, chosen, graph.poses[rows].copy(), joined[rows], int(graph.nodes[-1]))


def _in_long_parts(graph: Graph, gaps: frozenset[tuple[int, int]]) -> Bools:
    """(n,) which nodes are of a part that has enough of them to be drawn."""
    starts = np.searchsorted(graph.nodes, sorted(j for _, j in gaps))
    part = np.searchsorted(starts, np.arange(len(graph.nodes)), side="right")
    return np.asarray(np.bincount(part)[part] >= MIN_KEYFRAMES)


def drawn(drawing: Drawing) -> Drawing:
    """The drawing with the next slice of its keyframes in it. Its grid is handed on: who ordered it looks no more."""
    rows = drawing.poses[:SLICE].tolist()
    for keyframe, row, sure in zip(drawing.keyframes[:SLICE], rows, drawing.sure[:SLICE].tolist()):
        pose = Pose2(*row)
        if sure or fits(drawing.grid, pose @ keyframe.origins.astype(float), pose @ keyframe.ends.astype(float)):
            keyframe.draw(drawing.grid, pose)
    if len(drawing.keyframes) <= SLICE:
        drawing.grid.settle()
    return Drawing(drawing.grid, drawing.keyframes[SLICE:], drawing.poses[SLICE:], drawing.sure[SLICE:], drawing.node)
