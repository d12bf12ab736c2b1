# SPDX-License-Identifier: Apache-2.0
"""The mapper service: scans and odometry in; the robot's pose on the map, and the map, out."""

from services.mapper.back_end.back_end import BackEnd
from services.mapper.back_end.graph_topic import GraphTopic
from services.mapper.config import MapperConfig
from services.mapper.front_end.front_end import FrontEnd
from services.mapper.front_end.scan_queue import ScanQueue, SyncedScan
from services.mapper.grid.map_drawing import Drawing
from services.mapper.localization.global_localization import GlobalLocalizer
from services.mapper.localization.grid_keyframes import order_virtual_keyframes
from services.mapper.localization.kidnap_detection import KidnapDetector
from services.mapper.localization.search_again import SearchAgain
from services.mapper.maps.map_editing import MapEditing
from services.mapper.maps.map_file import SavedMap
from services.mapper.maps.map_transfer import MapDownload, MapUpload, present_map_refusal, tiles_problem
from services.mapper.maps.resume import PreviousRun, graph_checkpoint, resume_from_upload, resume_search
from services.mapper.slam import Slam
from services.mapper.warm_up import warm_up
from shared import requests, topics
from shared.config import Robot
from shared.geometry import Pose2
from shared.messages import LaserScan, MapEdit, MapMode, MapState, MapUpdate, Odometry, OtherRobots, PoseEstimate
from shared.reasons import BAD_REQUEST, MAP_REFUSED
from shared.requests import EditMap, FetchMap, GiveMap, LoadMap, MapPart, NameMap, Reply, StartMap, Watch
from shared.service import Answer, Checkpoint, Log, Out, Service, answer, every, on
from shared.settings import Configuration


class MapperService(Service):
    """SLAM as a service. Each scan takes the steps of `_process_scan`; slow work is done by jobs beside the scans."""

    config_type = MapperConfig

    def __init__(self, config: MapperConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self.config: MapperConfig = config
        range_max = max(laser.range_max for laser in robot.mapping_lasers)
        self.scan_queue = ScanQueue(
            config=config.odometry,
            occupancy=config.occupancy,
            robot=robot,
            blind_doubt=config.blind_sigma_scale,
            rejections=self.rejections,
        )
        self.front_end = FrontEnd(
            config=config.front_end,
            registration=config.registration,
            search=config.search,
            occupancy=config.occupancy,
            range_max=range_max,
            drive=robot.drive,
        )
        self.back_end = BackEnd(
            config=config.back_end,
            closure_config=config.loop_closure,
            graph_config=config.pose_graph,
            registration=config.registration,
            occupancy=config.occupancy,
            range_max=range_max,
        )
        self.slam = slam = Slam(
            front_end=self.front_end,
            back_end=self.back_end,
            localizer=GlobalLocalizer(config.global_localization, config.registration, config.occupancy, range_max),
            kidnap_detector=KidnapDetector(config.kidnap_detection),
            occupancy=config.occupancy,
            max_path_without_closure=config.max_path_without_closure,
        )
        self.previous_run, self.search_again = PreviousRun(), SearchAgain()
        self.download, self.upload, self.editing = MapDownload(), MapUpload(), MapEditing()
        self.graph_topic = GraphTopic()
        # the result of a job goes to the part that ordered it
        self.on_constraints, self.on_graph_optimized = slam.on_constraints, slam.on_graph_optimized
        self.on_local_map, self.on_localized = slam.on_local_map, slam.on_localized
        self.on_virtual_keyframes, self.on_map_packed = slam.on_virtual_keyframes, self.download.on_map_packed

    def warm_up(self) -> None:
        """Compiles all kernels, on a copy of the service."""
        warm_up(type(self)(self.config, self.robot))

    def settings_changed(self, old: Configuration, new: Configuration) -> Out:
        self.slam.configure(new.config)
        return ()

    def state(self) -> str:
        if self.slam.tracked is None:
            return "waiting for a scan"
        pose = str(self.slam.tracked.state) if self.slam.is_localized else "looking for the robot on the map"
        text = f"{self.slam.mode}: {pose}, {len(self.slam.grid.tile_index)} tiles"
        return text + self.scan_queue.state() + self.front_end.agreement.state()

    def _process_scan(self) -> Out:
        """Takes the waiting scan through the pipeline, from the queue to the map."""
        scan = self._synchronized_scan()
        tracked = self.slam.track(scan, self.now)  # match with the local map, draw
        self.scan_queue.set_motion(self.front_end.motion, scan.seconds)
        yield topics.POSE(self.slam.estimate(scan, tracked))
        yield from self.slam.update_graph(scan, tracked)

    def _synchronized_scan(self) -> SyncedScan:
        """Returns the waiting scan with odometry's motion, de-skewed; the first one sets the pose of a previous run."""
        scan = self.scan_queue.pop(self.front_end.odometry_error)
        poses = self.previous_run.take_poses(self.scan_queue.odometry, scan.end, self.robot.drive.max_speed)
        if poses is not None:
            self.front_end.set_guess(poses[0], [poses[1]])
        return scan

    @on(topics.ODOM)
    def odometry(self, odometry: Odometry) -> Out:
        yield from self.scan_queue.add_odometry(odometry, self.now)
        if self.scan_queue.is_covered:
            yield from self._process_scan()

    @on(topics.OTHER_ROBOTS)
    def other_robots(self, others: OtherRobots) -> Out:
        self.scan_queue.robot_mask.others = others
        return self.search_again.on_others(self.slam, others, self.now)

    @on(topics.SCAN)
    def scan(self, scan: LaserScan) -> Out:
        yield from self.scan_queue.check_clock(self.now)
        if self.scan_queue.pending:
            yield from self._process_scan()
        yield from self.scan_queue.add_scan(scan, self.slam.map_from_base, self.now)
        if self.scan_queue.is_covered or self.scan_queue.lacks_odometry(self.now):
            yield from self._process_scan()

    @on(topics.SCAN_2)
    def second_scan(self, scan: LaserScan) -> Out:
        return self.scan_queue.add_second_scan(scan, self.slam.map_from_base, self.now)

    @on(topics.MAP)
    def remember_map(self, update: MapUpdate) -> Out:
        self.previous_run.map = update
        yield from self._resume()

    @on(topics.POSE)
    def remember_pose(self, estimate: PoseEstimate) -> Out:
        self.previous_run.pose = estimate
        yield from self._resume()

    @on(topics.MAP_STATE)
    def remember_map_state(self, state: MapState) -> Out:
        self.previous_run.map_state = state
        yield from self._resume()

    @every(hz=20)
    def release(self) -> Out:
        if self.scan_queue.is_overdue(self.now):
            yield from self._process_scan()

    @every(hz=2)
    def publish_map(self) -> Out:
        """Publishes changed tiles, and redraws the map where the graph has moved."""
        yield from self.slam.changed_tiles(self.now)
        yield from self.editing.changes(self.slam, self.now)
        yield from self.slam.jobs.redraw(self.now)
        self.download.tick(self.now)
        self.upload.tick(self.now)
        yield from self.graph_topic.publications(self.back_end.graph, self.now)

    def on_map_drawn(self, result: tuple[int, Drawing]) -> Out:
        """Goes on redrawing the map, and replaces it when the drawing is complete."""
        return self.slam.on_map_drawn(result, self.now)

    def use_map(self, saved: SavedMap, fixed: bool, at: Pose2 | None = None, name: str = "") -> Out:
        """Uses a saved map, with the robot near a pose, or anywhere on it.

        fixed: the map does not change.  at: map_from_base.
        """
        self.slam.use_map(saved, MapMode.LOCALISE if fixed else MapMode.CONTINUE, self.now, at)
        self.slam.name = name
        self.scan_queue.reset()
        return self.publish_map()

    @answer(requests.FETCH_MAP)
    def fetch_map(self, request: FetchMap) -> Answer[MapPart]:
        return self.download.answer(request, self.slam, self.now)

    @answer(requests.GIVE_MAP)
    def give_map(self, request: GiveMap) -> Answer[Reply]:
        return self.upload.add(request, self.now)

    def on_map_validated(self, result: tuple[int, SavedMap | str]) -> Out:
        """Stores a given map; the graph of the present map, from before a restart, is taken up at once."""
        self.upload.on_map_validated(result)
        return resume_from_upload(self.slam, self.upload, self.now)

    def checkpoint(self) -> Checkpoint | None:
        return graph_checkpoint(self.slam)

    @answer(requests.START_MAP)
    def start_map(self, request: StartMap) -> Answer[Reply]:
        if isinstance(saved := self.upload.take_map(request.transfer, self.now) if request.transfer else None, Reply):
            return saved
        if saved is not None and saved.tiles.resolution != self.config.occupancy.resolution:
            detail = f"it has {saved.tiles.resolution:g} m a cell; set mapper.occupancy.resolution to that"
            return Reply(self.now, False, MAP_REFUSED.code, detail)
        at = request.at[0] if request.at else None
        if request.mode is MapMode.MAP:
            self.slam.start_map(self.now)
            self.scan_queue.reset()
        elif saved is None and (refusal := present_map_refusal(self.slam, request.mode, self.now)) is not None:
            return refusal
        elif saved is None and at is None:
            self.slam.switch_mode(request.mode)
        elif saved is None and not self.slam.has_graph:
            whole = self.slam.grid.tiles_without_edits(self.now)
            return (yield from self._load(whole, at or Pose2(), request.mode, self.slam.edits.edits, self.slam.name))
        else:
            name = request.name if saved is not None else self.slam.name
            yield from self.use_map(saved or self.slam.snapshot(), request.mode is MapMode.LOCALISE, at, name)
        return Reply(self.now, True, "", f"{self.slam.mode}: {len(self.back_end.keyframes)} keyframes")

    @answer(requests.LOAD_MAP)
    def load_map(self, request: LoadMap) -> Answer[Reply]:
        return self._load(request.map, request.map_from_base, MapMode.CONTINUE)

    @answer(requests.EDIT_MAP)
    def edit_map(self, request: EditMap) -> Answer[Reply]:
        return self.editing.edit(request, self.slam, self.now)

    @answer(requests.WATCH_GRAPH)
    def watch_graph(self, request: Watch) -> Answer[Reply]:
        return self.graph_topic.watch(request, self.now)

    @answer(requests.NAME_MAP)
    def name_map(self, request: NameMap) -> Answer[Reply]:
        return self.editing.name(request, self.slam, self.now)

    def _load(
        self, tiles: MapUpdate, at: Pose2, mode: MapMode, edits: tuple[MapEdit, ...] = (), name: str = ""
    ) -> Answer[Reply]:
        """Uses a map without a graph, with the robot near a pose.  tiles: without the edits.  at: map_from_base."""
        if (problem := tiles_problem(tiles)) is not None:
            return Reply(self.now, False, BAD_REQUEST.code, problem)
        self.slam.use_grid(tiles, max(self.now, self.slam.grid.map_id + 1), at, mode, edits)
        self.slam.name = name
        self.scan_queue.reset()
        yield from self.slam.changed_tiles(self.now)
        yield from order_virtual_keyframes(self.slam.grid, tiles)
        return Reply(self.now, True, "", f"{len(tiles.rows)} tiles")

    def _resume(self) -> Out:
        """Uses the map of the run before a restart, once its map and pose are known."""
        if self.previous_run.apply_to(self.slam):
            self.scan_queue.restart()
            yield Log("INFO", f"going on with the map from before the restart: {len(self.slam.grid.tile_index)} tiles")
            yield from resume_search(self.slam)
