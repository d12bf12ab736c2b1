# SPDX-License-Identifier: Apache-2.0
"""What the next scans are matched with: all that the graph knows well from where the robot is now.

Matched with the last metres alone, the pose walks off as odometry does, only slower; matched with the whole map, a
robot that comes back from far snaps to walls that lie half a metre beside those it should see, and tears the map.
Between the two: keyframes whose places are known, as seen from the newest one, better than a gate of some centimetres.
What was left long ago drops out, and comes back when a closure ties it to the robot again.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from services.mapper.keyframe import SETTLED, Keyframe
from services.mapper.occupancy import OccupancyConfig
from services.mapper.pose_graph import Graph, Int64s, pose_of
from services.mapper.registration import RegistrationConfig
from services.mapper.submap import Submap
from services.mapper.uncertainty import uncertainty_from
from shared.geometry import Bools, Float64s, Pose2, wrapped_all

SAME = np.array((1.0, 1.0, 0.5))  # m, m, rad: of two keyframes so near, one tells enough
BETWEEN = 6.0  # m that the robot drives, about, until they are gathered anew


@dataclass(frozen=True, slots=True)
class Held:
    """What a submap is drawn from: the nodes of these names (k,), and all that are newer than `node`."""

    nodes: Int64s
    node: int


@dataclass(frozen=True, slots=True)
class Surroundings:
    """A submap in `local`; None where the one at hand still holds what it must, and nothing that it must not.

    held: what it holds, `node` being the newest that was known then.  session: the name of the first node in that
    `local`.
    """

    submap: Submap | None
    held: Held
    session: int


def surroundings(
    graph: Graph,
    keyframes: Sequence[Keyframe],
    local_from_map: Pose2,
    session: int,
    settled: int,
    sure: float,
    near: float,
    held: Held | None,
    settings: tuple[RegistrationConfig, OccupancyConfig, float],
) -> Surroundings:
    """Draws them around the newest keyframe: what is known better than `sure` m from there, from each place once.

    near: m, up to where nothing may be missing; where they are drawn, they reach BETWEEN farther.
    local_from_map: such that the newest keyframe keeps its place in `local`.  settled: name of the last node that was
    optimised.  held: what the submap at hand holds, where that lies as it should.
    """
    newest = int(graph.nodes[-1])
    covariances = uncertainty_from(graph, newest)
    sigma = np.sqrt(np.maximum(covariances[:, 0, 0], covariances[:, 1, 1]))
    away = np.hypot(*(graph.poses[:, :2] - graph.poses[-1, :2]).T)
    known, nodes = sigma < sure, graph.nodes
    wanted = known & (away < near + BETWEEN)
    if held is not None:
        there = np.isin(nodes, held.nodes) | (nodes > held.node)
        lacks = known & ~there & (away < near)
        lacks[lacks] = ~_near_one_of(graph.poses[lacks], graph.poses[there])
        holds_wrong = there & ~known & (away < near + BETWEEN)
        if not (lacks | holds_wrong).any():
            return Surroundings(None, Held(nodes[there], newest), session)
    first = np.unique(_places(graph.poses[wanted]), return_index=True)[1]
    wanted = np.sort(np.flatnonzero(wanted)[first])
    submap = Submap(*settings)
    for row in wanted.tolist():
        keyframe, pose = keyframes[row], local_from_map @ pose_of(graph.poses[row])
        submap.take(keyframe, pose)
        submap.sign(pose, keyframe.doubt if graph.nodes[row] > settled else SETTLED, keyframe.stamp)
    submap.forget()
    return Surroundings(submap, Held(nodes[wanted], newest), session)


def _places(poses: Float64s) -> Int64s:
    """(n,) numbers of the places where poses (n, 3) are."""
    _, places = np.unique(np.floor(poses / SAME), axis=0, return_inverse=True)
    return np.asarray(places, np.int64)


def _near_one_of(poses: Float64s, others: Float64s) -> Bools:
    """Which poses (n, 3) are at the place of one of the others (k, 3), or beside it: corrections move them."""
    off = poses[:, None] - others[None]
    off[..., 2] = wrapped_all(off[..., 2])
    beside = np.logical_and.reduce(np.abs(off) < 2 * SAME, axis=2)
    return np.asarray(np.logical_or.reduce(beside, axis=1))
