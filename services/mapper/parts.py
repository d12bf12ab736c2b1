# SPDX-License-Identifier: Apache-2.0
"""A part of the map that only odometry joins to the rest: when closures have shown where it lies.

Where scans stop fitting while mapping, the robot goes on by odometry in a new part. One closure to the rest may be
wrong: a corridor looks like the next. Several along a way driven that put the robot at one place are a joint, as in
pairwise consistent measurement set maximization (Mangelson et al., ICRA 2018), with one unknown for the whole part.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot

import numpy as np

from services.mapper.astray import agreement
from services.mapper.loop_closure import Loop
from services.mapper.occupancy import Occupancy
from services.mapper.optimisation import connected
from services.mapper.pose_graph import Graph, PoseGraph
from shared.geometry import Bools, Float64s, Pose2, wrapped

SAME, SAME_TURN = 0.3, 0.1  # m, rad: within these, two closures put the robot at one place
MIN_JOINTS = 3  # closures that agree, where odometry agrees with them too
MIN_FAR_JOINTS = 6  # the same where odometry says that the robot is elsewhere
OUTVOTED = 0.5  # closures that disagree, as a share of those that agree, up to which a joint is believed
GAP_SIGMA, GAP_SIGMA_TURN = 0.3, 0.15  # m, rad, standard deviations of the motion to a new part at least
GAP_SHARE = 0.15  # m per m driven without a scan that fits
GAP_SHARE_TURN = 0.05  # rad per rad
GAP_TURN_PER_M = 0.03  # rad
MIN_KEYFRAMES = 8  # of a part that is drawn before it is joined
FITS = 0.75  # `agreement` of a scan that is drawn before its part is joined


@dataclass(frozen=True, slots=True)
class Gap:
    """A motion that only odometry tells of: from the newest keyframe on, over so many m and rad without a scan that
    fits."""

    motion: Pose2
    path: float
    turn: float


def gap_sigmas(path: float, turn: float) -> tuple[float, float]:
    """m and rad, standard deviations of a motion by odometry alone, over so many m and rad."""
    return GAP_SIGMA + GAP_SHARE * path, GAP_SIGMA_TURN + GAP_SHARE_TURN * turn + GAP_TURN_PER_M * path


def gap_information(path: float, turn: float) -> Float64s:
    """(3, 3) of (x, y, yaw): what odometry alone tells of such a motion."""
    sigma, sigma_turn = gap_sigmas(path, turn)
    return np.diag((sigma**-2, sigma**-2, sigma_turn**-2))


def agreeing(places: Sequence[Pose2]) -> list[int]:
    """Indices of the largest group of poses that are one place with one of them; the earliest of equal ones."""
    groups = [[k for k, b in enumerate(places) if _same(a, b)] for a in places]
    return max(groups, key=len, default=[])


def is_joint(n_agreeing: int, n_others: int, expected: bool) -> bool:
    """Whether so many closures that agree show where a part lies. expected: odometry puts the robot there too."""
    return n_agreeing >= (MIN_JOINTS if expected else MIN_FAR_JOINTS) and n_others <= OUTVOTED * n_agreeing


def joint_of(graph: PoseGraph, joints: Sequence[Loop], newest: Pose2, gap: Gap) -> tuple[Pose2, list[Loop]] | None:
    """Where closures put a part, as the place of its newest node, and those that agree on it; None until enough do.

    newest: where that node is now.  gap: the motion that led to the part.
    """
    places = [graph.pose(loop.i) @ loop.i_from_j @ (graph.pose(loop.j).inverse() @ newest) for loop in joints]
    chosen = agreeing(places)
    if not chosen:
        return None
    found = places[chosen[len(chosen) // 2]]
    expected = is_expected(newest, found, gap.path, gap.turn)
    if not is_joint(len(chosen), len(places) - len(chosen), expected):
        return None
    return found, [joints[k] for k in chosen]


def is_expected(expected: Pose2, found: Pose2, path: float, turn: float) -> bool:
    """Whether a place is where odometry leads, within three standard deviations, after so many m and rad."""
    sigma, sigma_turn = gap_sigmas(path, turn)
    return expected.distance(found) <= 3 * sigma and abs(wrapped(expected.yaw - found.yaw)) <= 3 * sigma_turn


def fits(grid: Occupancy, origins: Float64s, ends: Float64s) -> bool:
    """Whether nothing in a grid speaks against a scan, beams as for `agreement`: they agree, or see what is new."""
    agreed = agreement(grid, origins, ends)
    return agreed is None or agreed >= FITS


def _same(a: Pose2, b: Pose2) -> bool:
    return hypot(a.x - b.x, a.y - b.y) <= SAME and abs(wrapped(a.yaw - b.yaw)) <= SAME_TURN


def joined_nodes(graph: Graph, gaps: frozenset[tuple[int, int]]) -> Bools:
    """(n,) which nodes believed edges join to the first one. gaps: edges (i, j) that are odometry's alone."""
    i, j = graph.rows()
    measured = np.array([(a, b) not in gaps for a, b in zip(graph.i.tolist(), graph.j.tolist())], np.bool_)
    used = graph.on & measured
    part = connected(len(graph.nodes), i[used], j[used])
    return np.asarray(part == 0)
