# SPDX-License-Identifier: Apache-2.0
"""The submap for the next scans: the keyframes near the robot whose relative pose is certain.

With the last metres alone, scan matching drifts as odometry does, only slower. With the whole map, a robot that returns
matches walls that lie half a metre beside the right ones, and distorts the map. The local map is between the two.
It holds keyframes whose standard deviation, relative to the newest one, is below a gate. Keyframes from long ago drop
out, and return when a closure makes their relative pose certain.

This choice of keyframes is our own. It is derived from Cartographer's submap (Hess et al., ICRA 2016, section IV-B),
which holds the newest scans instead.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from services.mapper.back_end.keyframe import NO_COVARIANCE, Keyframe
from services.mapper.back_end.pose_graph import Graph, pose_of
from services.mapper.back_end.relative_covariance import relative_covariances
from services.mapper.front_end.registration import RegistrationConfig
from services.mapper.front_end.submap import Submap
from services.mapper.grid.occupancy import OccupancyConfig
from shared.geometry import Pose2, wrapped_all
from shared.types import Bools, Float64s, Int64s

PLACE_SIZE = np.array((1.0, 1.0, 0.5))
"""m, m, rad: cell of (x, y, yaw) from which one keyframe is enough."""
MARGIN_M = 6.0  # about the path length between two builds


@dataclass(frozen=True, slots=True)
class LocalMapContent:
    """Names of the nodes (k,) that a submap holds; it also holds all nodes after `newest`."""

    nodes: Int64s
    newest: int


@dataclass(frozen=True, slots=True)
class LocalMap:
    """A submap in `local`; None where the present one is still right.

    content: of the submap that is right; `newest` is the newest node when it was built.
    session: name of the first node whose pose is in this `local`.
    """

    submap: Submap | None
    content: LocalMapContent
    session: int


def build_local_map(
    graph: Graph,
    keyframes: Sequence[Keyframe],
    local_from_map: Pose2,
    session: int,
    last_optimized: int,
    max_sigma: float,
    radius: float,
    content: LocalMapContent | None,
    settings: tuple[RegistrationConfig, OccupancyConfig, float],
) -> LocalMap:
    """Builds the local map about the newest keyframe, with one keyframe of each place.

    keyframes: (n,) of the graph's nodes.  local_from_map: keeps the newest keyframe's pose in `local`.
    last_optimized: name of the last node that was optimized; later ones keep their covariance.
    max_sigma: maximum standard deviation relative to the newest keyframe, m.
    radius: m, within which no place may be missing; a new local map reaches MARGIN_M farther.
    content: of the present submap; None if its keyframes have moved.
    settings: of the new submap; the number is `range_max` of the laser, m.
    """
    newest = int(graph.nodes[-1])
    covariances = relative_covariances(graph, newest)
    sigma = np.sqrt(np.maximum(covariances[:, 0, 0], covariances[:, 1, 1]))
    distance = np.hypot(*(graph.poses[:, :2] - graph.poses[-1, :2]).T)
    certain, nodes = sigma < max_sigma, graph.nodes
    wanted = certain & (distance < radius + MARGIN_M)
    if content is not None:
        present = np.isin(nodes, content.nodes) | (nodes > content.newest)
        missing = certain & ~present & (distance < radius)
        missing[missing] = ~_is_near_any(graph.poses[missing], graph.poses[present])
        uncertain = present & ~certain & (distance < radius + MARGIN_M)
        if not (missing | uncertain).any():
            return LocalMap(None, LocalMapContent(nodes[present], newest), session)
    first = np.unique(_place_numbers(graph.poses[wanted]), return_index=True)[1]
    rows = np.sort(np.flatnonzero(wanted)[first])
    submap = Submap(*settings)
    for row in rows.tolist():
        keyframe, pose = keyframes[row], local_from_map @ pose_of(graph.poses[row])
        submap.add_keyframe(keyframe, pose)
        submap.set_uncertainty(
            pose, keyframe.covariance if graph.nodes[row] > last_optimized else NO_COVARIANCE, keyframe.stamp
        )
    submap.remove_crossed_points()
    return LocalMap(submap, LocalMapContent(nodes[rows], newest), session)


def _place_numbers(poses: Float64s) -> Int64s:
    """(n,) number of the place of each pose (n, 3)."""
    _, places = np.unique(np.floor(poses / PLACE_SIZE), axis=0, return_inverse=True)
    return np.asarray(places, np.int64)


def _is_near_any(poses: Float64s, others: Float64s) -> Bools:
    """(n,) whether a pose (n, 3) is within two place sizes of one of the others (k, 3), as corrections move them."""
    difference = poses[:, None] - others[None]
    difference[..., 2] = wrapped_all(difference[..., 2])
    near = np.logical_and.reduce(np.abs(difference) < 2 * PLACE_SIZE, axis=2)
    return np.asarray(np.logical_or.reduce(near, axis=1))
