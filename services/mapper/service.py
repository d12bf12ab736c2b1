# SPDX-License-Identifier: Apache-2.0
"""The mapper: scans and odometry in, the robot's pose and the map out."""

import numpy as np
from pydantic import Field

from services.mapper.arrivals import Arrivals
from services.mapper.astray import Astray, AstrayConfig
from services.mapper.back_end import BackEnd, BackEndConfig
from services.mapper.correlative_match import SearchConfig
from services.mapper.finding import Finder, FindingConfig, Place
from services.mapper.front_end import FrontEnd, FrontEndConfig
from services.mapper.grid_keyframes import cast
from services.mapper.looks import Looked
from services.mapper.loop_closure import LoopConfig
from services.mapper.map_drawing import Drawing
from services.mapper.mapping import Mapping
from services.mapper.occupancy import Occupancy, OccupancyConfig
from services.mapper.odometry_track import OdometryConfig
from services.mapper.optimisation import PoseGraphConfig
from services.mapper.pose_graph import Optimised
from services.mapper.registration import RegistrationConfig
from services.mapper.restart import Before
from services.mapper.saved_map import SavedMap
from services.mapper.surroundings import Surroundings
from services.mapper.transfer import Incoming, Outgoing
from shared import requests, topics
from shared.config import Robot, Section
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import LaserScan, MapMode, MapUpdate, Odometry, PoseEstimate
from shared.reasons import BAD_REQUEST, BUSY, MAP_REFUSED
from shared.requests import FetchMap, GiveMap, LoadMap, MapPart, Reply, StartMap
from shared.service import Answer, Job, Log, Out, Service, answer, every, on

SECOND = 1_000_000_000
MOST_TILES = 20_000  # of a saved map, 80 MB of cells: a square of 450 m at 0.05 m a cell


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
    """SLAM: scans and odometry in their time, the map with the robot on it, and what is done beside the scans."""

    config_type = MapperConfig

    def __init__(self, config: MapperConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self.config: MapperConfig = config
        range_max = robot.laser.range_max
        self.arrivals = Arrivals(config.odometry, config.occupancy, robot, config.blind_doubt, self.rejections)
        self.front_end = FrontEnd(
            config.front_end, config.registration, config.search, config.occupancy, range_max, robot.drive
        )
        self.back_end = BackEnd(
            config.back_end, config.loops, config.pose_graph, config.registration, config.occupancy, range_max
        )
        self.finder = Finder(config.finding, config.registration, config.occupancy, range_max)
        astray = Astray(config.astray)
        self.mapping = Mapping(self.front_end, self.back_end, self.finder, astray, config.occupancy, config.unheld)
        self.before = Before()
        self.outgoing, self.incoming = Outgoing(), Incoming()

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
        other.front_end.submap.registrar.extend(
            np.ascontiguousarray(0.3 * np.argwhere(np.ones((60, 60)))), np.zeros((3600, 2))
        )  # until it grows
        if other.mapping.tracked is not None and other.back_end.keyframes:
            other.back_end.add(other.back_end.keyframes[0], other.mapping.tracked.match, other.front_end.odometry_error)
            other.back_end.rehearse()
        list(other.publish_map())
        load = LoadMap(other.now, other.grid.whole(other.now), Pose2())
        for item in other.load_map(load):
            if isinstance(item, Job):
                other.on_cast(item.function(*item.arguments))

    @property
    def grid(self) -> Occupancy:
        """The map."""
        return self.mapping.grid

    def state(self) -> str:
        if self.mapping.tracked is None:
            return "waiting for a scan"
        found = "looking for the robot on the map" if not self.mapping.placed else str(self.mapping.tracked.state)
        words = f"{self.mapping.mode}: {found}, {len(self.grid.places)} tiles"
        dropped = sum(self.arrivals.n_dropped.values())
        words += f", {dropped} scans dropped" if dropped else ""
        return words + (", no odometry: scan matching alone" if self.arrivals.blind else "")

    @on(topics.ODOM)
    def odometry(self, odometry: Odometry) -> Out:
        yield from self.arrivals.hear(odometry, self.now)
        if self.arrivals.covered:
            yield from self._place()

    @on(topics.SCAN)
    def scan(self, scan: LaserScan) -> Out:
        yield from self.arrivals.heard_clock(self.now)
        if self.arrivals.pending:
            yield from self._place()
        yield from self.arrivals.file(scan, self.now)
        if self.arrivals.covered or self.arrivals.hopeless:
            yield from self._place()

    @on(topics.MAP)
    def remember_map(self, update: MapUpdate) -> Out:
        """Our own map from before a restart."""
        self.before.map = update
        yield from self._take_up()

    @on(topics.POSE)
    def remember_pose(self, estimate: PoseEstimate) -> Out:
        """Our own pose from before a restart."""
        self.before.pose = estimate
        yield from self._take_up()

    @every(hz=20)
    def release(self) -> Out:
        """A scan does not wait for odometry for ever."""
        if self.arrivals.waited(self.now):
            yield from self._place()

    @every(hz=2)
    def publish_map(self) -> Out:
        """What changed; and where the graph has moved, the map is drawn anew now and then."""
        yield from self.mapping.publish(self.now)
        yield from self.mapping.loops.redraw(self.now)
        self.outgoing.tick(self.now)
        self.incoming.tick(self.now)

    def looked(self, result: tuple[int, Looked]) -> Out:
        """Closures were found, or none."""
        yield from self.mapping.loops.looked(result)
        if self.back_end.confirmed:
            self.front_end.settle()

    def settle(self) -> Out:
        """Optimises the graph where it holds closures that are not in the poses yet."""
        return self.mapping.loops.settle()

    def corrected(self, result: tuple[int, Optimised]) -> Out:
        """The graph has its optimum: the pose on the map moves now, the map when it is drawn."""
        self.front_end.settle()
        return self.mapping.loops.corrected(result)

    def renewed(self, result: tuple[int, Surroundings]) -> Out:
        """What the next scans are matched with is gathered anew."""
        submap = self.mapping.loops.renewed(result)
        if submap is not None:
            self.front_end.submap = submap
        return ()

    def redrawn(self, result: tuple[int, Drawing]) -> Out:
        """The map, or a part of it, is drawn anew."""
        grid = yield from self.mapping.loops.redrawn(result, self.now)
        if grid is not None:
            self.grid.become(grid)

    def found(self, result: tuple[int, list[Place], float]) -> Out:
        """The robot was looked for on the saved map."""
        return self.mapping.found(result)

    def copied(self, result: tuple[int, bytes]) -> Out:
        """A copy of the map is ready to be fetched."""
        self.outgoing.take(result)
        return ()

    def checked(self, result: tuple[int, SavedMap | str]) -> Out:
        """A map that was given is whole, or not."""
        self.incoming.take(result)
        return ()

    def go_on(self, saved: SavedMap, fixed: bool, at: Pose2 | None = None) -> Out:
        """Goes on with a saved map, near a pose, or wherever on it the robot is; `fixed`: the map stays as it is."""
        self.mapping.go_on(saved, MapMode.LOCALISE if fixed else MapMode.CONTINUE, self.now, at)
        self.arrivals.start()
        return self.publish_map()

    @answer(requests.FETCH_MAP)
    def fetch_map(self, request: FetchMap) -> Answer[MapPart]:
        return self.outgoing.answer(request, self.mapping, self.now)

    @answer(requests.GIVE_MAP)
    def give_map(self, request: GiveMap) -> Answer[Reply]:
        return self.incoming.add(request, self.now)

    @answer(requests.START_MAP)
    def start_map(self, request: StartMap) -> Answer[Reply]:
        saved = self.incoming.given(request.transfer, self.now) if request.transfer else None
        if isinstance(saved, Reply):
            return saved
        if saved is not None and saved.tiles.resolution != self.config.occupancy.resolution:
            told = f"it has {saved.tiles.resolution:g} m a cell; set mapper.occupancy.resolution to that"
            return Reply(self.now, False, MAP_REFUSED.code, told)
        at = request.at[0] if request.at else None
        if request.mode is MapMode.MAP:
            self.mapping.begin(self.now)
            self.arrivals.start()
        elif saved is None and self.mapping.drawing:
            return Reply(self.now, False, BUSY.code, "the map is being drawn anew")
        elif saved is None and at is None:
            self.mapping.switch(request.mode)
        elif saved is None and not self.mapping.has_graph:
            whole = self.grid.whole(self.now)
            return (yield from self._load(whole, at or Pose2(), request.mode))
        else:
            yield from self.go_on(saved or self.mapping.snapshot(), request.mode is MapMode.LOCALISE, at)
        return Reply(self.now, True, "", f"{self.mapping.mode}: {len(self.back_end.keyframes)} keyframes")

    @answer(requests.LOAD_MAP)
    def load_map(self, request: LoadMap) -> Answer[Reply]:
        return self._load(request.map, request.map_from_base, MapMode.CONTINUE)

    def _load(self, tiles: MapUpdate, at: Pose2, mode: MapMode) -> Answer[Reply]:
        """Goes on with a map that has no graph, from near a pose."""
        rows, columns = tiles.rows, tiles.columns
        if len(rows) and (int(np.ptp(rows)) + 1) * (int(np.ptp(columns)) + 1) > MOST_TILES:
            return Reply(self.now, False, BAD_REQUEST.code, "the map's tiles lie too far apart to be one building")
        grid = OccupancyGrid(tiles.resolution, tiles.map_id)
        grid.apply(tiles)
        if not grid.occupied.any():
            return Reply(self.now, False, BAD_REQUEST.code, "the map holds no occupied cell to find the robot by")
        self.mapping.load(tiles, grid, max(self.now, self.grid.map_id + 1), at, mode)
        self.arrivals.start()
        yield from self.mapping.publish(self.now)
        if tiles.resolution == self.config.occupancy.resolution:
            yield Job(cast, (self.grid.map_id, tiles), "on_cast", 1.0)
        return Reply(self.now, True, "", f"{len(rows)} tiles")

    def on_cast(self, result: tuple[int, SavedMap | None]) -> Out:
        """A map that came without a graph has keyframes."""
        map_id, saved = result
        if saved is not None and map_id == self.grid.map_id and not self.front_end.graphed:
            self.mapping.add_keyframes(saved)
        return ()

    def _take_up(self) -> Out:
        """Goes on with the map of before the restart, where odometry says that the robot is on it by now."""
        known = self.before.known()
        if known is not None:
            update, grid, estimate = known
            mode = MapMode.LOCALISE if estimate.mode is MapMode.LOCALISE else MapMode.CONTINUE
            self.mapping.load(update, grid, update.map_id, estimate.map_from_base, mode)
            self.grid.version = update.version
            self.mapping.tracked, self.arrivals.last_end, self.arrivals.velocity = None, -1, Pose2()
            yield Log("INFO", f"going on with the map from before the restart: {len(update.rows)} tiles")

    def _place(self) -> Out:
        """Places the scan that waits."""
        arrival = self.arrivals.take(self.front_end.odometry_error)
        moved = self.before.whereabouts(self.arrivals.track, arrival.end, self.robot.drive.max_speed)
        if moved is not None:
            self.front_end.local_from_base, self.front_end.other_starts = moved[0], [moved[1]]
        tracked = self.mapping.place(arrival, self.now)
        self.arrivals.moved(self.front_end.motion, arrival.seconds)
        yield topics.POSE(self.mapping.estimate(arrival, tracked))
        yield from self.mapping.join(arrival, tracked)
