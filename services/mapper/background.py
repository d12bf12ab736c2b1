# SPDX-License-Identifier: Apache-2.0
"""What goes on beside the scans: looks for closures, optimisations, and drawing the map anew, each a Job.

One of a kind runs at a time. What one finds may come when the map is another one by then: it is thrown away.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from services.mapper.back_end import BackEnd, drawn
from services.mapper.keyframe import Keyframe
from services.mapper.loop_closure import Loop, loops_of
from services.mapper.occupancy import Occupancy
from services.mapper.optimisation import optimised
from services.mapper.pose_graph import Optimised
from services.mapper.registration import Match, OdometryError
from shared.service import Job, Out

T = TypeVar("T")

SECOND = 1_000_000_000


class Background:
    """Orders jobs for a back end and takes their results; each result carries the epoch of its order."""

    def __init__(self, back_end: BackEnd) -> None:
        self.back_end = back_end
        self.epoch = -1
        self.start()

    def start(self) -> None:
        """Another map: nothing of the old one counts."""
        self.epoch += 1
        self.back_end.start()
        self.looking = self.optimising = self.drawing = False
        self.outdated = False  # the map's drawing is older than the graph
        self.drawn_at = 0  # ns, when it was last begun
        self.drawn_to = 0  # ns, stamp of the last keyframe in it

    def keep(self, keyframe: Keyframe, match: Match, odometry: OdometryError) -> Out:
        """A keyframe joins the graph; now and then, closures are looked for from it."""
        self.back_end.add(keyframe, match, odometry)
        if self.back_end.due and not self.looking:
            self.looking = True
            yield self._job(loops_of, self.back_end.look(), "looked", 0.05)

    def looked(self, result: tuple[int, list[Loop]]) -> Out:
        """Closures were found, or none."""
        epoch, loops = result
        if epoch == self.epoch:
            self.looking = False
            if self.back_end.close(loops):
                yield from self.settle()

    def settle(self) -> Out:
        """Optimises the graph where it holds closures that are not in the poses yet."""
        if not self.back_end.settled and not self.optimising:
            self.optimising = True
            yield self._job(optimised, self.back_end.optimise(), "corrected", 0.2)

    def corrected(self, result: tuple[int, Optimised]) -> None:
        """The graph has its optimum."""
        epoch, optimum = result
        if epoch == self.epoch:
            self.optimising = False
            self.outdated |= self.back_end.take(optimum)

    def redraw(self, now: int) -> Out:
        """Draws the map anew where the graph has moved, now and then."""
        if self.outdated and not self.drawing and now - self.drawn_at >= self.back_end.config.redraw * SECOND:
            self.outdated, self.drawing, self.drawn_at = False, True, now
            self.drawn_to = self.back_end.keyframes[-1].stamp
            yield self._job(drawn, self.back_end.draw(), "redrawn", 0.5)

    def redrawn(self, result: tuple[int, Occupancy]) -> Occupancy | None:
        """The map drawn anew, with the keyframes that came meanwhile; None where it is another one by now."""
        epoch, grid = result
        if epoch != self.epoch:
            return None
        self.drawing = False
        for keyframe, correction in zip(reversed(self.back_end.keyframes), reversed(self.back_end.corrections())):
            if keyframe.stamp <= self.drawn_to:
                break
            pose = correction @ keyframe.local_from_base
            origins, ends = keyframe.beams()
            grid.integrate(pose @ origins, pose @ ends, np.full_like(ends, np.nan))
        return grid

    def _job(self, function: Callable[..., T], arguments: tuple[Any, ...], done: str, takes: float) -> Job:
        return Job(_at, (self.epoch, function, arguments), done, takes)


def _at(epoch: int, function: Callable[..., T], arguments: tuple[Any, ...]) -> tuple[int, T]:
    """A job's result with the epoch of its order."""
    return epoch, function(*arguments)
