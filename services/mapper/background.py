# SPDX-License-Identifier: Apache-2.0
"""What goes on beside the scans: looks for closures, optimisations, and drawing the map anew, each a Job.

One of a kind runs at a time. What one finds may come when the map is another one by then: it is thrown away.
"""

from collections.abc import Callable, Generator
from typing import Any, TypeVar

from services.mapper.back_end import BackEnd
from services.mapper.keyframe import Keyframe
from services.mapper.looks import Looked, looked
from services.mapper.map_drawing import Drawing, drawn
from services.mapper.occupancy import Occupancy
from services.mapper.odometry_error import OdometryError
from services.mapper.optimisation import optimised
from services.mapper.pose_graph import Optimised
from services.mapper.registration import Match
from services.mapper.submap import Submap
from services.mapper.surroundings import Surroundings, surroundings
from shared.service import Job, Out

T = TypeVar("T")

SECOND = 1_000_000_000
FEW = 2  # keyframes that came while the map was drawn, and are drawn at once at the end


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
        self.looking = self.optimising = self.drawing = self.renewing = False
        self.begun = self.drawn_at = 0  # ns, when the last drawing began and ended
        self.n_joints = 0  # when the last optimisation began

    def keep(self, keyframe: Keyframe, match: Match, odometry: OdometryError, doubt: float = 1.0) -> Out:
        """A keyframe joins the graph, as `BackEnd.add` says; now and then, closures are looked for from it."""
        self.back_end.add(keyframe, match, odometry, doubt)
        if self.back_end.due and not self.looking:
            self.looking = True
            yield self._job(looked, self.back_end.look(), "looked", 0.05)
        yield from self._renew()

    def looked(self, result: tuple[int, Looked]) -> Out:
        """Closures were found, or none."""
        epoch, found = result
        if epoch == self.epoch:
            self.looking = False
            self.back_end.close(found.loops)
            self.back_end.tie(found.ties)
            if self.back_end.urgent:
                yield from self.settle()

    def settle(self) -> Out:
        """Optimises the graph where it holds closures that are not in the poses yet."""
        if not self.back_end.settled and not self.optimising:
            self.optimising, self.n_joints = True, self.back_end.n_joints
            yield self._job(optimised, self.back_end.optimise(), "corrected", 0.2)

    def corrected(self, result: tuple[int, Optimised]) -> Out:
        """The graph has its optimum; what was found meanwhile may ask for the next one."""
        epoch, optimum = result
        if epoch == self.epoch:
            self.optimising = False
            if self.n_joints != self.back_end.n_joints:  # a part was moved meanwhile
                self.back_end.off = True
            else:
                self.back_end.take(optimum)
            yield from self._renew()
            if self.back_end.urgent:
                yield from self.settle()

    def _renew(self) -> Out:
        """Gathers what the next scans are matched with anew, where the robot or the graph has moved on."""
        if self.back_end.moved_on and not self.renewing:
            self.renewing = True
            yield self._job(surroundings, self.back_end.around(), "renewed", 0.2)

    def renewed(self, result: tuple[int, Surroundings]) -> Submap | None:
        """What the next scans are matched with; None where the map or the robot is another one's by now."""
        epoch, drawn = result
        if epoch != self.epoch:
            return None
        self.renewing = False
        return self.back_end.completed(drawn)

    def redraw(self, now: int) -> Out:
        """Draws the map anew where the graph has moved, now and then: of a large one at most half of the time."""
        pause = max(self.back_end.config.redraw * SECOND, self.drawn_at - self.begun)
        rests = 0 <= now - self.drawn_at < pause  # a clock that was set back is no rest
        if self.back_end.outdated and not self.drawing and not rests:
            self.drawing, self.begun = True, now
            yield self._job(drawn, (self.back_end.draw(),), "redrawn", 0.2)

    def redrawn(self, result: tuple[int, Drawing], now: int) -> Generator[Job, None, Occupancy | None]:
        """A slice of the map is drawn anew: goes on with the next, and with the keyframes that came meanwhile.

        Returns the map when all is in it, until then None, and always where it is another one by now.
        """
        epoch, drawing = result
        if epoch != self.epoch:
            return None
        if not drawing.keyframes:
            drawing = self.back_end.newer(drawing)
            if len(drawing.keyframes) <= FEW:
                self.drawing, self.drawn_at = False, now
                return drawn(drawing).grid
        yield self._job(drawn, (drawing,), "redrawn", 0.2)
        return None

    def _job(self, function: Callable[..., T], arguments: tuple[Any, ...], done: str, takes: float) -> Job:
        return Job(_at, (self.epoch, function, arguments), done, takes)


def _at(epoch: int, function: Callable[..., T], arguments: tuple[Any, ...]) -> tuple[int, T]:
    """A job's result with the epoch of its order."""
    return epoch, function(*arguments)
