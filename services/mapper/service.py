# SPDX-License-Identifier: Apache-2.0
"""The mapper: scans and odometry in, the robot's pose and the map out."""

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from services.mapper.astray import Astray, AstrayConfig
from services.mapper.back_end import BackEnd, BackEndConfig, Drawing
from services.mapper.background import Background
from services.mapper.correlative_match import SearchConfig
from services.mapper.deskew import deskewed
from services.mapper.finding import Finder, FindingConfig, Place
from services.mapper.front_end import FrontEnd, FrontEndConfig, Tracked
from services.mapper.keyframe import Keyframe
from services.mapper.loop_closure import Loop, LoopConfig
from services.mapper.occupancy import Occupancy, OccupancyConfig
from services.mapper.odometry_track import OdometryConfig, OdometryTrack
from services.mapper.optimisation import PoseGraphConfig
from services.mapper.pose_graph import Optimised, turned
from services.mapper.registration import RegistrationConfig
from services.mapper.saved_map import SavedMap
from shared import requests, topics
from shared.config import Robot, Section
from shared.geometry import Pose2, interpolated
from shared.grid import OccupancyGrid
from shared.messages import LaserScan, Localization, MapUpdate, Odometry, PoseEstimate
from shared.reasons import BAD_REQUEST
from shared.requests import LoadMap, Reply
from shared.service import Answer, Log, Out, Service, answer, every, on

Float64s = NDArray[np.float64]

SECOND = 1_000_000_000
OLDEST = SECOND  # a scan that is older when it arrives says where the robot was, not where it is
MOST_TILES = 20_000  # of a saved map, 80 MB of cells: a square of 450 m at 0.05 m a cell
FUTURE = SECOND // 2  # a stamp that is farther ahead is another clock's
ANYWHERE = np.diag((1e6, 1e6, 10.0))
"""Covariance (m^2, rad^2) of a robot that was not found on its map yet."""


class MapperConfig(Section):
    """The mapper."""

    registration: RegistrationConfig = RegistrationConfig()
    search: SearchConfig = SearchConfig()
    front_end: FrontEndConfig = FrontEndConfig()
    odometry: OdometryConfig = OdometryConfig()
    occupancy: OccupancyConfig = OccupancyConfig()
    back_end: BackEndConfig = BackEndConfig()
    loops: LoopConfig = LoopConfig()
    pose_graph: PoseGraphConfig = PoseGraphConfig()
    finding: FindingConfig = FindingConfig()
    astray: AstrayConfig = AstrayConfig()
    unheld: float = Field(
        15.0, ge=1, le=10_000, description="m driven on a saved map without a closure, until the pose is poor"
    )
    blind_doubt: float = Field(
        5.0, ge=1, le=100, description="how much wider the prior is when speed alone is known, without odometry"
    )


class MapperService(Service):
    """SLAM: front end, back end and the map. A scan waits until odometry covers its end, but not for long."""

    config_type = MapperConfig

    def __init__(self, config: MapperConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self.config: MapperConfig = config
        self.track = OdometryTrack(config.odometry, robot.drive)
        self.front_end = FrontEnd(
            config.front_end, config.registration, config.search, config.occupancy, robot.laser.range_max
        )
        self.back_end = BackEnd(
            config.back_end, config.loops, config.pose_graph, config.registration, config.occupancy,
            robot.laser.range_max,
        )  # fmt: skip
        self.loops = Background(self.back_end)
        self.finder = Finder(config.finding, config.registration, config.occupancy, robot.laser.range_max)
        self.astray = Astray(config.astray)
        self.grid = Occupancy(config.occupancy, 0)
        self.pending: tuple[int, LaserScan] | None = None  # when it came, and the scan
        self.last_end = -1  # ns, end of the last scan that was placed
        self.velocity = Pose2()  # motion a second between the last two scans
        self.blind = False  # the last scan was placed without odometry
        self.doubt = 1.0  # the largest since the last keyframe
        self.tracked: Tracked | None = None
        self.n_dropped = {"old": 0, "late": 0, "ahead": 0}
        self.map_before: MapUpdate | None = None  # what was published last before a restart
        self.pose_before: PoseEstimate | None = None

    def warm(self) -> None:
        """Runs a copy of the whole path on a made-up room."""
        other = type(self)(self.config, self.robot)
        laser = self.robot.laser
        angles = laser.angle_min + laser.angle_increment * np.arange(laser.n_beams)
        for i in range(4):
            ranges = np.minimum(2.0 + 0.01 * i, 1.0 / np.maximum(np.abs(np.cos(angles)), 0.2)).astype(np.float32)
            stamp = (i + 1) * SECOND
            other.now = stamp + SECOND
            list(other.odometry(Odometry(stamp, Pose2(0.3 * i, 0, 0), 0.3, 0.0, np.zeros(9))))
            scan = LaserScan(
                stamp, laser.angle_min, laser.angle_increment, 0.0, laser.range_min, laser.range_max, ranges
            )
            list(other.scan(scan))
            other.front_end.searches_next = True
        beams = np.zeros((laser.n_beams, 2))
        other.grid.contradicts(beams, beams)
        other.grid.occupied_near(beams)
        other.front_end.window.active.registrar.extend(
            np.ascontiguousarray(0.3 * np.argwhere(np.ones((60, 60)))), np.zeros((3600, 2))
        )  # until it grows
        if other.tracked is not None and other.back_end.keyframes:
            other.back_end.add(other.back_end.keyframes[0], other.tracked.match, other.front_end.odometry_error)
            other.back_end.rehearse()
        list(other.publish_map())
        load = LoadMap(other.now, other.grid.whole(other.now), Pose2())
        list(other.load_map(load))

    def state(self) -> str:
        if self.tracked is None:
            return "waiting for a scan"
        found = "looking for the robot on the map" if self.finder.searching else str(self.tracked.state)
        words = f"{found}, {len(self.grid.places)} tiles"
        dropped = sum(self.n_dropped.values())
        words += f", {dropped} scans dropped" if dropped else ""
        return words + (", no odometry: scan matching alone" if self.blind else "")

    @on(topics.ODOM)
    def odometry(self, odometry: Odometry) -> Out:
        if odometry.stamp > self.now + FUTURE:
            return
        if odometry.stamp < self.track.newest - SECOND and odometry.stamp > self.now - SECOND:
            self.track.clear()  # the clock was set back
            self.blind = True
        jumps = self.track.n_jumps
        if self.track.add(odometry, broken=self.blind and self.track.newest <= self.last_end):
            if self.track.n_jumps > jumps:
                yield Log("WARNING", "odometry jumped farther than the robot can drive: the pose on the map stays")
            if self.pending and odometry.stamp >= _end(self.pending[1]):
                yield from self._place_pending()

    @on(topics.SCAN)
    def scan(self, scan: LaserScan) -> Out:
        end = _end(scan)
        if self.now < self.last_end - SECOND:
            yield Log("WARNING", "the clock was set back: going on from here")
            self.last_end = -1
            self.pending = None
        if self.pending:
            yield from self._place_pending()
        if end <= self.last_end:
            yield from self._drop("old")
        elif end > self.now + FUTURE:
            yield from self._drop("ahead")
        elif end < self.now - OLDEST:
            yield from self._drop("late")
        else:
            self.pending = self.now, scan
            if self.track.newest >= end or self._odometry_is_silent(end):
                yield from self._place_pending()

    @on(topics.MAP)
    def remember_map(self, update: MapUpdate) -> Out:
        """Our own map from before a restart."""
        self.map_before = update
        yield from self._take_up()

    @on(topics.POSE)
    def remember_pose(self, estimate: PoseEstimate) -> Out:
        """Our own pose from before a restart."""
        self.pose_before = estimate
        yield from self._take_up()

    @every(hz=20)
    def release(self) -> Out:
        """A scan does not wait for odometry for ever."""
        if self.pending and self.now - self.pending[0] >= self.config.odometry.late * SECOND:
            yield from self._place_pending()

    @every(hz=2)
    def publish_map(self) -> Out:
        """What changed; and where the graph has moved, the map is drawn anew now and then."""
        update = self.grid.update(self.now)
        if update is not None:
            yield topics.MAP(update)
        yield from self.loops.redraw(self.now)

    def looked(self, result: tuple[int, list[Loop]]) -> Out:
        """Closures were found, or none."""
        return self.loops.looked(result)

    def settle(self) -> Out:
        """Optimises the graph where it holds closures that are not in the poses yet."""
        return self.loops.settle()

    def corrected(self, result: tuple[int, Optimised]) -> Out:
        """The graph has its optimum: the pose on the map moves now, the map when it is drawn."""
        return self.loops.corrected(result)

    def redrawn(self, result: tuple[int, Drawing]) -> Out:
        """The map, or a part of it, is drawn anew."""
        grid = yield from self.loops.redrawn(result, self.now)
        if grid is not None:
            self.grid.become(grid)

    def found(self, result: tuple[int, list[Place]]) -> Out:
        """The robot was looked for on the saved map."""
        map_from_local = self.finder.take(result)
        if map_from_local is not None:
            self.astray.start()
            self.back_end.found(map_from_local, self.finder.waiting, self.front_end.odometry_error)
            for keyframe, _, _ in self.finder.waiting if not self.back_end.fixed else ():
                keyframe.draw(self.grid, map_from_local @ keyframe.local_from_base)
            self.finder.waiting = []
            yield Log("INFO", f"found on the map after {self.finder.driven:.1f} m")

    def go_on(self, saved: SavedMap, fixed: bool) -> Out:
        """Goes on with a saved map, wherever on it the robot is; `fixed`: it only localises, and the map stays."""
        self.grid = Occupancy(self.config.occupancy, max(self.now, self.grid.map_id + 1))
        self.grid.load(saved.tiles)
        self.front_end.start(Pose2())
        self.loops.start()
        self.back_end.load(saved, fixed)
        self.finder.load(saved)
        self.pending, self.velocity, self.tracked = None, Pose2(), None
        return self.publish_map()

    def _carried_away(self) -> Out:
        """The robot is lost on a saved map: it may be anywhere."""
        self.front_end.start(self.front_end.local_from_base)
        self.back_end.part()
        self.finder.start()
        yield Log("WARNING", "lost: looking for the robot on the whole map")

    @answer(requests.LOAD_MAP)
    def load_map(self, request: LoadMap) -> Answer[Reply]:
        rows, columns = request.map.rows, request.map.columns
        if len(rows) and (int(np.ptp(rows)) + 1) * (int(np.ptp(columns)) + 1) > MOST_TILES:
            return Reply(self.now, False, BAD_REQUEST.code, "the map's tiles lie too far apart to be one building")
        grid = OccupancyGrid(request.map.resolution, request.map.map_id)
        grid.apply(request.map)
        if not grid.occupied.any():
            return Reply(self.now, False, BAD_REQUEST.code, "the map holds no occupied cell to find the robot by")
        self.grid = Occupancy(self.config.occupancy, max(self.now, self.grid.map_id + 1))
        self.grid.load(request.map)
        self.front_end.load(grid, request.map, request.map_from_base)
        self.loops.start()
        self.finder.load(None)
        self.pending = None
        self.velocity = Pose2()
        update = self.grid.update(self.now)
        if update is not None:
            yield topics.MAP(update)
        return Reply(self.now, True, "", f"{len(request.map.rows)} tiles")

    def _take_up(self) -> Out:
        """Goes on with the map of before the restart, where odometry says that the robot is on it by now."""
        update, estimate = self.map_before, self.pose_before
        if update is None or estimate is None:
            return
        grid = OccupancyGrid(update.resolution, update.map_id)
        grid.apply(update)
        if grid.occupied.any():
            self.grid = Occupancy(self.config.occupancy, update.map_id)
            self.grid.load(update)
            self.grid.version = update.version
            self.front_end.load(grid, update, estimate.map_from_base)
            self.loops.start()
            self.finder.load(None)
            self.tracked, self.last_end, self.velocity = None, -1, Pose2()
            yield Log("INFO", f"going on with the map from before the restart: {len(update.rows)} tiles")

    def _moved_meanwhile(self, end: int) -> None:
        """Where the robot is after a restart: odometry went on meanwhile, unless it was restarted too."""
        before, self.pose_before = self.pose_before, None
        if before is None or self.map_before is None or not self.track.samples:
            return
        guess = before.map_from_odom @ self.track.odom_from_start(end) @ self.track.at(end)
        farthest = self.robot.drive.max_speed * max(end - before.stamp, 0) / SECOND + 0.5
        if guess.distance(before.map_from_base) <= farthest:
            self.front_end.local_from_base = guess
            self.front_end.other_starts = [before.map_from_base]

    def _drop(self, why: str) -> Out:
        self.n_dropped[why] += 1
        if self.n_dropped[why] == 1 or self.n_dropped[why] % 100 == 0:
            yield Log("WARNING", f"scan dropped: its stamp is {why} ({self.n_dropped[why]} so far)")

    def _odometry_is_silent(self, end: int) -> bool:
        return not self.track.samples or self.track.newest < end - self.config.odometry.timeout * SECOND

    def _place_pending(self) -> Out:
        assert self.pending is not None
        scan, self.pending = self.pending[1], None
        end = _end(scan)
        self.blind = self._odometry_is_silent(end)
        seconds = (end - self.last_end) * 1e-9 if self.last_end >= 0 else 0.0
        self._moved_meanwhile(end)
        step = self._step(end, seconds)
        times, motion = self._motion(scan, end)
        origins, ends = deskewed(scan, self.robot.laser.mount, times, motion)
        if self.tracked is None and not self.grid.places:
            self.grid = Occupancy(self.config.occupancy, max(self.now, 1))
        before = self.front_end.local_from_base
        doubt = self.config.blind_doubt if self.blind else 1.0
        self.doubt = max(self.doubt, doubt)
        tracked = self.front_end.track(origins, ends, step, doubt)
        moved = before.inverse() @ tracked.local_from_base
        self.velocity = _scaled(moved, 1 / seconds) if 0.02 <= seconds <= 1 else Pose2()
        silent = self._silent(scan, origins, ends)
        if tracked.trusted and not self.finder.searching and not self.back_end.fixed:
            pose = self.map_from_base
            self.grid.integrate(pose @ origins, pose @ ends, pose @ silent)
        self.last_end, self.tracked = end, tracked
        yield topics.POSE(self._estimate(end, tracked))
        if tracked.keyframe is not None and self.front_end.window.moves:
            keyframe = Keyframe.of(end, tracked.local_from_base, origins, ends, silent, tracked.keyframe)
            if self.finder.searching:
                yield from self.finder.keep(keyframe, tracked.match, self.doubt)
            else:
                yield from self.loops.keep(keyframe, tracked.match, self.front_end.odometry_error, self.doubt)
            self.doubt = 1.0
        if self.finder.surface is not None and (tracked.state is Localization.LOST or self._astray(origins, ends)):
            yield from self._carried_away()

    def _astray(self, origins: Float64s, ends: Float64s) -> bool:
        """Whether the saved map says that the robot is somewhere else."""
        if self.finder.searching or not self.back_end.fixed:
            return False
        pose = self.map_from_base
        return self.astray.weigh(self.grid, pose @ origins, pose @ ends)

    @property
    def map_from_base(self) -> Pose2:
        return self.back_end.map_from_local @ self.front_end.local_from_base

    def _step(self, end: int, seconds: float) -> Pose2:
        """The motion since the last placed scan: by odometry, or at the last known speed."""
        if self.last_end < 0:
            return Pose2()
        if self.blind:
            return _scaled(self.velocity, min(seconds, 1.0))
        return self.track.at(self.last_end).inverse() @ self.track.at(end)

    def _motion(self, scan: LaserScan, end: int) -> tuple[Float64s, Float64s]:
        if not self.blind:
            times, motion = self.track.during(scan.stamp, end)
            error = self.front_end.odometry_error
            return times, motion * (error.forward.gain, error.forward.gain, error.turn.gain)
        back = _scaled(self.velocity, scan.scan_time).inverse()
        return np.array((-scan.scan_time, 0.0)), np.array(((back.x, back.y, back.yaw), (0.0, 0.0, 0.0)))

    def _silent(self, scan: LaserScan, origins: Float64s, ends: Float64s) -> Float64s:
        """Where beams without an echo were free, in `base`; NaN where they say nothing, which is the default."""
        out = np.full_like(ends, np.nan)
        share = self.config.occupancy.no_echo_free
        if share > 0:
            none = np.isnan(scan.ranges) | (scan.ranges >= scan.range_max)
            angles = self.robot.laser.mount.yaw + scan.angle_min + scan.angle_increment * np.flatnonzero(none)
            reach = share * min(scan.range_max, self.config.occupancy.range_max)
            out[none] = origins[none] + reach * np.column_stack((np.cos(angles), np.sin(angles)))
        return out

    def _estimate(self, end: int, tracked: Tracked) -> PoseEstimate:
        if self.track.samples:
            odom_from_base = self.track.odom_from_start(end) @ self.track.at(end)
        else:
            odom_from_base = Pose2()
        covariance, state = turned(tracked.covariance, self.back_end.map_from_local.yaw), tracked.state
        if self.finder.searching:
            covariance, state = ANYWHERE, Localization.STARTING
        elif self.back_end.fixed and self.back_end.unheld > self.config.unheld and state is Localization.GOOD:
            state = Localization.POOR
        return PoseEstimate(
            end,
            self.map_from_base,
            self.map_from_base @ odom_from_base.inverse(),
            np.clip(covariance, -1e12, 1e12).reshape(9),
            tracked.quality,
            state,
        )


def _end(scan: LaserScan) -> int:
    return scan.stamp + round(scan.scan_time * SECOND)


def _scaled(motion: Pose2, factor: float) -> Pose2:
    return interpolated(Pose2(), motion, factor)
