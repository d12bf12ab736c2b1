# SPDX-License-Identifier: Apache-2.0
"""Drawing of the map from its keyframes, one slice a job: first joined parts, then parts that must fit them.

As in Karto (`OccupancyGrid::CreateFromScans`), the grid is drawn again from all scans at their corrected poses. The
slices, and the test of parts that are not joined, are our own.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from services.mapper.back_end.keyframe import Keyframe
from services.mapper.back_end.map_parts import MIN_KEYFRAMES, fits_grid, joined_nodes
from services.mapper.back_end.pose_graph import Graph
from services.mapper.grid.occupancy import Occupancy
from shared.geometry import Pose2
from shared.types import Bools, Float64s

SLICE_KEYFRAMES = 100  # of one job, 0.2 s; searches for loop closures run in between


@dataclass(frozen=True, slots=True)
class Drawing:
    """A grid, and the keyframes that are still to be drawn into it, at poses (n, 3) x, y m and yaw rad in `map`.

    joined: (n,) bool, of a part that is joined to the rest; another keyframe is drawn only if it fits the grid.
    last_node: the newest node in the grid or among the keyframes; -1 without any.
    """

    grid: Occupancy
    keyframes: tuple[Keyframe, ...]
    poses: Float64s
    joined: Bools
    last_node: int


def continue_drawing(
    drawing: Drawing, graph: Graph, keyframes: Sequence[Keyframe], gaps: frozenset[tuple[int, int]]
) -> Drawing:
    """A finished drawing with the keyframes that are newer than it: first those of joined parts, then of long ones.

    keyframes: (n,) of the graph's nodes.  gaps: edges (i, j) that only odometry measured.
    """
    first, n = int(np.searchsorted(graph.nodes, drawing.last_node, side="right")), len(keyframes)
    joined = joined_nodes(graph, gaps) if gaps else np.ones(n, np.bool_)
    rows = np.arange(first, n)
    long = _in_long_parts(graph, gaps)
    rows = np.concatenate((rows[joined[first:]], rows[~joined[first:] & long[first:]]))
    chosen = tuple(keyframes[row] for row in rows.tolist())
    return Drawing(drawing.grid, chosen, graph.poses[rows].copy(), joined[rows], int(graph.nodes[-1]))


def _in_long_parts(graph: Graph, gaps: frozenset[tuple[int, int]]) -> Bools:
    """(n,) bool: which nodes belong to a part with enough keyframes to be drawn."""
    starts = np.searchsorted(graph.nodes, sorted(j for _, j in gaps))
    part = np.searchsorted(starts, np.arange(len(graph.nodes)), side="right")
    return np.asarray(np.bincount(part)[part] >= MIN_KEYFRAMES)


def draw_slice(drawing: Drawing) -> Drawing:
    """The drawing after the next slice of its keyframes. The grid is the same object: the former drawing is void."""
    rows = drawing.poses[:SLICE_KEYFRAMES].tolist()
    for keyframe, row, joined in zip(
        drawing.keyframes[:SLICE_KEYFRAMES], rows, drawing.joined[:SLICE_KEYFRAMES].tolist()
    ):
        pose = Pose2(*row)
        if joined or fits_grid(drawing.grid, pose @ keyframe.origins.astype(float), pose @ keyframe.ends.astype(float)):
            keyframe.draw(drawing.grid, pose)
    if len(drawing.keyframes) <= SLICE_KEYFRAMES:
        drawing.grid.update_cells()
    return Drawing(
        drawing.grid,
        drawing.keyframes[SLICE_KEYFRAMES:],
        drawing.poses[SLICE_KEYFRAMES:],
        drawing.joined[SLICE_KEYFRAMES:],
        drawing.last_node,
    )
