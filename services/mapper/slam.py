# SPDX-License-Identifier: Apache-2.0
"""SLAM: tracks the robot on one map, updates the map and its graph, and relocalizes the robot after it is lost.

The front end places each scan. While the mode is to map, the scan is drawn and its keyframe is added to the back end.
A robot that is lost on a map is searched by global localization; a robot that is lost while mapping begins a new part.

Parts take the place of Cartographer's trajectories and of the map frames of Atlas (Bosse et al., IJRR 2004).
"""

from collections.abc import Iterable
from dataclasses import replace
from math import inf

import numpy as np

from services.mapper.back_end.back_end import BackEnd
from services.mapper.back_end.constraint_search import FoundConstraints
from services.mapper.back_end.keyframe import Keyframe
from services.mapper.back_end.local_map import LocalMap
from services.mapper.back_end.map_jobs import MapJobs
from services.mapper.back_end.map_parts import MIN_FIT, MIN_KEYFRAMES, OdometryGap, certainty_in_part, fits_grid
from services.mapper.back_end.pose_graph import OptimizationResult, rotate_matrix
from services.mapper.config import MapperConfig
from services.mapper.front_end.front_end import FrontEnd
from services.mapper.front_end.scan_alignment import UnmatchedMotion
from services.mapper.front_end.scan_queue import SyncedScan
from services.mapper.front_end.tracking_result import TrackingResult
from services.mapper.grid.map_drawing import Drawing
from services.mapper.grid.map_edits import MapEdits
from services.mapper.grid.occupancy import Occupancy, OccupancyConfig
from services.mapper.localization.global_localization import GlobalLocalizer, PoseHypothesis
from services.mapper.localization.kidnap_detection import KidnapDetector
from services.mapper.maps.map_file import SavedMap
from shared import topics
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import Localization, MapEdit, MapMode, MapUpdate, PoseEstimate
from shared.service import Log, Out

UNKNOWN_POSE_COVARIANCE = np.diag((1e6, 1e6, 10.0))
"""Covariance (m^2, rad^2) of a robot that is not localized yet."""
N_AVERAGED_SCANS = 20.0  # of an unjoined part, over which the share that fits the map is averaged
MAX_LOST_PATH_M, MAX_LOST_TURN_RAD = 0.3, 6.3
"""Motion while lost, a full turn on the spot too, until the whole map is searched: a covered laser may see again."""


class Slam:
    """One map at a time, and the pose of the robot on it.

    max_path_without_closure: m driven on a saved map without a closure, until the pose is poor.
    """

    def __init__(
        self,
        front_end: FrontEnd,
        back_end: BackEnd,
        localizer: GlobalLocalizer,
        kidnap_detector: KidnapDetector,
        occupancy: OccupancyConfig,
        max_path_without_closure: float,
    ) -> None:
        self.front_end, self.back_end, self.localizer = front_end, back_end, localizer
        self.kidnap_detector = kidnap_detector
        self.jobs = MapJobs(back_end)
        self.occupancy, self.max_path_without_closure = occupancy, max_path_without_closure
        self.grid, self.edits = Occupancy(occupancy, 0), MapEdits()
        self.name = ""  # under which the map was saved or loaded; empty: none
        self.tracked: TrackingResult | None = None
        self.odometry_scale = 1.0  # of odometry's standard deviations, the largest since the last keyframe
        self.mode = MapMode.MAP
        self.saved: SavedMap | None = None  # the map of localization, which does not change
        self.known_map_from_local: Pose2 | None = None  # of the next keyframe, which begins a session
        self.lost = UnmatchedMotion()  # motion since the robot was lost
        self.searches_part = False  # global localization searches an unjoined part, which is mapped meanwhile
        self.part_fit = 1.0  # share of the last scans of an unjoined part that fit the map

    def configure(self, config: MapperConfig) -> None:
        """Takes settings of keyframes, closures, drawing and the saved map. Map and pose stay."""
        self.front_end.config, self.kidnap_detector.config = config.front_end, config.kidnap_detection
        self.back_end.config, self.back_end.closure_config = config.back_end, config.loop_closure
        self.max_path_without_closure = config.max_path_without_closure

    @property
    def changes_map(self) -> bool:
        """Whether scans change the map."""
        return self.mode is not MapMode.LOCALISE

    @property
    def map_from_base(self) -> Pose2:
        """Present pose of the robot on the map."""
        return self.back_end.map_from_local @ self.front_end.local_from_base

    def track(self, scan: SyncedScan, now: int) -> TrackingResult:
        """Places a scan, and draws it where the pose is trusted.  now: ns."""
        if self.tracked is None and not self.grid.tile_index:
            self.grid = Occupancy(self.occupancy, max(now, 1))
        self.odometry_scale = max(self.odometry_scale, scan.sigma_factor)
        tracked = self.front_end.track(scan.beams, scan.step, scan.sigma_factor, scan.skew, scan.end, scan.seconds)
        if tracked.trusted and self.is_localized and self.changes_map:
            self._draw(tracked)
        self.tracked = tracked
        return tracked

    @property
    def is_localized(self) -> bool:
        """Whether the pose on the map is known well enough to map on."""
        return self.searches_part or not self.localizer.is_searching

    @property
    def is_in_part(self) -> bool:
        """Whether the robot is in a part that only odometry joins to the rest of the map."""
        return not self.back_end.is_joined

    def _draw(self, tracked: TrackingResult) -> None:
        """Draws a scan. A scan of an unjoined part must fit the map."""
        pose, beams = self.map_from_base, tracked.beams
        origins, ends = pose @ beams.origins, pose @ beams.ends
        if self.is_in_part:
            self.part_fit += (float(fits_grid(self.grid, origins, ends)) - self.part_fit) / N_AVERAGED_SCANS
            if self.back_end.n_in_part < MIN_KEYFRAMES or not fits_grid(self.grid, origins, ends):
                return
        self.grid.insert_scan(origins, ends, pose @ beams.silent)

    def update_graph(self, scan: SyncedScan, tracked: TrackingResult) -> Out:
        """Adds a keyframe to the graph, or to global localization, and reacts to a lost or kidnapped robot."""
        yield from self.front_end.agreement.new_logs()
        if tracked.keyframe is not None and self.front_end.from_keyframes:
            yield from self._add_keyframe(scan, tracked)
        self.lost = self.lost.extended(scan.step, scan.seconds)
        if tracked.state is not Localization.LOST or not self.is_localized or self.front_end.motions_disagree:
            self.lost = UnmatchedMotion()
        is_lost = self.has_graph and (self.lost.path >= MAX_LOST_PATH_M or self.lost.turn >= MAX_LOST_TURN_RAD)
        if is_lost and not self.back_end.is_fixed:
            yield from self._begin_part()
        elif is_lost or self._is_kidnapped(tracked):
            yield from self._start_global_localization()

    def _add_keyframe(self, scan: SyncedScan, tracked: TrackingResult) -> Out:
        assert tracked.keyframe is not None
        keyframe = Keyframe.of(
            stamp=scan.end,
            local_from_base=tracked.local_from_base,
            origins=tracked.beams.origins,
            ends=tracked.beams.ends,
            points=tracked.keyframe.points,
            normals=tracked.keyframe.normals,
            silent=tracked.beams.silent,
            covariance=self.front_end.uncertainty.map_covariance,
            odometry_residual=self.front_end.keyframe_off,
            by_odometry=self.front_end.by_odometry if self.odometry_scale <= 1 else None,
        )
        odometry = self.front_end.odometry_error
        if not self.is_localized:
            yield from self.localizer.add_keyframe(keyframe, tracked.match, self.odometry_scale)
        elif self.known_map_from_local is not None:
            pending = [(keyframe, tracked.match, self.odometry_scale)]
            self.back_end.start_localized(self.known_map_from_local, pending, odometry)
            self.known_map_from_local = None
        else:
            yield from self.jobs.add_keyframe(keyframe, tracked.match, odometry, self.odometry_scale)
            yield from self._localize_part(keyframe, tracked)
        self.odometry_scale = 1.0

    def _begin_part(self) -> Out:
        """Goes on by odometry in a new part of the map, as scans do not fit."""
        front_end, back_end = self.front_end, self.back_end
        local_from_last, self.known_map_from_local = back_end.keyframes[-1].local_from_base, None
        if not back_end.n_in_part:  # the last keyframe is of another session, with another frame
            local_from_last = back_end.map_from_local.inverse() @ back_end.graph.pose(int(back_end.graph.nodes[-1]))
        motion = local_from_last.inverse() @ front_end.dead_reckoned
        back_end.begin_part(OdometryGap(motion, front_end.unmatched.path, front_end.unmatched.turn))
        front_end.start_after_misfits()
        self._end_part_search()
        self.part_fit, self.lost = 1.0, UnmatchedMotion()
        yield Log("WARNING", "scans do not fit: going on by odometry in a new part of the map")

    def _end_part_search(self) -> None:
        self.localizer.load(None)
        self.searches_part = False

    def _localize_part(self, keyframe: Keyframe, tracked: TrackingResult) -> Out:
        """Searches an unjoined part on the whole map, where it does not fit at its pose by odometry."""
        if not self.is_in_part:
            if self.searches_part:
                self._end_part_search()
            return
        is_long = self.back_end.n_in_part >= MIN_KEYFRAMES
        if not self.localizer.is_searching and self.part_fit < MIN_FIT and is_long:
            self.localizer.load(self._map_without_part(), self.back_end.map_from_local)
            self.searches_part = True
        if self.searches_part:
            yield from self.localizer.add_keyframe(keyframe, tracked.match, self.odometry_scale)

    def _is_kidnapped(self, tracked: TrackingResult) -> bool:
        """Whether a map that does not change contradicts the scans."""
        if self.localizer.is_searching or not self.back_end.is_fixed or self.known_map_from_local is not None:
            return False
        pose, beams = self.map_from_base, tracked.beams
        return self.kidnap_detector.is_kidnapped(self.grid, pose @ beams.origins, pose @ beams.ends)

    def estimate(self, scan: SyncedScan, tracked: TrackingResult) -> PoseEstimate:
        """Returns the pose on the map at the end of a scan, with its covariance and state."""
        back_end = self.back_end
        covariance, state = rotate_matrix(tracked.covariance, back_end.map_from_local.yaw), tracked.state
        if not self.is_localized:
            covariance, state = UNKNOWN_POSE_COVARIANCE, Localization.LOST
        elif self.is_in_part:
            gap, n = back_end.gap or back_end.part_gap, back_end.n_in_part
            covariance, state = certainty_in_part(gap, n, self.part_fit, covariance, state)
        elif back_end.is_fixed and back_end.path_since_closure > self.max_path_without_closure:
            state = Localization.POOR if state is Localization.GOOD else state
        return PoseEstimate(
            stamp=scan.end,
            map_from_base=self.map_from_base,
            map_from_odom=self.map_from_base @ scan.odom_from_base.inverse(),
            covariance=np.clip(covariance, -1e12, 1e12).reshape(9),
            quality=tracked.quality,
            state=state,
            mode=self.mode,
        )

    def changed_tiles(self, now: int) -> Out:
        """Publishes the tiles that changed, in as many messages as it takes.  now: ns."""
        while (update := self.grid.next_update(now)) is not None:
            yield topics.MAP(update)

    @property
    def has_graph(self) -> bool:
        """Whether the map has keyframes, which saving and global localization need."""
        return self.front_end.from_keyframes and bool(self.back_end.keyframes)

    @property
    def is_drawing(self) -> bool:
        """Whether the map does not show the present graph yet."""
        return self.jobs.is_drawing or self.back_end.needs_redraw

    def snapshot(self) -> SavedMap:
        """Returns the present map; during localization, the map that was loaded."""
        if self.saved is not None:
            return self.saved
        back_end = self.back_end
        self.grid.update_cells()  # the scans since the last publication
        graph, driven = back_end.graph.snapshot(), np.array(back_end.driven)
        tiles = self.grid.tiles_without_edits(0)
        return SavedMap(graph, tuple(back_end.keyframes), driven, tiles, self.edits.edits)

    def _map_without_part(self) -> SavedMap:
        """Returns the present map without the unjoined part."""
        saved, n = self.snapshot(), self.back_end.first_row
        graph = saved.graph.subgraph_before(self.back_end.first_node)
        return SavedMap(graph, saved.keyframes[:n], saved.driven[:n], saved.tiles, saved.edits)

    def start_map(self, now: int) -> None:
        """Begins an empty map at the robot.  now: ns."""
        self._reset(max(now, self.grid.map_id + 1), None, MapMode.MAP)
        self.front_end.start(Pose2())
        self.localizer.load(None)
        self.tracked = None

    def use_map(self, saved: SavedMap, mode: MapMode, now: int, at: Pose2 | None = None) -> None:
        """Uses a saved map, with the robot near a pose, or anywhere on it.  at: map_from_base.  now: ns."""
        self._reset(max(now, self.grid.map_id + 1), saved.tiles, mode, saved.edits)
        self.front_end.start(at or Pose2())
        self._load_back_end(saved)
        self.localizer.load(saved)
        if at is not None:
            self.localizer.start(window_about=Pose2())
        self.tracked = None

    def switch_mode(self, mode: MapMode) -> None:
        """Keeps the map and the robot's pose, in another mode; a robot in an unjoined part is searched on the rest."""
        if self.changes_map == (mode is not MapMode.LOCALISE):
            return
        is_lost, window_about = self.is_in_part or self.localizer.is_searching, self.localizer.window_about
        saved = (self._map_without_part() if self.is_in_part else self.snapshot()) if self.has_graph else None
        self.mode = mode
        if saved is None:
            return
        map_from_local = self.known_map_from_local or self.back_end.map_from_local
        self.jobs.reset()
        self._load_back_end(saved)
        self.localizer.load(saved if is_lost or not self.changes_map else None)
        self.searches_part = False
        if is_lost:
            self.front_end.start(self.front_end.local_from_base)
            self.localizer.start(window_about)
        else:
            self.back_end.map_from_local = self.known_map_from_local = map_from_local
            self.localizer.is_searching = False

    def _load_back_end(self, saved: SavedMap) -> None:
        self.back_end.load(saved, fixed=not self.changes_map)
        self.edits.anchor(self.back_end.graph.nodes, self.back_end.graph.poses)
        self.back_end.edit_nodes = self.edits.anchor_nodes
        self.kidnap_detector.reset()
        self.saved = saved if not self.changes_map else None

    def use_grid(
        self, tiles: MapUpdate, map_id: int, map_from_base: Pose2, mode: MapMode, edits: Iterable[MapEdit] = ()
    ) -> None:
        """Uses a map without a graph, with the robot near a pose.  tiles: without the edits."""
        grid = OccupancyGrid(tiles.resolution, tiles.map_id)
        grid.apply(tiles)
        self._reset(map_id, tiles, mode, edits)
        self.front_end.load(grid, tiles, map_from_base)
        self.localizer.load(None)

    def on_virtual_keyframes(self, result: tuple[int, SavedMap | None]) -> Out:
        """Gives a map that was loaded without a graph its keyframes."""
        map_id, saved = result
        if saved is not None and map_id == self.grid.map_id:
            self.add_graph(saved)
        return ()

    def add_graph(self, saved: SavedMap) -> bool:
        """Gives a map of tiles its graph. A lost robot is searched, others keep their pose. False if it has a graph."""
        if self.front_end.from_keyframes:
            return False
        self.jobs.reset()
        saved, is_lost = replace(saved, edits=self.edits.edits), self.localizer.is_searching
        self._load_back_end(saved)
        self.known_map_from_local = self.back_end.map_from_local  # `local` is the map's frame
        self.front_end.from_keyframes = True
        self.localizer.load(saved if is_lost or not self.changes_map else None)
        self.localizer.is_searching = False
        if is_lost:
            self._search_whole_map()
        return True

    def on_localized(self, result: tuple[int, list[PoseHypothesis], float]) -> Out:
        """Applies the result of a global localization: joins the part, or begins a session at the pose."""
        if self.searches_part and not self.is_in_part:  # closures joined the part meanwhile
            self._end_part_search()
            return
        window_about = self.localizer.window_about
        map_from_local = self.localizer.accepted_pose(result)
        if map_from_local is not None and self.is_in_part:
            self.back_end.join_localized(map_from_local)
            yield Log("INFO", f"the new part of the map was found on the rest after {self.localizer.driven:.1f} m")
            self._end_part_search()
            yield from self.jobs.optimize()
        elif map_from_local is not None:
            self.kidnap_detector.reset()
            self.back_end.start_localized(map_from_local, self.localizer.pending, self.front_end.odometry_error)
            yield Log("INFO", f"found on the map after {self.localizer.driven:.1f} m")
            self.localizer.pending = []
            if self.changes_map:
                self.back_end.map_shift = inf  # redrawn as a job, as there may be many pending keyframes
                self.localizer.surface = None  # the map will have changed when the robot is lost again
        elif window_about is not None and self.localizer.window_about is None:
            yield Log("WARNING", "the robot is not near the given pose: looking for it on the whole map")

    def on_constraints(self, result: tuple[int, FoundConstraints]) -> Out:
        """Adds the constraints that a search found."""
        yield from self.jobs.on_constraints(result)
        if self.back_end.is_confirmed:
            self.front_end.reset_uncertainty()

    def on_graph_optimized(self, result: tuple[int, OptimizationResult]) -> Out:
        """Applies an optimum: the pose on the map moves now, the map when it is redrawn. Closures make it certain."""
        if result[0] == self.jobs.epoch and self.back_end.optimizes_closures:
            self.front_end.reset_uncertainty()
        return self.jobs.on_graph_optimized(result)

    def on_local_map(self, result: tuple[int, LocalMap]) -> Out:
        """Replaces the submap that the next scans are matched with."""
        submap = self.jobs.on_local_map(result)
        if submap is not None:
            self.front_end.submap = submap
        return ()

    def on_map_drawn(self, result: tuple[int, Drawing], now: int) -> Out:
        """Goes on redrawing the map, and replaces it when the drawing is complete.  now: ns."""
        grid = yield from self.jobs.on_map_drawn(result, now)
        if grid is not None:
            self.grid.replace_with(grid)
            self.edits.follow(self.back_end.graph.nodes, self.back_end.graph.poses)
            self.edits.show(self.grid)

    def _reset(self, map_id: int, tiles: MapUpdate | None, mode: MapMode, edits: Iterable[MapEdit] = ()) -> None:
        self.grid, self.edits, self.name = Occupancy(self.occupancy, map_id), MapEdits(edits), ""
        if tiles is not None:
            self.grid.load(tiles)
            self.edits.show(self.grid)
        self.jobs.reset()
        self.mode, self.saved, self.known_map_from_local, self.lost = mode, None, None, UnmatchedMotion()
        self.searches_part = False

    def _start_global_localization(self) -> Out:
        """Searches the robot on the whole map, as it is lost."""
        if self.localizer.surface is None:
            self.localizer.load(self.snapshot())
        self._search_whole_map()
        yield Log("WARNING", "lost: looking for the robot on the whole map")

    def _search_whole_map(self) -> None:
        self.front_end.start(self.front_end.local_from_base)
        self.back_end.start_unlocalized()
        self.known_map_from_local = None
        self.localizer.start()
