# SPDX-License-Identifier: Apache-2.0
"""Parts: sections of the map that only odometry joins to the rest, and the closures that join them.

Where scans stop fitting while mapping, the robot goes on by odometry in a new part. One closure to the rest may be
wrong, as corridors look alike. So a part is joined by several closures that put the robot at one place. This is
pairwise consistent measurement set maximization with one unknown for the whole part (Mangelson et al., ICRA 2018).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import hypot

import numpy as np

from services.mapper.back_end.loop_closure import Constraint
from services.mapper.back_end.pose_graph import Graph, PoseGraph
from services.mapper.back_end.solver.optimize import connected_components
from services.mapper.grid.occupancy import Occupancy
from services.mapper.localization.kidnap_detection import map_agreement
from shared.geometry import Pose2, wrapped
from shared.messages import Localization
from shared.types import Bools, Float64s

MAX_SAME_PLACE_M, MAX_SAME_PLACE_RAD = 0.3, 0.1  # difference of two closures that put the robot at one place
MIN_JOINTS = 3  # closures that agree, where odometry agrees with them too
MIN_FAR_JOINTS = 6  # the same where odometry contradicts them
MAX_CONTRADICTING_RATIO = 0.5  # closures that disagree with a joint, as a share of those that agree
MIN_GAP_SIGMA_M, MIN_GAP_SIGMA_RAD = 0.3, 0.15  # standard deviations of the motion to a new part
GAP_SIGMA_PER_M = 0.15  # m per m driven without a scan that fits
GAP_SIGMA_PER_RAD = 0.05  # rad per rad
GAP_SIGMA_RAD_PER_M = 0.03
MIN_KEYFRAMES = 8  # of a part that is drawn before it is joined
MIN_FIT = 0.75  # `map_agreement` of a scan that is drawn before its part is joined


@dataclass(frozen=True, slots=True)
class OdometryGap:
    """A motion from the newest keyframe that only odometry measured.

    path, turn: driven without a scan that fits, m and rad.
    """

    motion: Pose2
    path: float
    turn: float


def gap_sigmas(path: float, turn: float) -> tuple[float, float]:
    """Returns standard deviations, m and rad, of a motion by odometry alone over a path (m) and a turn (rad)."""
    sigma_turn = MIN_GAP_SIGMA_RAD + GAP_SIGMA_PER_RAD * turn + GAP_SIGMA_RAD_PER_M * path
    return MIN_GAP_SIGMA_M + GAP_SIGMA_PER_M * path, sigma_turn


def gap_information(path: float, turn: float) -> Float64s:
    """Returns the information (3, 3) of (x, y, yaw) of a motion by odometry alone over a path (m) and a turn (rad)."""
    sigma, sigma_turn = gap_sigmas(path, turn)
    return np.diag((sigma**-2, sigma**-2, sigma_turn**-2))


def certainty_in_part(
    gap: OdometryGap, n_keyframes: int, fit: float, covariance: Float64s, state: Localization
) -> tuple[Float64s, Localization]:
    """Returns covariance (3, 3) and state of the pose on the map in a part that only odometry joins to the rest.

    fit: share of the last scans that fit the map.  covariance, state: within the part.
    """
    is_found = n_keyframes >= MIN_KEYFRAMES and fit >= MIN_FIT and state is not Localization.LOST
    covariance = covariance + np.linalg.inv(gap_information(gap.path, gap.turn))
    return covariance, Localization.POOR if is_found else Localization.LOST


def largest_consistent_group(poses: Sequence[Pose2]) -> list[int]:
    """Returns the indices of the largest group of poses near one of them; of equal groups, the earliest."""
    groups = [[k for k, b in enumerate(poses) if _is_same_place(a, b)] for a in poses]
    return max(groups, key=len, default=[])


def is_joint(n_agreeing: int, n_others: int, expected: bool) -> bool:
    """Whether the number of agreeing closures is enough.  expected: odometry agrees with them."""
    min_agreeing = MIN_JOINTS if expected else MIN_FAR_JOINTS
    return n_agreeing >= min_agreeing and n_others <= MAX_CONTRADICTING_RATIO * n_agreeing


def find_joint(
    graph: PoseGraph, closures: Sequence[Constraint], newest: Pose2, gap: OdometryGap
) -> tuple[Pose2, list[Constraint]] | None:
    """Returns the pose of a part's newest node by closures that agree, and these closures; None until enough agree.

    newest: present pose of that node in `map`.  gap: the motion to the part.
    """
    poses = [graph.pose(c.i) @ c.i_from_j @ (graph.pose(c.j).inverse() @ newest) for c in closures]
    group = largest_consistent_group(poses)
    if not group:
        return None
    pose = poses[group[len(group) // 2]]
    if not is_joint(len(group), len(poses) - len(group), is_expected(newest, pose, gap.path, gap.turn)):
        return None
    return pose, [closures[k] for k in group]


def is_expected(expected: Pose2, pose: Pose2, path: float, turn: float) -> bool:
    """Whether a pose is within three standard deviations of odometry's pose, after a path (m) and a turn (rad)."""
    sigma, sigma_turn = gap_sigmas(path, turn)
    return expected.distance(pose) <= 3 * sigma and abs(wrapped(expected.yaw - pose.yaw)) <= 3 * sigma_turn


def fits_grid(grid: Occupancy, origins: Float64s, ends: Float64s) -> bool:
    """Whether a scan does not contradict a grid; a scan of unknown space fits.

    origins, ends: (n, 2) m in the grid's frame, ends NaN without an echo.
    """
    agreement = map_agreement(grid, origins, ends)
    return agreement is None or agreement >= MIN_FIT


def _is_same_place(a: Pose2, b: Pose2) -> bool:
    return hypot(a.x - b.x, a.y - b.y) <= MAX_SAME_PLACE_M and abs(wrapped(a.yaw - b.yaw)) <= MAX_SAME_PLACE_RAD


def joined_nodes(graph: Graph, gaps: frozenset[tuple[int, int]]) -> Bools:
    """Returns (n,) whether accepted edges join each node to the first one.  gaps: edges (i, j) of odometry alone."""
    i, j = graph.rows()
    is_measured = np.array([(a, b) not in gaps for a, b in zip(graph.i.tolist(), graph.j.tolist())], np.bool_)
    used = graph.on & is_measured
    component = connected_components(len(graph.nodes), i[used], j[used])
    return np.asarray(component == 0)
