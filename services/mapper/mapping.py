# SPDX-License-Identifier: Apache-2.0
"""The map and the robot on it: each scan is placed by the front end, and joins the map that the back end holds
together, unless the mode is to leave the map as it is. Where the robot is lost, it is looked for until it is found.
"""

from math import hypot, inf

import numpy as np

from services.mapper.arrivals import Arrival
from services.mapper.astray import Astray
from services.mapper.back_end import BackEnd
from services.mapper.background import Background
from services.mapper.finding import PART_REST, Finder, Place
from services.mapper.front_end import FrontEnd
from services.mapper.keyframe import Keyframe
from services.mapper.occupancy import Occupancy, OccupancyConfig
from services.mapper.parts import FITS, MIN_KEYFRAMES, Gap, fits, gap_information
from services.mapper.pose_graph import turned
from services.mapper.saved_map import SavedMap
from services.mapper.tracking_result import Tracked
from shared import topics
from shared.geometry import Float64s, Pose2
from shared.grid import OccupancyGrid
from shared.messages import Localization, MapMode, MapUpdate, PoseEstimate
from shared.service import Log, Out

ANYWHERE = np.diag((1e6, 1e6, 10.0))
"""Covariance (m^2, rad^2) of a robot that was not found on its map yet."""
FITTING = 20.0  # scans of an unjoined part, over which the share of those that fit the map is averaged
AWAY = 0.3
"""m driven while lost until the robot is looked for everywhere: a laser that was covered may see again at its place."""


class Mapping:
    """One map at a time, and what places the robot on it.

    unheld: m driven on a saved map without a closure, until the pose is poor.
    """

    def __init__(
        self,
        front_end: FrontEnd,
        back_end: BackEnd,
        finder: Finder,
        astray: Astray,
        occupancy: OccupancyConfig,
        unheld: float,
    ) -> None:
        self.front_end, self.back_end, self.finder, self.astray = front_end, back_end, finder, astray
        self.loops = Background(back_end)
        self.occupancy, self.unheld = occupancy, unheld
        self.grid = Occupancy(occupancy, 0)
        self.tracked: Tracked | None = None
        self.doubt = 1.0  # the largest since the last keyframe
        self.mode = MapMode.MAP
        self.saved: SavedMap | None = None  # what is left as it is
        self.known: Pose2 | None = None  # map_from_local of the next keyframe, which begins a session
        self.lost_for = 0.0  # m driven since the robot was lost
        self.seeks_part = False  # the finder looks for a part that is not joined, beside mapping it
        self.share = 1.0  # of the last scans of a part that is not joined, that fit the map at its place

    @property
    def changes(self) -> bool:
        """Whether the map does."""
        return self.mode is not MapMode.LOCALISE

    @property
    def map_from_base(self) -> Pose2:
        return self.back_end.map_from_local @ self.front_end.local_from_base

    def place(self, arrival: Arrival, now: int) -> Tracked:
        """Places a scan, and draws it where it is trusted."""
        if self.tracked is None and not self.grid.places:
            self.grid = Occupancy(self.occupancy, max(now, 1))
        self.doubt = max(self.doubt, arrival.doubt)
        tracked = self.front_end.track(
            arrival.origins, arrival.ends, arrival.step, arrival.doubt, arrival.skew, arrival.end, arrival.seconds
        )
        if tracked.trusted and self.placed and self.changes:
            self._draw(arrival, tracked)
        self.tracked = tracked
        return tracked

    @property
    def placed(self) -> bool:
        """Whether it is known where on the map the robot is, well enough to map on."""
        return self.seeks_part or not self.finder.searching

    @property
    def in_part(self) -> bool:
        """Whether the robot is in a part of the map that only odometry joins to the rest."""
        return not self.back_end.joined

    def _draw(self, arrival: Arrival, tracked: Tracked) -> None:
        """Draws a scan. One of a part that is not joined to the rest may add to the map, not change it."""
        pose = self.map_from_base
        origins, ends = pose @ tracked.origins, pose @ tracked.ends
        if self.in_part:
            self.share += (float(fits(self.grid, origins, ends)) - self.share) / FITTING
            if self.back_end.n_in_part < MIN_KEYFRAMES or not fits(self.grid, origins, ends):
                return
        self.grid.integrate(origins, ends, pose @ arrival.silent)

    def join(self, arrival: Arrival, tracked: Tracked) -> Out:
        """A placed scan joins the graph where the robot has moved on, or helps to find it."""
        if tracked.keyframe is not None and self.front_end.graphed:
            keyframe = Keyframe.of(
                arrival.end, tracked.local_from_base, tracked.origins, tracked.ends, arrival.silent, tracked.keyframe,
                self.front_end.belief.carried, self.front_end.off,
            )  # fmt: skip
            if not self.placed:
                yield from self.finder.keep(keyframe, tracked.match, self.doubt)
            elif self.known is not None:
                waiting = [(keyframe, tracked.match, self.doubt)]
                self.back_end.found(self.known, waiting, self.front_end.odometry_error)
                self.known = None
            else:
                yield from self.loops.keep(keyframe, tracked.match, self.front_end.odometry_error, self.doubt)
                yield from self._look_for_part(keyframe, tracked)
            self.doubt = 1.0
        self.lost_for += hypot(arrival.step.x, arrival.step.y)
        if tracked.state is not Localization.LOST or not self.placed or self.front_end.at_odds:
            self.lost_for = 0.0
        if self.lost_for >= AWAY and self.has_graph and not self.back_end.fixed:
            yield from self._begin_part()
        elif (self.lost_for >= AWAY and self.has_graph) or self._is_astray(tracked):
            yield from self._carried_away()

    def _begin_part(self) -> Out:
        """Scans do not fit while mapping: goes on by odometry in a new part of the map."""
        front_end, back_end = self.front_end, self.back_end
        motion = back_end.keyframes[-1].local_from_base.inverse() @ front_end.reckoned
        back_end.begin_part(Gap(motion, front_end.unfit_path, front_end.unfit_turn))
        front_end.start(front_end.reckoned)
        self._stop_seeking()
        self.share, self.lost_for = 1.0, 0.0
        yield Log("WARNING", "scans do not fit: going on by odometry in a new part of the map")

    def _stop_seeking(self) -> None:
        self.finder.load(None)
        self.seeks_part = False

    def _look_for_part(self, keyframe: Keyframe, tracked: Tracked) -> Out:
        """Looks for a part on the whole map where odometry puts it at a place that it does not fit."""
        if not self.in_part:
            if self.seeks_part:
                self._stop_seeking()
            return
        if not self.finder.searching and self.share < FITS and self.back_end.n_in_part >= MIN_KEYFRAMES:
            self.finder.load(self._earlier(), PART_REST)
            self.finder.about = self.back_end.map_from_local
            self.seeks_part = True
        if self.seeks_part:
            yield from self.finder.keep(keyframe, tracked.match, self.doubt)

    def _is_astray(self, tracked: Tracked) -> bool:
        """Whether a map that does not change says that the robot is somewhere else."""
        if self.finder.searching or not self.back_end.fixed or self.known is not None:
            return False
        pose = self.map_from_base
        return self.astray.weigh(self.grid, pose @ tracked.origins, pose @ tracked.ends)

    def estimate(self, arrival: Arrival, tracked: Tracked) -> PoseEstimate:
        """Where the robot is, as of a placed scan."""
        covariance, state = turned(tracked.covariance, self.back_end.map_from_local.yaw), tracked.state
        if not self.placed:
            covariance, state = ANYWHERE, Localization.LOST
        elif self.in_part:
            covariance, state = self._unjoined(covariance, state)
        elif self.back_end.fixed and self.back_end.unheld > self.unheld and state is Localization.GOOD:
            state = Localization.POOR
        return PoseEstimate(
            arrival.end,
            self.map_from_base,
            self.map_from_base @ arrival.odom_from_base.inverse(),
            np.clip(covariance, -1e12, 1e12).reshape(9),
            tracked.quality,
            state,
            self.mode,
        )

    def _unjoined(self, covariance: Float64s, state: Localization) -> tuple[Float64s, Localization]:
        """Covariance and state of a robot in a part that only odometry joins to the rest of the map."""
        gap = self.back_end.gap or self.back_end.bridged
        covariance = covariance + np.linalg.inv(gap_information(gap.path, gap.turn))
        stands = self.back_end.n_in_part >= MIN_KEYFRAMES and self.share >= FITS
        if state is Localization.LOST or not stands:
            return covariance, Localization.LOST
        return covariance, Localization.POOR

    def publish(self, now: int) -> Out:
        """The tiles that changed."""
        update = self.grid.update(now)
        if update is not None:
            yield topics.MAP(update)

    @property
    def has_graph(self) -> bool:
        """Whether there are keyframes to save, to localise by and to look for the robot with."""
        return self.front_end.graphed and bool(self.back_end.keyframes)

    @property
    def drawing(self) -> bool:
        """Whether the map is not yet what the graph says."""
        return self.loops.drawing or self.back_end.outdated

    def snapshot(self) -> SavedMap:
        """The present map; one that is left as it is, as it was loaded."""
        if self.saved is not None:
            return self.saved
        back_end = self.back_end
        self.grid.settle()  # what was drawn since it was published
        whole = self.grid.whole(0)
        return SavedMap(back_end.graph.snapshot(), tuple(back_end.keyframes), np.array(back_end.driven), whole)

    def _earlier(self) -> SavedMap:
        """The present map without the part that is not joined to it."""
        saved, n = self.snapshot(), self.back_end.session
        return SavedMap(saved.graph.before(self.back_end.first), saved.keyframes[:n], saved.driven[:n], saved.tiles)

    def begin(self, now: int) -> None:
        """A new, empty map, that begins where the robot is."""
        self._anew(max(now, self.grid.map_id + 1), None, MapMode.MAP)
        self.front_end.start(Pose2())
        self.finder.load(None)
        self.tracked = None

    def go_on(self, saved: SavedMap, mode: MapMode, now: int, at: Pose2 | None = None) -> None:
        """Goes on with a saved map, near a pose, or wherever on it the robot is."""
        self._anew(max(now, self.grid.map_id + 1), saved.tiles, mode)
        self.front_end.start(at or Pose2())
        self._take(saved)
        self.finder.load(saved)
        if at is not None:
            self.finder.start(near=Pose2())
        self.tracked = None

    def switch(self, mode: MapMode) -> None:
        """Goes on with the present map in another mode, and with the robot where it is."""
        if self.changes == (mode is not MapMode.LOCALISE):
            return
        saved = self.snapshot() if self.has_graph else None
        self.mode = mode
        if saved is None:
            return
        if self.finder.searching:
            near = self.finder.near
            self.loops.start()
            self._take(saved)
            self.finder.load(saved)
            self.front_end.start(self.front_end.local_from_base)
            self.finder.start(near)
            return
        map_from_local = self.known or self.back_end.map_from_local
        self.loops.start()
        self._take(saved)
        self.back_end.map_from_local = self.known = map_from_local
        self.finder.load(saved if not self.changes else None)
        self.finder.searching = False

    def _take(self, saved: SavedMap) -> None:
        self.back_end.load(saved, fixed=not self.changes)
        self.astray.start()
        self.saved = saved if not self.changes else None

    def load(self, tiles: MapUpdate, grid: OccupancyGrid, map_id: int, map_from_base: Pose2, mode: MapMode) -> None:
        """Goes on with a map that has no graph, from near a pose; grid: the tiles'."""
        self._anew(map_id, tiles, mode)
        self.front_end.load(grid, tiles, map_from_base)
        self.finder.load(None)

    def add_keyframes(self, saved: SavedMap) -> None:
        """The map that was loaded without a graph has one now; the robot keeps its place, and closures hold it."""
        self.loops.start()
        self._take(saved)
        self.known = self.back_end.map_from_local  # `local` is the map's frame
        self.front_end.graphed = True
        self.finder.load(saved if not self.changes else None)
        self.finder.searching = False

    def found(self, result: tuple[int, list[Place], float]) -> Out:
        """The robot was looked for on the map."""
        near = self.finder.near
        map_from_local = self.finder.take(result)
        if map_from_local is not None and self.in_part:
            self.back_end.join_found(map_from_local)
            yield Log("INFO", f"the new part of the map was found on the rest after {self.finder.driven:.1f} m")
            self._stop_seeking()
            yield from self.loops.settle()
        elif map_from_local is not None:
            self.astray.start()
            self.back_end.found(map_from_local, self.finder.waiting, self.front_end.odometry_error)
            yield Log("INFO", f"found on the map after {self.finder.driven:.1f} m")
            self.finder.waiting = []
            if self.changes:
                self.back_end.moved = inf  # drawn beside the scans: many keyframes may have waited
                self.finder.surface = None  # it will be another map when the robot is lost again
        elif near is not None and self.finder.near is None:
            yield Log("WARNING", "the robot is not near the given pose: looking for it on the whole map")

    def _anew(self, map_id: int, tiles: MapUpdate | None, mode: MapMode) -> None:
        self.grid = Occupancy(self.occupancy, map_id)
        if tiles is not None:
            self.grid.load(tiles)
        self.loops.start()
        self.mode, self.saved, self.known, self.lost_for = mode, None, None, 0.0
        self.seeks_part = False

    def _carried_away(self) -> Out:
        """The robot is lost: it may be anywhere."""
        if self.finder.surface is None:
            self.finder.load(self.snapshot())
        self.front_end.start(self.front_end.local_from_base)
        self.back_end.part()
        self.known = None
        self.finder.start()
        yield Log("WARNING", "lost: looking for the robot on the whole map")
