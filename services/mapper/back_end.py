# SPDX-License-Identifier: Apache-2.0
"""From keyframes to a consistent map: the graph of their poses, what closes loops in it, and the map drawn anew."""

from collections.abc import Sequence
from math import hypot
from typing import Any

import numpy as np
from pydantic import Field

from services.mapper.keyframe import SETTLED, Keyframe, frame_of
from services.mapper.loop_closure import Blocks, Loop, LoopConfig, closed, in_own_frame
from services.mapper.map_drawing import Drawing, drawn, newer
from services.mapper.occupancy import Occupancy, OccupancyConfig
from services.mapper.odometry_error import OdometryError
from services.mapper.optimisation import PoseGraphConfig, optimised
from services.mapper.parts import Gap, gap_information, joined_nodes, joint_of
from services.mapper.pose_graph import Graph, Optimised, PoseGraph, still
from services.mapper.registration import Match, RegistrationConfig
from services.mapper.saved_map import SavedMap
from services.mapper.slip import widened
from services.mapper.submap import Submap
from services.mapper.surroundings import BETWEEN, Held, Surroundings, surroundings
from services.mapper.thinning import crowded
from services.mapper.ties import TieConfig
from services.mapper.uncertainty import uncertainty_from
from shared.config import Section
from shared.geometry import Pose2

SEEN = 0.02  # m, a correction that shows on the map
ANCHORS = 10  # keyframes that tell where `local` is
CONFIRMING = 7  # closures since the last optimisation, that agree
HELD = np.diag((0.1**-2, 0.1**-2, 0.03**-2))
"""Information of the place at which the robot was found on a saved map: closures will know it better."""


class BackEndConfig(Section):
    """The pose graph's edges between keyframes."""

    noise: float = Field(0.01, ge=0.001, le=1, description="m, standard deviation from a keyframe to the next at least")
    noise_turn: float = Field(0.003, ge=0.0003, le=1, description="rad, of its turn")
    off: float = Field(
        0.05, ge=0, le=10, description="m that a closure may be off until the graph is optimised at once"
    )
    off_turn: float = Field(0.02, ge=0, le=3, description="rad, the same for its turn")
    patience: int = Field(20, ge=1, le=10_000, description="closures that agree, until it is optimised all the same")
    tied: int = Field(360, ge=1, le=10_000, description="ties until it is optimised")
    redraw: float = Field(2.0, ge=0, le=3600, description="s between two drawings of the whole map at least")
    crowd: int = Field(8, ge=2, le=1000, description="keyframes at one place, until the oldest of them is given up")
    crowd_reach: float = Field(0.5, ge=0.05, le=5, description="m, and rad, that make it one place")
    sure: float = Field(
        0.2, ge=0.01, le=10, description="m, standard deviation up to which a keyframe is matched with, from the newest"
    )
    near: float = Field(10.0, ge=1, le=250, description="m from the robot up to which keyframes are matched with")
    renew: int = Field(20, ge=1, le=10_000, description="keyframes between two looks at what is matched with")
    recent: int = Field(
        60, ge=2, le=10_000, description="keyframes that are placed together on a saved map that does not change"
    )
    ties: TieConfig = TieConfig()


Waiting = tuple[Keyframe, Match, float]
"""What `BackEnd.add` is given."""


class BackEnd:
    """Keyframes and their graph. `map_from_local` is where the front end's frame is by now."""

    def __init__(
        self,
        config: BackEndConfig,
        loops: LoopConfig,
        graph: PoseGraphConfig,
        registration: RegistrationConfig,
        occupancy: OccupancyConfig,
        range_max: float,
    ) -> None:
        self.config, self.loops, self.graph_config = config, loops, graph
        self._settings = registration, occupancy, range_max
        self.start()

    def start(self) -> None:
        """Forgets everything."""
        self.graph = PoseGraph()
        self.keyframes: list[Keyframe] = []
        self.driven: list[float] = []
        self.map_from_local = Pose2()
        self.looked_at = 0.0  # m driven when loops were looked for
        self.n_loops = 0
        self.n_agreeing = 0  # closures since the last optimisation
        self.n_tied = 0  # ties since then
        self.fixed = False  # the map does not change
        self.first = 0  # name of the first node of this session: what is before it lies in another `local`
        self.begun = 0  # name of the first node that is not a saved map's
        self.held_at = 0.0  # m driven at the last closure
        self.off = False  # one of them moves what is known
        self.confirmed = False  # so many of them agree with what is believed that there is no more doubt of it
        self.moved = 0.0  # m, at most, of any keyframe since the map was drawn
        self.shifted = 0.0  # m, at most, of any near keyframe as seen from the newest, since it was last gathered
        self.n_new = 0  # keyframes since then
        self.held: Held | None = None  # what the front end's submap holds, where it was gathered from here
        self.tied_to = -1  # name of the newest node whose ties were looked for
        self.closing = False  # there are closures among what is being optimised
        self.settled_to = -1  # name of the newest node at the last optimum that held new closures
        self.blocks = Blocks(*self._settings, self.loops)
        self.gap: Gap | None = None  # to the first keyframe of a part that is to begin
        self.gaps: frozenset[tuple[int, int]] = frozenset()  # edges that are odometry's alone
        self.bridged = Gap(Pose2(), 0.0, 0.0)  # to the present part
        self.joined = True  # closures join the present part to the rest
        self.joints: list[Loop] = []  # closures of a part that is not joined, to what was before it
        self.n_joints = 0  # parts that were joined

    def load(self, saved: SavedMap, fixed: bool) -> None:
        """Goes on with a saved map, or places the robot on it; then it does not change."""
        self.start()
        self.graph = PoseGraph.of(still(saved.graph) if fixed else saved.graph)
        self.keyframes, self.driven = list(saved.keyframes), saved.driven.tolist()
        self.fixed = fixed
        self._begin()
        self.begun = self.first

    def _begin(self) -> None:
        """A session's nodes have names of their own blocks: its `local` is another one."""
        self.held = None
        blocks = int(self.graph.nodes[-1]) // self.loops.around if len(self.graph.nodes) else 0
        self.first = (blocks + 4) * self.loops.around
        self.graph.leave_names(self.first)

    def part(self) -> None:
        """The robot was carried away: what comes next is a session of its own."""
        while self.fixed and self.session < len(self.keyframes):
            self._give_up(self.session)
        self._begin()

    def begin_part(self, gap: Gap) -> None:
        """Scans do not fit: what comes next is a part of its own, to which only odometry leads."""
        if self.gap is not None:  # no keyframe came since the last one began
            gap = Gap(gap.motion, self.gap.path + gap.path, self.gap.turn + gap.turn)
        else:
            self._begin()
        self.gap, self.joined, self.joints = gap, False, []

    @property
    def n_in_part(self) -> int:
        """Keyframes of the present session."""
        return len(self.keyframes) - self.session

    def found(self, map_from_local: Pose2, waiting: Sequence[Waiting], odometry: OdometryError) -> None:
        """A session begins at a place that was found on the map, with the keyframes up to there."""
        self.map_from_local = map_from_local
        for keyframe, match, doubt in waiting:
            self.add(keyframe, match, odometry, doubt)
        self.held_at = self.driven[-1]
        node = int(self.graph.nodes[-1])
        pose = self.graph.pose(node)
        anchor = int(self.graph.nodes[0 if self.fixed else self._nearest_before(pose)])
        self.graph.connect(anchor, node, self.graph.pose(anchor).inverse() @ pose, HELD, loop=False)

    @property
    def unheld(self) -> float:
        """m driven since the last closure."""
        return self.driven[-1] - self.held_at if self.driven else 0.0

    @property
    def session(self) -> int:
        """The row of its first keyframe."""
        return int(np.searchsorted(self.graph.nodes, self.first))

    def add(self, keyframe: Keyframe, match: Match, odometry: OdometryError, doubt: float = 1.0) -> None:
        """A new keyframe, where the beams say that it is; where they say nothing, odometry does.

        doubt: how much wider odometry's standard deviations are, on the worst of the steps since the last keyframe.
        """
        row, node = self.session, self.graph.add(self.map_from_local @ keyframe.local_from_base)
        if row == len(self.keyframes):
            if self.gap is not None:
                self._bridge(int(self.graph.nodes[-2]), node, self.gap)
            self.driven.append(self.driven[-1] + self.loops.apart + 2 * self.loops.view if self.driven else 0.0)
        else:
            before = self.keyframes[-1].local_from_base
            step = before.inverse() @ keyframe.local_from_base
            prior = odometry.prior(self._settings[0], before, step, doubt)
            known = np.diag((prior.sigma**-2, prior.sigma**-2, prior.sigma_turn**-2))
            information = in_own_frame(
                match.information, keyframe.local_from_base.yaw, known, self.config.noise, self.config.noise_turn
            )
            self.graph.connect(node - 1, node, step, widened(information, step, keyframe.off), loop=False)
            self.driven.append(self.driven[-1] + hypot(step.x, step.y))
        self.keyframes.append(keyframe)
        self.n_new += 1
        self._thin()

    def _bridge(self, i: int, j: int, gap: Gap) -> None:
        """Joins a part's first keyframe to the one before it by odometry, which may be wrong."""
        self.graph.connect(i, j, gap.motion, gap_information(gap.path, gap.turn), loop=True)
        self.gaps |= {(i, j)}
        self.bridged, self.gap = gap, None

    def _thin(self) -> None:
        """Where the robot drives again and again, the graph grows with the area, not with time."""
        if self.fixed:
            while len(self.keyframes) - self.session > self.config.recent:
                self._give_up(self.session)
            return
        first = 0 if self.joined else self.session  # what lies where an unjoined part seems to be is not known
        kept = [node for gap in self.gaps for node in gap]
        c = self.config
        row = crowded(self.graph, self.driven, c.crowd, c.crowd_reach, self.loops.apart, first, kept)
        if row is not None:
            self._give_up(row)

    def _give_up(self, row: int) -> None:
        self.graph.remove(int(self.graph.nodes[row]))
        del self.keyframes[row], self.driven[row]

    @property
    def due(self) -> bool:
        """Whether to look for closures at the newest keyframe."""
        return len(self.keyframes) > 1 and self.driven[-1] - self.looked_at >= self.loops.every

    def look(self) -> tuple[Any, ...]:
        """The arguments of `looked`, for the keyframes since the last call."""
        self.looked_at = self.driven[-1]
        newest = int(self.graph.nodes[-1])
        tied_to, self.tied_to = newest if self.fixed else max(self.tied_to, self.first - 1), newest
        return (
            self.graph.snapshot(), tuple(self.keyframes), np.array(self.driven), self.blocks, self.loops, tied_to,
            self._settings[0], self.config.ties,
        )  # fmt: skip

    def close(self, loops: Sequence[Loop]) -> None:
        """Takes closures. Those of a part that is not joined wait until enough of them agree."""
        loops = self._present(loops)
        if not self.joined:
            loops = [*(loop for loop in loops if loop.i >= self.first), *self._joint(loops)]
        for loop in loops:
            rest = (self.graph.pose(loop.i).inverse() @ self.graph.pose(loop.j)).inverse() @ loop.i_from_j
            self.off |= hypot(rest.x, rest.y) > self.config.off or abs(rest.yaw) > self.config.off_turn
            i, i_from_j = loop.i, loop.i_from_j
            if self.fixed and i < self.first:  # all that stands still is one
                origin = int(self.graph.nodes[0])
                i, i_from_j = origin, self.graph.pose(origin).inverse() @ self.graph.pose(i) @ i_from_j
            self.graph.connect(i, loop.j, i_from_j, loop.information, loop=True)
            self.held_at = self.driven[-1]
        self.confirmed = bool(loops) and not self.off and self.n_agreeing > CONFIRMING
        self.n_loops += len(loops)
        self.n_agreeing += len(loops)

    def _joint(self, loops: Sequence[Loop]) -> list[Loop]:
        """The closures that join the present part to the rest, once enough of them agree; the part is moved there."""
        self.joints = self._present([*self.joints, *(loop for loop in loops if loop.i < self.first <= loop.j)])
        newest = self.graph.pose(int(self.graph.nodes[-1]))
        joint = joint_of(self.graph, self.joints, newest, self.bridged)
        if joint is None:
            return []
        self.join(joint[0])
        return joint[1]

    def join(self, map_from_base: Pose2) -> None:
        """The newest keyframe, and with it its part, lies here on the map."""
        moved = map_from_base @ self.graph.pose(int(self.graph.nodes[-1])).inverse()
        self.graph.move(self.first, moved)
        self.map_from_local = moved @ self.map_from_local
        self.joined, self.joints, self.off = True, [], True
        self.n_joints += 1

    def join_found(self, map_from_local: Pose2) -> None:
        """The part was found on the map as a whole."""
        node, pose = int(self.graph.nodes[-1]), map_from_local @ self.keyframes[-1].local_from_base
        self.join(pose)
        anchor = int(self.graph.nodes[self._nearest_before(pose)])
        self.graph.connect(anchor, node, self.graph.pose(anchor).inverse() @ pose, HELD, loop=True)
        self.n_agreeing += 1

    def _nearest_before(self, pose: Pose2) -> int:
        """The row of the nearest keyframe that is not of this session."""
        away = np.hypot(*(self.graph.poses[: self.session, :2] - (pose.x, pose.y)).T)
        return int(np.argmin(away))

    def tie(self, ties: Sequence[Loop]) -> None:
        """Takes ties: small corrections, for the next optimisation."""
        ties = self._present(ties)
        self.n_tied += len(ties)
        for tie in ties:
            self.graph.connect(tie.i, tie.j, tie.i_from_j, tie.information, loop=True)

    def _present(self, loops: Sequence[Loop]) -> list[Loop]:
        """Those between keyframes that were not given up meanwhile."""
        nodes = set(self.graph.nodes.tolist())
        return [loop for loop in loops if loop.i in nodes and loop.j in nodes]

    @property
    def urgent(self) -> bool:
        """Whether it is time to optimise."""
        many = self.n_agreeing >= self.config.patience or self.n_tied >= self.config.tied
        return self.off or many

    @property
    def settled(self) -> bool:
        """Whether all closures and ties are in the poses."""
        return self.n_agreeing == 0 and self.n_tied == 0

    def optimise(self) -> tuple[Graph, PoseGraphConfig]:
        """The arguments of `optimised`."""
        self.closing |= self.n_agreeing > 0 and not self.off  # one that moves all is not to make it sure
        self.n_agreeing, self.n_tied, self.off = 0, 0, False
        return self.graph.snapshot(), self.graph_config

    def take(self, optimum: Optimised) -> None:
        """Takes an optimum."""
        before, local_from_map = self.graph.poses.copy(), self.map_from_local.inverse()
        self.graph.take(optimum)
        if self.session == len(self.keyframes):  # a part is to begin: it moves with what is before it
            self.map_from_local = optimum.moved @ self.map_from_local
        else:
            self._check_joint()
            self.map_from_local = self._map_from_local()
        if self.closing:
            self.settled_to, self.closing = int(self.graph.nodes[-1]), False
        near = np.hypot(*(before[:, :2] - before[-1, :2]).T) < self._near + BETWEEN
        shift = self.map_from_local.inverse() @ self.graph.poses[near, :2] - local_from_map @ before[near, :2]
        self.shifted += float(np.hypot(shift[:, 0], shift[:, 1]).max())
        if not self.fixed:
            self.moved += float(np.hypot(*(self.graph.poses - before)[:, :2].T).max())

    def _check_joint(self) -> None:
        """A joint that the other closures contradict is separated again."""
        if self.joined and self.gaps and self.first > self.begun:
            self.joined = bool(joined_nodes(self.graph.snapshot(), self.gaps)[-1])

    def _map_from_local(self) -> Pose2:
        """Where `local` is by the last keyframes together: the heading of one alone turns all that is far."""
        first = max(self.session, len(self.keyframes) - ANCHORS)
        return frame_of(self.keyframes[first:], self.graph.poses[first:])

    @property
    def _near(self) -> float:
        """m from the robot within which keyframes saw what it sees."""
        return min(self._settings[2], self.config.near)

    @property
    def moved_on(self) -> bool:
        """Whether the surroundings are to be drawn anew."""
        placed = self.session < len(self.keyframes)
        return placed and (self.n_new >= self.config.renew or self.shifted > SEEN)

    def around(self) -> tuple[Any, ...]:
        """The arguments of `surroundings`."""
        held = self.held if self.shifted <= SEEN else None
        self.n_new, self.shifted = 0, 0.0
        return (
            self.graph.snapshot(), tuple(self.keyframes), self.map_from_local.inverse(), self.first, self.settled_to,
            self.config.sure, self._near, held, self._settings,
        )  # fmt: skip

    def completed(self, drawn: Surroundings) -> Submap | None:
        """The surroundings, with the keyframes that came meanwhile; None where those at hand will do, or the robot was
        carried away since."""
        if drawn.session != self.first:
            return None
        self.held = drawn.held
        if drawn.submap is None:
            return None
        first = int(np.searchsorted(self.graph.nodes, drawn.held.node, side="right"))
        for keyframe, node in zip(self.keyframes[first:], self.graph.nodes[first:].tolist()):
            drawn.submap.take(keyframe, keyframe.local_from_base)
            doubt = keyframe.doubt if node > self.settled_to else SETTLED
            drawn.submap.sign(keyframe.local_from_base, doubt, keyframe.stamp)
        return drawn.submap

    @property
    def outdated(self) -> bool:
        """Whether the map is to be drawn anew. Small corrections add up, too."""
        return self.moved > SEEN

    def draw(self) -> Drawing:
        """A map to draw anew, from all keyframes."""
        self.moved = 0.0
        return self.newer(Drawing(Occupancy(self._settings[1], 0), (), np.zeros((0, 3)), np.zeros(0, np.bool_), -1))

    def newer(self, drawing: Drawing) -> Drawing:
        """A finished drawing, to go on with the keyframes that came meanwhile."""
        return newer(drawing, self.graph.snapshot(), self.keyframes, self.gaps)

    def rehearse(self) -> None:
        """Calls every kernel once, with two keyframes or more; it is of no use after that."""
        graph, last = self.graph.snapshot(), len(self.keyframes) - 1
        covariances = uncertainty_from(graph, int(graph.nodes[last]))
        closed(graph, self.keyframes, 0, last, covariances[0], self.blocks, self.loops)
        off = self.graph.pose(0).inverse() @ self.graph.pose(last) @ Pose2(0.5, 0.0, 0.1)
        self.graph.connect(0, last, off, np.eye(3), loop=True)
        self.take(optimised(*self.optimise()))
        drawn(self.draw())
        surroundings(*self.around())

    def corrections(self) -> list[Pose2]:
        """map_from_local at each keyframe that is not a saved map's."""
        begun = int(np.searchsorted(self.graph.nodes, self.begun))
        rows = zip(self.graph.poses[begun:].tolist(), self.keyframes[begun:])
        return [Pose2(*row) @ keyframe.local_from_base.inverse() for row, keyframe in rows]
