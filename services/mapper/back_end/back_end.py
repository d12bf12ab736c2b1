# SPDX-License-Identifier: Apache-2.0
"""Keyframes and their pose graph: constraints between them, corrections of `map_from_local`, and parts of the map.

After Cartographer's global SLAM: Hess et al., "Real-time loop closure in 2D lidar SLAM", ICRA 2016, section V.
"""

from collections.abc import Sequence
from math import hypot
from typing import Any

import numpy as np

from services.mapper.back_end.config import BackEndConfig
from services.mapper.back_end.constraint_search import ConstraintSearch
from services.mapper.back_end.far_closures import FarClosures, FarSearch
from services.mapper.back_end.keyframe import NO_COVARIANCE, Keyframe, mean_map_from_local
from services.mapper.back_end.keyframe_pruning import redundant_keyframe
from services.mapper.back_end.local_map import MARGIN_M, LocalMap, LocalMapContent
from services.mapper.back_end.loop_closure import (
    Constraint,
    LoopClosureConfig,
    SubmapCache,
    existing,
    information_in_own_frame,
)
from services.mapper.back_end.map_parts import OdometryGap, find_joint, gap_information, joined_nodes
from services.mapper.back_end.pose_graph import Graph, OptimizationResult, PoseGraph, fixed_graph
from services.mapper.back_end.solver.optimize import PoseGraphConfig
from services.mapper.front_end.odometry_error import OdometryError
from services.mapper.front_end.registration import Match, RegistrationConfig
from services.mapper.front_end.slip import widen_where_doubtful
from services.mapper.front_end.submap import Submap
from services.mapper.grid.map_drawing import Drawing, continue_drawing
from services.mapper.grid.occupancy import Occupancy, OccupancyConfig
from services.mapper.maps.map_file import SavedMap
from shared.geometry import Pose2

MIN_VISIBLE_SHIFT_M = 0.02  # a correction that shows on the map
N_ANCHORS = 10  # keyframes that determine map_from_local together
N_CONFIRMING = 7  # more closures than these since the last optimization, all consistent, confirm the graph
FOUND_INFORMATION = np.diag((0.1**-2, 0.1**-2, 0.03**-2))
"""Information of a pose from global localization; weak, as closures measure the pose better."""


PendingKeyframe = tuple[Keyframe, Match, float]
"""Arguments of `BackEnd.add_keyframe` without the odometry: keyframe, match, odometry_scale."""


class BackEnd:
    """Keyframes and their pose graph. `map_from_local` is the present pose of the front end's frame on the map.

    A session is a run of keyframes in one frame `local`. A part is a session that only odometry joins to the rest.
    range_max: m, of the laser.
    """

    def __init__(
        self,
        config: BackEndConfig,
        closure_config: LoopClosureConfig,
        graph_config: PoseGraphConfig,
        registration: RegistrationConfig,
        occupancy: OccupancyConfig,
        range_max: float,
    ) -> None:
        self.config, self.closure_config, self.graph_config = config, closure_config, graph_config
        self._settings = registration, occupancy, range_max
        self.reset()

    def reset(self) -> None:
        """Begins an empty map."""
        self.graph = PoseGraph()
        self.keyframes: list[Keyframe] = []
        self.driven: list[float] = []  # m, path length up to each keyframe
        self.map_from_local = Pose2()
        self.submaps = SubmapCache(*self._settings, self.closure_config)
        self.is_fixed = False  # localization on a map that does not change
        self.edit_nodes: frozenset[int] = frozenset()  # names of the nodes that edits of the map are anchored to
        self.first_node = 0  # name of the first node of this session
        self.first_new_node = 0  # name of the first node that is not from a saved map
        # constraints
        self.search = ConstraintSearch()
        self.closed_at = 0.0  # m driven, at the last closure
        self.n_loops = 0
        self.n_pending_closures = 0  # since the last optimization
        self.n_pending_pairwise = 0
        self.is_inconsistent = False  # a pending closure moves the graph visibly
        self.is_confirmed = False  # many pending closures, and all agree with the graph
        # effects of corrections
        self.map_shift = 0.0  # m, upper bound of any keyframe's motion since the map was drawn
        self.local_shift = 0.0  # m, the same near the robot, relative to the newest, since the local map was built
        self.n_since_local_map = 0  # keyframes
        self.content: LocalMapContent | None = None  # of the front end's submap, if it was built here
        self.optimizes_closures = False  # the running optimization holds closures
        self.last_optimized = -1  # name of the newest node at the last optimum with new closures
        # parts
        self.gap: OdometryGap | None = None  # to the first keyframe of a part that has none yet
        self.gap_edges: frozenset[tuple[int, int]] = frozenset()  # measured by odometry alone
        self.part_gap = OdometryGap(Pose2(), 0.0, 0.0)  # to the present part
        self.is_joined = True  # closures join the present part to the rest
        self.joint_candidates: list[Constraint] = []  # closures of an unjoined part to earlier nodes
        self.n_joints = 0  # parts that were joined

    def load(self, saved: SavedMap, fixed: bool) -> None:
        """Loads a saved map, and begins a session on it.  fixed: the map does not change."""
        self.reset()
        self.graph = PoseGraph.of(fixed_graph(saved.graph) if fixed else saved.graph)
        self.keyframes, self.driven = list(saved.keyframes), saved.driven.tolist()
        self.is_fixed = fixed
        self._begin_session()
        self.first_new_node = self.first_node

    def _begin_session(self) -> None:
        """Reserves node names, so that no cached submap holds keyframes of two sessions."""
        self.content, self.search.far_closures = None, FarClosures()
        block_size = self.closure_config.block_size
        blocks = int(self.graph.nodes[-1]) // block_size if len(self.graph.nodes) else 0
        self.first_node = (blocks + 4) * block_size
        self.graph.reserve_names(self.first_node)

    def start_unlocalized(self) -> None:
        """Begins a session at an unknown pose, after the robot was carried away."""
        while self.is_fixed and self.first_row < len(self.keyframes):
            self._remove(self.first_row)
        self._begin_session()

    def begin_part(self, gap: OdometryGap) -> None:
        """Begins a part after scans did not fit; only odometry joins it to the rest."""
        if self.gap is not None:  # the last part got no keyframe
            gap = OdometryGap(gap.motion, self.gap.path + gap.path, self.gap.turn + gap.turn)
        else:
            self._begin_session()
        self.gap, self.is_joined, self.joint_candidates = gap, False, []

    def start_localized(
        self, map_from_local: Pose2, pending: Sequence[PendingKeyframe], odometry: OdometryError
    ) -> None:
        """Begins a session at a pose from global localization, with the keyframes that were collected until then."""
        self.map_from_local = map_from_local
        for keyframe, match, odometry_scale in pending:
            self.add_keyframe(keyframe, match, odometry, odometry_scale)
        self.closed_at = self.driven[-1]
        node = int(self.graph.nodes[-1])
        pose = self.graph.pose(node)
        anchor = int(self.graph.nodes[0 if self.is_fixed else self._nearest_earlier_row(pose)])
        anchor_from_node = self.graph.pose(anchor).inverse() @ pose
        self.graph.add_edge(anchor, node, anchor_from_node, FOUND_INFORMATION, loop=False)

    @property
    def n_in_part(self) -> int:
        """Number of keyframes of the present session."""
        return len(self.keyframes) - self.first_row

    @property
    def path_since_closure(self) -> float:
        """Path length since the last closure, m."""
        return self.driven[-1] - self.closed_at if self.driven else 0.0

    @property
    def first_row(self) -> int:
        """Row of the session's first keyframe."""
        return int(np.searchsorted(self.graph.nodes, self.first_node))

    def add_keyframe(
        self, keyframe: Keyframe, match: Match, odometry: OdometryError, odometry_scale: float = 1.0
    ) -> None:
        """Adds a keyframe and its edge to the one before, which combines scan matching and odometry.

        odometry_scale: factor of odometry's standard deviations, the largest since the last keyframe.
        """
        row, node = self.first_row, self.graph.add_node(self.map_from_local @ keyframe.local_from_base)
        c = self.config
        if row == len(self.keyframes):
            if (gap := self.gap) is not None:  # measured by odometry alone, which may be wrong
                i = int(self.graph.nodes[-2])
                self.graph.add_edge(i, node, gap.motion, gap_information(gap.path, gap.turn), loop=True)
                self.gap_edges |= {(i, node)}
                self.part_gap, self.gap = gap, None
            jump = self.closure_config.min_path_between + 2 * self.closure_config.view_radius
            self.driven.append(self.driven[-1] + jump if self.driven else 0.0)
        else:
            before = self.keyframes[-1].local_from_base
            step = before.inverse() @ keyframe.local_from_base
            prior = odometry.prior(self._settings[0], before, step, odometry_scale)
            information = information_in_own_frame(
                match.information, keyframe.local_from_base.yaw, prior.information, c.min_sigma, c.min_sigma_turn
            )
            information = widen_where_doubtful(information, step, keyframe.odometry_residual, match.inlier_ratio)
            self.graph.add_edge(node - 1, node, step, information, loop=False)
            self.driven.append(self.driven[-1] + hypot(step.x, step.y))
        self.keyframes.append(keyframe)
        self.n_since_local_map += 1
        self._prune()

    def _prune(self) -> None:
        """Removes keyframes, so that the graph grows with the area and not with time."""
        c = self.config
        if self.is_fixed:
            while len(self.keyframes) - self.first_row > c.max_localization_keyframes:
                self._remove(self.first_row)
            return
        first = 0 if self.is_joined else self.first_row  # the place of an unjoined part is not known
        protected = [*self.edit_nodes, *(node for edge in self.gap_edges for node in edge)]
        min_path = self.closure_config.min_path_between
        row = redundant_keyframe(
            self.graph, self.driven, c.max_keyframes_per_place, c.place_size, min_path, first, protected
        )
        if row is not None:
            self._remove(row)

    def _remove(self, row: int) -> None:
        self.graph.remove_node(int(self.graph.nodes[row]))
        del self.keyframes[row], self.driven[row]

    def search_arguments(self) -> tuple[Any, ...]:
        """Returns the arguments of `search_constraints`, for the keyframes since the last call."""
        return (
            self.graph.snapshot(), tuple(self.keyframes), np.array(self.driven), self.submaps, self.closure_config,
            self._settings[0], self.config.pairwise,
            self.search.next_order(self.graph, self.driven, self.first_node, self.is_fixed, self.is_joined),
        )  # fmt: skip

    def add_far(self, found: FarSearch) -> None:
        """Adds the result of a search for far closures: they count, and join a part, once enough of them agree."""
        if not (closures := self.search.far_closures.add(found, self.graph)):
            return
        self.search.search_again(self.graph.snapshot(), self.driven, self.gap_edges, self.closed_at)
        joining = [c for c in closures if c.i < self.first_node]
        if joining and not self.is_joined:
            newest, c = self.graph.pose(int(self.graph.nodes[-1])), joining[-1]
            self._join_part(self.graph.pose(c.i) @ c.i_from_j @ self.graph.pose(c.j).inverse() @ newest)
        self.add_closures((), closures)

    def add_closures(self, closures: Sequence[Constraint], confirmed: Sequence[Constraint] = ()) -> None:
        """Adds loop closures. Those of an unjoined part, and doubtful ones, wait until others confirm them."""
        closures = existing(self.graph, closures)
        if not self.is_joined:
            closures = [*(c for c in closures if c.i >= self.first_node), *self._joining_closures(closures)]
        closures = self.search.doubtful_closures.add(closures, confirmed, self.graph, self.driven)
        for closure in closures:
            expected = self.graph.pose(closure.i).inverse() @ self.graph.pose(closure.j)
            error = expected.inverse() @ closure.i_from_j
            off, c = hypot(error.x, error.y), self.config
            self.is_inconsistent |= off > c.urgent_error or abs(error.yaw) > c.urgent_turn_error
            self.search.on_closure(off, self.closed_at)
            i, i_from_j = closure.i, closure.i_from_j
            if self.is_fixed and i < self.first_node:  # all fixed nodes are one rigid body
                origin = int(self.graph.nodes[0])
                i, i_from_j = origin, self.graph.pose(origin).inverse() @ self.graph.pose(i) @ i_from_j
            self.graph.add_edge(i, closure.j, i_from_j, closure.information, loop=True)
            self.closed_at = self.driven[-1]
        self.is_confirmed = bool(closures) and not self.is_inconsistent and self.n_pending_closures > N_CONFIRMING
        self.n_loops += len(closures)
        self.n_pending_closures += len(closures)

    def _joining_closures(self, closures: Sequence[Constraint]) -> list[Constraint]:
        """Returns the closures that join the present part to the rest, once enough agree, and moves the part there."""
        new = (c for c in closures if c.i < self.first_node <= c.j and not c.is_partial)
        self.joint_candidates = existing(self.graph, [*self.joint_candidates, *new])
        newest = self.graph.pose(int(self.graph.nodes[-1]))
        joint = find_joint(self.graph, self.joint_candidates, newest, self.part_gap)
        if joint is None:
            return []
        self._join_part(joint[0])
        return joint[1]

    def _join_part(self, map_from_base: Pose2) -> None:
        """Moves the part rigidly, so that its newest keyframe has this pose."""
        correction = map_from_base @ self.graph.pose(int(self.graph.nodes[-1])).inverse()
        self.graph.move_nodes(self.first_node, correction)
        self.map_from_local = correction @ self.map_from_local
        self.is_joined, self.joint_candidates, self.is_inconsistent = True, [], True
        self.n_joints += 1

    def join_localized(self, map_from_local: Pose2) -> None:
        """Joins the part to the rest by a pose from global localization."""
        node, pose = int(self.graph.nodes[-1]), map_from_local @ self.keyframes[-1].local_from_base
        self._join_part(pose)
        anchor = int(self.graph.nodes[self._nearest_earlier_row(pose)])
        anchor_from_node = self.graph.pose(anchor).inverse() @ pose
        self.graph.add_edge(anchor, node, anchor_from_node, FOUND_INFORMATION, loop=True)
        self.n_pending_closures += 1

    def _nearest_earlier_row(self, pose: Pose2) -> int:
        """Row of the nearest keyframe of an earlier session."""
        distance = np.hypot(*(self.graph.poses[: self.first_row, :2] - (pose.x, pose.y)).T)
        return int(np.argmin(distance))

    def add_pairwise(self, constraints: Sequence[Constraint]) -> None:
        """Adds pairwise constraints: small corrections, for the next optimization."""
        constraints = existing(self.graph, constraints)
        self.n_pending_pairwise += len(constraints)
        for constraint in constraints:
            self.graph.add_edge(constraint.i, constraint.j, constraint.i_from_j, constraint.information, loop=True)

    @property
    def needs_optimization(self) -> bool:
        """Whether pending constraints ask for an optimization now."""
        c = self.config
        return (
            self.is_inconsistent
            or self.n_pending_closures >= c.max_pending_closures
            or self.n_pending_pairwise >= c.max_pending_pairwise
        )

    @property
    def is_optimized(self) -> bool:
        """Whether the poses contain all constraints."""
        return self.n_pending_closures == 0 and self.n_pending_pairwise == 0

    def optimization_arguments(self) -> tuple[Graph, PoseGraphConfig]:
        """Returns the arguments of `optimize`."""
        # a closure that moves the graph does not reduce its uncertainty
        self.optimizes_closures |= self.n_pending_closures > 0 and not self.is_inconsistent
        self.n_pending_closures, self.n_pending_pairwise, self.is_inconsistent = 0, 0, False
        return self.graph.snapshot(), self.graph_config

    def apply(self, optimum: OptimizationResult) -> None:
        """Applies an optimum to the graph and to `map_from_local`, and adds up the shifts that it makes."""
        before, local_from_map = self.graph.poses.copy(), self.map_from_local.inverse()
        self.graph.apply(optimum)
        if not self.is_inconsistent and not self.is_fixed:
            self.search.search_drifted(self.graph, self.driven)
        if self.first_row == len(self.keyframes):  # a part without keyframes moves with the node before it
            self.map_from_local = optimum.moved @ self.map_from_local
        else:
            self._check_joint()
            first = max(self.first_row, len(self.keyframes) - N_ANCHORS)
            self.map_from_local = mean_map_from_local(self.keyframes[first:], self.graph.poses[first:])
        if self.optimizes_closures:
            self.last_optimized, self.optimizes_closures = int(self.graph.nodes[-1]), False
        near = np.hypot(*(before[:, :2] - before[-1, :2]).T) < self._local_radius + MARGIN_M
        shift = self.map_from_local.inverse() @ self.graph.poses[near, :2] - local_from_map @ before[near, :2]
        self.local_shift += float(np.hypot(shift[:, 0], shift[:, 1]).max())
        if not self.is_fixed:
            self.map_shift += float(np.hypot(*(self.graph.poses - before)[:, :2].T).max())

    def _check_joint(self) -> None:
        """Separates a part again where the optimum rejects the closures that joined it."""
        if self.is_joined and self.gap_edges and self.first_node > self.first_new_node:
            self.is_joined = bool(joined_nodes(self.graph.snapshot(), self.gap_edges)[-1])

    @property
    def _local_radius(self) -> float:
        """Radius about the robot within which keyframes saw what the robot sees, m."""
        return min(self._settings[2], self.config.local_radius)

    @property
    def needs_local_map(self) -> bool:
        """Whether to check and rebuild the local map."""
        has_keyframes = self.first_row < len(self.keyframes)
        is_old = self.n_since_local_map >= self.config.local_map_interval or self.local_shift > MIN_VISIBLE_SHIFT_M
        return has_keyframes and is_old

    def local_map_arguments(self) -> tuple[Any, ...]:
        """Returns the arguments of `build_local_map`."""
        content = self.content if self.local_shift <= MIN_VISIBLE_SHIFT_M else None
        self.n_since_local_map, self.local_shift = 0, 0.0
        return (
            self.graph.snapshot(), tuple(self.keyframes), self.map_from_local.inverse(), self.first_node,
            self.last_optimized, self.config.max_local_sigma, self._local_radius, content, self._settings,
        )  # fmt: skip

    def completed_submap(self, local_map: LocalMap) -> Submap | None:
        """Returns the submap of a local map with the keyframes that were added meanwhile.

        None if the present submap stays, or a new session began.
        """
        if local_map.session != self.first_node:
            return None
        self.content = local_map.content
        if local_map.submap is None:
            return None
        first = int(np.searchsorted(self.graph.nodes, local_map.content.newest, side="right"))
        for keyframe, node in zip(self.keyframes[first:], self.graph.nodes[first:].tolist()):
            local_map.submap.add_keyframe(keyframe, keyframe.local_from_base)
            covariance = keyframe.covariance if node > self.last_optimized else NO_COVARIANCE
            local_map.submap.set_uncertainty(keyframe.local_from_base, covariance, keyframe.stamp)
        return local_map.submap

    @property
    def needs_redraw(self) -> bool:
        """Whether the corrections since the map was drawn add up to a visible shift."""
        return self.map_shift > MIN_VISIBLE_SHIFT_M

    def new_drawing(self) -> Drawing:
        """Returns an empty drawing of the map, to draw all keyframes into."""
        self.map_shift = 0.0
        empty = Drawing(Occupancy(self._settings[1], 0), (), np.zeros((0, 3)), np.zeros(0, np.bool_), -1)
        return self.continued_drawing(empty)

    def continued_drawing(self, drawing: Drawing) -> Drawing:
        """Returns a finished drawing with the keyframes to draw that were added meanwhile."""
        return continue_drawing(drawing, self.graph.snapshot(), self.keyframes, self.gap_edges)

    def corrections(self) -> list[Pose2]:
        """Returns map_from_local at each keyframe that is not from a saved map."""
        first = int(np.searchsorted(self.graph.nodes, self.first_new_node))
        rows = zip(self.graph.poses[first:].tolist(), self.keyframes[first:])
        return [Pose2(*row) @ keyframe.local_from_base.inverse() for row, keyframe in rows]
