# SPDX-License-Identifier: Apache-2.0
"""Jobs of the back end beside the scans: constraint search, optimization, the local map, and redrawing the map.

One job of each kind runs at a time. A result that belongs to an earlier map is discarded.
"""

from collections.abc import Callable, Generator
from typing import Any, TypeVar

from services.mapper.back_end.back_end import BackEnd
from services.mapper.back_end.constraint_search import FoundConstraints, search_constraints
from services.mapper.back_end.keyframe import Keyframe
from services.mapper.back_end.local_map import LocalMap, build_local_map
from services.mapper.back_end.pose_graph import OptimizationResult
from services.mapper.back_end.solver.optimize import optimize
from services.mapper.front_end.odometry_error import OdometryError
from services.mapper.front_end.registration import Match
from services.mapper.front_end.submap import Submap
from services.mapper.grid.map_drawing import Drawing, draw_slice
from services.mapper.grid.occupancy import Occupancy
from shared.service import Job, Out
from shared.types import NS_PER_S

T = TypeVar("T")

MAX_LATE_KEYFRAMES = 2  # that were added while the map was redrawn, and are drawn at once at the end


class MapJobs:
    """Orders jobs for a back end and applies their results. Each result carries the epoch of its order."""

    def __init__(self, back_end: BackEnd) -> None:
        self.back_end = back_end
        self.epoch = -1
        self.reset()

    def reset(self) -> None:
        """Begins another map: results of jobs for the old one are discarded."""
        self.epoch += 1
        self.back_end.reset()
        self.is_searching = self.is_optimizing = self.is_drawing = self.is_building = False
        self.draw_started = self.draw_ended = 0  # ns, of the last redrawing
        self.n_joints = 0  # at the start of the last optimization

    def add_keyframe(
        self, keyframe: Keyframe, match: Match, odometry: OdometryError, odometry_scale: float = 1.0
    ) -> Out:
        """Adds a keyframe to the graph, and orders a search for constraints when due, unless matches are doubtful now.

        Arguments as for `BackEnd.add_keyframe`.
        """
        self.back_end.add_keyframe(keyframe, match, odometry, odometry_scale)
        is_due = self.back_end.search.is_due(self.back_end.driven, self.back_end.closure_config.search_interval)
        if is_due and not self.is_searching and not odometry.match_error.is_doubtful:
            self.is_searching = True
            yield self._job(search_constraints, self.back_end.search_arguments(), "on_constraints", 0.05)
        yield from self._update_local_map()

    def on_constraints(self, result: tuple[int, FoundConstraints]) -> Out:
        """Adds the constraints that a search found, and orders an optimization when they ask for one."""
        epoch, constraints = result
        if epoch == self.epoch:
            self.is_searching = False
            self.back_end.add_closures(constraints.closures)
            self.back_end.add_far(constraints.far)
            self.back_end.add_pairwise(constraints.pairwise)
            if self.back_end.needs_optimization:
                yield from self.optimize()

    def optimize(self) -> Out:
        """Orders an optimization if the graph holds constraints that are not in its poses yet."""
        if not self.back_end.is_optimized and not self.is_optimizing:
            self.is_optimizing, self.n_joints = True, self.back_end.n_joints
            yield self._job(optimize, self.back_end.optimization_arguments(), "on_graph_optimized", 0.2)

    def on_graph_optimized(self, result: tuple[int, OptimizationResult]) -> Out:
        """Applies an optimum. Constraints that were found meanwhile may ask for the next optimization."""
        epoch, optimum = result
        if epoch == self.epoch:
            self.is_optimizing = False
            if self.n_joints != self.back_end.n_joints:  # a part was moved meanwhile
                self.back_end.is_inconsistent = True
            else:
                self.back_end.apply(optimum)
            yield from self._update_local_map()
            if self.back_end.needs_optimization:
                yield from self.optimize()

    def _update_local_map(self) -> Out:
        """Orders another local map where the robot or the graph has moved on."""
        if self.back_end.needs_local_map and not self.is_building:
            self.is_building = True
            yield self._job(build_local_map, self.back_end.local_map_arguments(), "on_local_map", 0.2)

    def on_local_map(self, result: tuple[int, LocalMap]) -> Submap | None:
        """Returns the submap for the next scans; None if the present one stays, or the map is another one."""
        epoch, local_map = result
        if epoch != self.epoch:
            return None
        self.is_building = False
        return self.back_end.completed_submap(local_map)

    def redraw(self, now: int) -> Out:
        """Orders a redrawing of the map where the graph has moved; it takes at most half of the time.

        now: ns.
        """
        pause = max(self.back_end.config.redraw_interval * NS_PER_S, self.draw_ended - self.draw_started)
        pauses = 0 <= now - self.draw_ended < pause  # negative after the clock was set back
        if self.back_end.needs_redraw and not self.is_drawing and not pauses:
            self.is_drawing, self.draw_started = True, now
            yield self._job(draw_slice, (self.back_end.new_drawing(),), "on_map_drawn", 0.2)

    def on_map_drawn(self, result: tuple[int, Drawing], now: int) -> Generator[Job, None, Occupancy | None]:
        """Orders the next slice of the drawing, up to the keyframes that were added meanwhile.

        Returns the finished grid; None before that, and for another map.  now: ns.
        """
        epoch, drawing = result
        if epoch != self.epoch:
            return None
        if not drawing.keyframes:
            drawing = self.back_end.continued_drawing(drawing)
            if len(drawing.keyframes) <= MAX_LATE_KEYFRAMES:
                self.is_drawing, self.draw_ended = False, now
                return draw_slice(drawing).grid
        yield self._job(draw_slice, (drawing,), "on_map_drawn", 0.2)
        return None

    def _job(self, function: Callable[..., T], arguments: tuple[Any, ...], done: str, takes: float) -> Job:
        return Job(_with_epoch, (self.epoch, function, arguments), done, takes)


def _with_epoch(epoch: int, function: Callable[..., T], arguments: tuple[Any, ...]) -> tuple[int, T]:
    """Returns a job's result with the epoch of its order."""
    return epoch, function(*arguments)
