# SPDX-License-Identifier: Apache-2.0
"""Resumption after a restart: the last published map and pose, the pose by odometry since then, and the pose graph."""

from dataclasses import replace
from typing import Any

import numpy as np

from services.mapper.front_end.continuous_odometry import ContinuousOdometry
from services.mapper.grid.edit_cells import without_walls
from services.mapper.grid.occupancy import Occupancy
from services.mapper.localization.grid_keyframes import order_virtual_keyframes
from services.mapper.maps.map_file import SavedMap, pack_map
from services.mapper.maps.map_transfer import MapUpload
from services.mapper.slam import Slam
from shared.geometry import Pose2
from shared.grid import OCCUPIED_FROM
from shared.messages import TILE_CELLS, Localization, MapMode, MapState, MapUpdate, Message, PoseEstimate, Stamp
from shared.requests import GIVE_MAP, MAP_PART, GiveMap, Request
from shared.service import Checkpoint, Log, Out
from shared.types import NS_PER_S

NO_TILES = MapUpdate(
    stamp=0,
    map_id=0,
    version=0,
    resolution=0.05,
    rows=np.zeros(0, np.int32),
    columns=np.zeros(0, np.int32),
    cells=np.zeros((0, TILE_CELLS**2), np.int8),
)
MAX_JUMP_M = 0.5  # of the resumed pose, beyond what the robot can drive


class PreviousRun:
    """The latched messages of the mapper's previous run, as they arrive."""

    def __init__(self) -> None:
        self.map: MapUpdate | None = None
        self.pose: PoseEstimate | None = None
        self.map_state: MapState | None = None

    def apply_to(self, slam: Slam) -> bool:
        """Goes on with the map, its edits and the pose; False until they arrived, or without occupied cells.

        A robot that was lost stays lost until it is found on the map.
        What lies below the edits follows with the graph. Until then it is unknown below walls, and free where erased.
        """
        if self.map is None or self.pose is None or not (self.map.cells >= OCCUPIED_FROM).any():
            return False
        state = self.map_state
        edits, name = ((), "") if state is None or state.map_id != self.map.map_id else (state.edits, state.name)
        tiles = without_walls(self.map, edits) if edits else self.map
        mode = MapMode.LOCALISE if self.pose.mode is MapMode.LOCALISE else MapMode.CONTINUE
        slam.use_grid(tiles, self.map.map_id, self.pose.map_from_base, mode, edits)
        slam.name, slam.grid.version, slam.tracked = name, self.map.version, None
        can_search = slam.grid.resolution == slam.occupancy.resolution
        slam.localizer.is_searching = self.pose.state is Localization.LOST and can_search
        return True

    def take_poses(self, track: ContinuousOdometry, end: int, max_speed: float) -> tuple[Pose2, Pose2] | None:
        """Returns the present map_from_base by odometry, and the last published one; once, for the first scan.

        end: ns, of that scan.  max_speed: m/s.  None if odometry was restarted too.
        """
        last, self.pose = self.pose, None
        if last is None or self.map is None or not track.samples:
            return None
        guess = last.map_from_odom @ track.odom_from_start(end) @ track.start_from_base(end)
        max_distance = max_speed * max(end - last.stamp, 0) / NS_PER_S + MAX_JUMP_M
        return (guess, last.map_from_base) if guess.distance(last.map_from_base) <= max_distance else None


def resume_search(slam: Slam) -> Out:
    """Orders keyframes to find a lost robot by, as a checkpoint with a graph may not come."""
    if slam.localizer.is_searching:
        slam.grid.update_cells()
        yield from order_virtual_keyframes(slam.grid, slam.grid.tiles_without_edits(0))


def resume_graph(slam: Slam, checkpoint: SavedMap) -> bool:
    """Gives the map from before a restart its graph, and what lies below its edits. Returns False if it has a graph."""
    if slam.front_end.from_keyframes:
        return False
    slam.grid.load_below_edits(checkpoint.tiles)
    slam.grid.update_cells()  # those of the latched map may not be published yet
    return slam.add_graph(replace(checkpoint, tiles=slam.grid.tiles_without_edits(0)))


def resume_from_upload(slam: Slam, upload: MapUpload, now: Stamp) -> Out:
    """Takes up the graph of the present map, from before a restart, where it was given."""
    if not upload.resumes or upload.transfer != slam.grid.map_id:
        return
    saved = upload.take_map(upload.transfer, now)
    if isinstance(saved, SavedMap) and resume_graph(slam, saved):
        yield Log("INFO", f"going on with the pose graph from before the restart: {len(saved.keyframes)} keyframes")


def graph_checkpoint(slam: Slam) -> Checkpoint | None:
    """Returns the pose graph with its keyframes as parts for the next process; None where there is none to go on with.

    The tiles are in the latched map; the checkpoint has those below edits, without the edits. An unjoined part is left
    out: its place is not known.
    """
    if not slam.has_graph or not slam.is_localized or slam.is_in_part:
        return None
    back_end, saved = slam.back_end, slam.saved
    if saved is None:
        saved = SavedMap(back_end.graph.snapshot(), tuple(back_end.keyframes), np.array(back_end.driven), NO_TILES)
    version = slam.grid.map_id, saved.graph.nodes.tobytes(), saved.graph.poses.tobytes(), slam.edits.n_changes
    saved = replace(saved, tiles=_tiles_below_edits(slam.grid), edits=())
    return Checkpoint(version, _requests, (saved, slam.grid.map_id))


def _tiles_below_edits(grid: Occupancy) -> MapUpdate:
    """Returns the tiles with edits, without the edits."""
    if not grid.edits:
        return replace(NO_TILES, resolution=grid.resolution)
    tiles = grid.tiles_without_edits(0)
    places = zip(tiles.rows.tolist(), tiles.columns.tolist())
    return tiles.only(np.array([place in grid.edits for place in places], np.bool_))


def _requests(saved: SavedMap, map_id: int) -> list[tuple[Request[Any, Any], Message]]:
    content = pack_map(saved)
    parts = [content[i : i + MAP_PART] for i in range(0, len(content), MAP_PART)]
    return [(GIVE_MAP, GiveMap(0, map_id, i, len(parts), part, resumes=True)) for i, part in enumerate(parts)]
