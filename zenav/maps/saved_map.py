# SPDX-License-Identifier: Apache-2.0
"""A saved map's folder: map.pgm and map.yaml for map_server, graph.msgpack to go on from, map.png for people."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from services.mapper.grid.edit_cells import with_edits
from services.mapper.maps.map_file import SavedMap, pack_map, unpack_map
from shared.grid import OccupancyGrid
from shared.ros_map import ros_map_files
from shared.types import Float64s
from zenav.maps.atomic_folder import read_together, replace_together
from zenav.render.map_picture import map_picture

GRAPH = "graph.msgpack"
MAX_SPEED = 5.0  # m/s; faster from one keyframe to the next is another drive, of another robot or a merged map


def map_files(saved: SavedMap, trajectory: Float64s) -> dict[str, bytes]:
    """The folder's files. Both pictures contain the edits.

    trajectory: (n, 3) is drawn into map.png; a row of NaN interrupts it.
    """
    grid = OccupancyGrid(saved.tiles.resolution, saved.tiles.map_id)
    grid.apply(with_edits(saved.tiles, saved.edits) if saved.edits else saved.tiles)
    ros_files = ros_map_files(grid.cells, grid.resolution, grid.x0, grid.y0)
    return ros_files | {GRAPH: pack_map(saved), "map.png": map_picture(grid, trajectory)}


def write_saved_map(folder: Path, saved: SavedMap) -> None:
    """Replaces the folder's map in one step. Raises UserError where the folder refuses; then the old one is whole."""
    replace_together(folder, map_files(saved, with_gaps(saved.graph.poses, [k.stamp for k in saved.keyframes])))


def with_gaps(poses: Float64s, stamps: Sequence[int]) -> Float64s:
    """Returns the poses (n, 3) with a row of NaN before each that begins another drive.  stamps: n, ns."""
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    begins = np.flatnonzero(steps > np.diff(stamps) / 1e9 * MAX_SPEED) + 1
    return np.insert(poses, begins, np.nan, axis=0)


def read_saved_map(folder: Path) -> SavedMap:
    """The map of a folder. Raises UserError where there is none, or it is damaged, foreign or a newer program's."""
    return unpack_map(read_together(folder, GRAPH), str(folder / GRAPH))
