# SPDX-License-Identifier: Apache-2.0
"""The map and the robot on it: each scan is placed by the front end, and joins the map that the back end holds
together; on a saved map, the robot is looked for until it is found.
"""

import numpy as np

from services.mapper.arrivals import Arrival
from services.mapper.back_end import BackEnd
from services.mapper.background import Background
from services.mapper.finding import Finder, Place
from services.mapper.front_end import FrontEnd, Tracked
from services.mapper.keyframe import Keyframe
from services.mapper.occupancy import Occupancy, OccupancyConfig
from services.mapper.pose_graph import turned
from services.mapper.saved_map import SavedMap
from shared import topics
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import Localization, MapUpdate, PoseEstimate
from shared.service import Log, Out

ANYWHERE = np.diag((1e6, 1e6, 10.0))
"""Covariance (m^2, rad^2) of a robot that was not found on its map yet."""


class Mapping:
    """One map at a time, and what places the robot on it.

    unheld: m driven on a saved map without a closure, until the pose is poor.
    """

    def __init__(
        self, front_end: FrontEnd, back_end: BackEnd, finder: Finder, occupancy: OccupancyConfig, unheld: float
    ) -> None:
        self.front_end, self.back_end, self.finder = front_end, back_end, finder
        self.loops = Background(back_end)
        self.occupancy, self.unheld = occupancy, unheld
        self.grid = Occupancy(occupancy, 0)
        self.tracked: Tracked | None = None
        self.doubt = 1.0  # the largest since the last keyframe

    @property
    def map_from_base(self) -> Pose2:
        return self.back_end.map_from_local @ self.front_end.local_from_base

    def place(self, arrival: Arrival, now: int) -> Tracked:
        """Places a scan, and draws it where it is trusted."""
        if self.tracked is None and not self.grid.places:
            self.grid = Occupancy(self.occupancy, max(now, 1))
        self.doubt = max(self.doubt, arrival.doubt)
        self.tracked = self.front_end.track(arrival.origins, arrival.ends, arrival.step, arrival.doubt)
        if self.tracked.trusted and not self.finder.searching and not self.back_end.fixed:
            pose = self.map_from_base
            self.grid.integrate(pose @ arrival.origins, pose @ arrival.ends, pose @ arrival.silent)
        return self.tracked

    def join(self, arrival: Arrival, tracked: Tracked) -> Out:
        """A placed scan joins the graph where the robot has moved on, or helps to find it."""
        if tracked.keyframe is not None and self.front_end.window.moves:
            keyframe = Keyframe.of(
                arrival.end, tracked.local_from_base, arrival.origins, arrival.ends, arrival.silent, tracked.keyframe
            )
            if self.finder.searching:
                yield from self.finder.keep(keyframe, tracked.match, self.doubt)
            else:
                yield from self.loops.keep(keyframe, tracked.match, self.front_end.odometry_error, self.doubt)
            self.doubt = 1.0
        if tracked.state is Localization.LOST and self.finder.surface is not None:
            yield from self._carried_away()

    def estimate(self, arrival: Arrival, tracked: Tracked) -> PoseEstimate:
        """Where the robot is, as of a placed scan."""
        covariance, state = turned(tracked.covariance, self.back_end.map_from_local.yaw), tracked.state
        if self.finder.searching:
            covariance, state = ANYWHERE, Localization.STARTING
        elif self.back_end.fixed and self.back_end.unheld > self.unheld and state is Localization.GOOD:
            state = Localization.POOR
        return PoseEstimate(
            arrival.end,
            self.map_from_base,
            self.map_from_base @ arrival.odom_from_base.inverse(),
            np.clip(covariance, -1e12, 1e12).reshape(9),
            tracked.quality,
            state,
        )

    def publish(self, now: int) -> Out:
        """The tiles that changed."""
        update = self.grid.update(now)
        if update is not None:
            yield topics.MAP(update)

    def go_on(self, saved: SavedMap, fixed: bool, now: int) -> None:
        """Goes on with a saved map, wherever on it the robot is; `fixed`: it only localises, and the map stays."""
        self._anew(max(now, self.grid.map_id + 1), saved.tiles)
        self.front_end.start(Pose2())
        self.back_end.load(saved, fixed)
        self.finder.load(saved)
        self.tracked = None

    def load(self, tiles: MapUpdate, grid: OccupancyGrid, map_id: int, map_from_base: Pose2) -> None:
        """Goes on with a map that has no graph, from near a pose; grid: the tiles'."""
        self._anew(map_id, tiles)
        self.front_end.load(grid, tiles, map_from_base)
        self.finder.load(None)

    def found(self, result: tuple[int, list[Place]]) -> Out:
        """The robot was looked for on the saved map."""
        map_from_local = self.finder.take(result)
        if map_from_local is not None:
            self.back_end.found(map_from_local, self.finder.waiting, self.front_end.odometry_error)
            for keyframe, _, _ in self.finder.waiting if not self.back_end.fixed else ():
                keyframe.draw(self.grid, map_from_local @ keyframe.local_from_base)
            self.finder.waiting = []
            yield Log("INFO", f"found on the map after {self.finder.driven:.1f} m")

    def _anew(self, map_id: int, tiles: MapUpdate) -> None:
        self.grid = Occupancy(self.occupancy, map_id)
        self.grid.load(tiles)
        self.loops.start()

    def _carried_away(self) -> Out:
        """The robot is lost on a saved map: it may be anywhere."""
        self.front_end.start(self.front_end.local_from_base)
        self.back_end.part()
        self.finder.start()
        yield Log("WARNING", "lost: looking for the robot on the whole map")
