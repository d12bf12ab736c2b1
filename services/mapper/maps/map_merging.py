# SPDX-License-Identifier: Apache-2.0
"""One map from two of one building: their pose graphs are joined by loop closures and optimized together.

`map_overlap` gives the transform. Keyframes of the second map are then matched with submaps of the first, and the
robust kernel rejects the closures that contradict the others. At last few of the second map's scans may contradict
the first map.

The joint by loop closures is that of Cartographer's multiple trajectories (Hess et al., ICRA 2016, section V). The last
check is our own.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from services.mapper.back_end.keyframe import Keyframe
from services.mapper.back_end.loop_closure import Constraint, SubmapCache, match_loop_closure
from services.mapper.back_end.map_parts import fits_grid
from services.mapper.back_end.pose_graph import Graph, PoseGraph, compose, pose_of
from services.mapper.back_end.solver.optimize import optimize
from services.mapper.config import MapperConfig
from services.mapper.grid.edit_cells import edits_problem
from services.mapper.grid.map_drawing import Drawing, draw_slice
from services.mapper.grid.map_edits import MapEdits
from services.mapper.grid.occupancy import Occupancy
from services.mapper.maps.map_file import SavedMap
from services.mapper.maps.map_overlap import Overlap, find_overlap
from shared.config import UserError
from shared.geometry import Pose2
from shared.messages import MapEdit
from shared.types import Float64s

CLOSURE_STEP_M = 0.5  # driven between two keyframes that are searched for closures
CLOSURE_SIGMA_M, CLOSURE_SIGMA_RAD = 0.5, 0.08  # standard deviations of the transform
CLOSURE_ROUNDS = 2  # the second one begins at the first one's optimum
MIN_CLOSURES = 6  # between both maps
MIN_ACCEPTED_RATIO = 0.7  # of these closures, after optimization
MAX_MISFITS = 0.05  # share of the second map's scans that may contradict the first map


@dataclass(frozen=True, slots=True)
class MergedMap:
    """One map from two, in the first one's frame.

    overlap: of the second map with the first.  first_from_second: after optimization, by the second map's last node.
    n_closures: between both maps, that were accepted.
    """

    saved: SavedMap
    overlap: Overlap
    first_from_second: Pose2
    n_closures: int


def merge_maps(first: SavedMap, second: SavedMap, config: MapperConfig, range_max: float) -> MergedMap:
    """Returns both maps as one.

    range_max: m, of the laser.  Raises UserError where it is not certain how the second map lies on the first.
    """
    overlap = find_overlap(first, second, config, range_max)
    graph = joined_graph(first.graph, second.graph, overlap.first_from_second, config.loop_closure.block_size)
    pair = _Pair(graph, (*first.keyframes, *second.keyframes), len(first.keyframes))
    graph, n_closures = _optimized(pair, second.driven, config, range_max)
    grid = _drawn(replace(pair, graph=graph), config)
    edits = _edits(first, second, graph)
    jump = config.loop_closure.min_path_between + 2 * config.loop_closure.view_radius
    driven = np.concatenate((first.driven, second.driven + (first.driven[-1] + jump)))
    saved = SavedMap(graph, pair.keyframes, driven, grid.tiles_without_edits(0), edits)
    shift = pose_of(graph.poses[-1]) @ pose_of(second.graph.poses[-1]).inverse()
    return MergedMap(saved, overlap, shift, n_closures)


def joined_graph(first: Graph, second: Graph, first_from_second: Pose2, block_size: int) -> Graph:
    """Returns a graph of both, not yet connected: the second moved rigidly, with names after those of the first.

    block_size: keyframes that share a cached submap; no submap then has keyframes of both.
    """
    last_edge = int(first.edges[-1]) + 1 if len(first.edges) else 0
    offset = (int(first.nodes[-1]) // block_size + 4) * block_size
    row = np.array((first_from_second.x, first_from_second.y, first_from_second.yaw))
    return Graph(
        nodes=np.concatenate((first.nodes, second.nodes + offset)),
        poses=np.concatenate((first.poses, compose(row, second.poses))),
        fixed=np.concatenate((first.fixed, np.zeros(len(second.nodes), np.bool_))),
        edges=np.concatenate((first.edges, second.edges + last_edge)),
        i=np.concatenate((first.i, second.i + offset)),
        j=np.concatenate((first.j, second.j + offset)),
        relative=np.concatenate((first.relative, second.relative)),
        information=np.concatenate((first.information, second.information)),
        loop=np.concatenate((first.loop, second.loop)),
        on=np.concatenate((first.on, second.on)),
    )


@dataclass(frozen=True, slots=True)
class _Pair:
    """Both maps' graph and keyframes; those of the first map come first."""

    graph: Graph
    keyframes: tuple[Keyframe, ...]
    n_first: int


def _optimized(pair: _Pair, driven: Float64s, config: MapperConfig, range_max: float) -> tuple[Graph, int]:
    """Returns the graph with closures between both maps at its optimum, and how many of them it accepts.

    driven: of the second map.  Raises UserError where too few are found, or too many contradict the others.
    """
    submaps = SubmapCache(config.registration, config.occupancy, range_max, config.loop_closure)
    steps = np.floor(driven / CLOSURE_STEP_M)
    due = (pair.n_first + np.flatnonzero(np.diff(steps, prepend=steps[0] - 1))).tolist()
    joined, n_accepted = PoseGraph.of(pair.graph), 0
    for _ in range(CLOSURE_ROUNDS):
        placed = replace(pair, graph=replace(pair.graph, poses=joined.poses.copy()))
        closures = _closures(placed, due, submaps, config)
        joined = PoseGraph.of(placed.graph)
        for closure in closures:
            joined.add_edge(closure.i, closure.j, closure.i_from_j, closure.information, loop=True)
        optimum = optimize(joined.snapshot(), config.pose_graph)
        n_accepted = int(optimum.on[len(pair.graph.edges) :].sum())
        if len(closures) < MIN_CLOSURES or n_accepted < MIN_ACCEPTED_RATIO * len(closures):
            raise UserError(
                f"only {n_accepted} of {len(closures)} matches between both maps agree",
                "drive more of what the maps share, and save again",
            )
        joined.apply(optimum)
    return joined.snapshot(), n_accepted


def _closures(pair: _Pair, rows: Sequence[int], submaps: SubmapCache, config: MapperConfig) -> list[Constraint]:
    """Returns closures of the second map's keyframes in these rows, each with the nearest place of the first map."""
    covariance = np.diag((CLOSURE_SIGMA_M**2, CLOSURE_SIGMA_M**2, CLOSURE_SIGMA_RAD**2))
    poses, found = pair.graph.poses, []
    for row in rows:
        distance = np.hypot(*(poses[: pair.n_first, :2] - poses[row, :2]).T)
        nearest = int(np.argmin(distance))
        if distance[nearest] <= config.loop_closure.view_radius:
            arguments = pair.graph, pair.keyframes, nearest, row, covariance, submaps, config.loop_closure
            found.append(match_loop_closure(*arguments))
    return [closure for closure in found if closure is not None]


def _drawn(pair: _Pair, config: MapperConfig) -> Occupancy:
    """Returns the grid of all keyframes. Raises UserError where the second map's scans contradict the first map."""
    n, poses = pair.n_first, pair.graph.poses
    grid = Occupancy(config.occupancy, 0)
    _draw(grid, pair.keyframes[:n], poses[:n])
    fits = [_fits(grid, keyframe, row) for keyframe, row in zip(pair.keyframes[n:], poses[n:], strict=True)]
    misfits = 1 - float(np.mean(fits))
    if misfits > MAX_MISFITS:
        raise UserError(
            f"{misfits:.0%} of its scans contradict the first map where it was found",
            "another building, another floor of it, or was much furniture moved?",
        )
    _draw(grid, pair.keyframes[n:], poses[n:])
    return grid


def _fits(grid: Occupancy, keyframe: Keyframe, row: Float64s) -> bool:
    pose = pose_of(row)
    return fits_grid(grid, pose @ keyframe.origins.astype(np.float64), pose @ keyframe.ends.astype(np.float64))


def _draw(grid: Occupancy, keyframes: Sequence[Keyframe], poses: Float64s) -> None:
    drawing = Drawing(grid, tuple(keyframes), poses, np.ones(len(keyframes), np.bool_), -1)
    while drawing.keyframes:
        drawing = draw_slice(drawing)


def _edits(first: SavedMap, second: SavedMap, graph: Graph) -> tuple[MapEdit, ...]:
    """Returns the edits of both maps, each moved with its nearest keyframe. Raises UserError for too many."""
    n = len(first.keyframes)
    moved = []
    for saved, rows in ((first, slice(n)), (second, slice(n, None))):
        edits = MapEdits(saved.edits)
        edits.anchor(graph.nodes[rows], saved.graph.poses)
        edits.follow(graph.nodes[rows], graph.poses[rows])
        moved.append(edits)
    moved[0].add(moved[1].edits)
    problem = edits_problem(moved[0].edits)
    if problem is not None:
        raise UserError(problem, "undo some of the edits first: zenav map undo --map NAME")
    return moved[0].edits
