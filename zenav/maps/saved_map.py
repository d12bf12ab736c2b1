# SPDX-License-Identifier: Apache-2.0
"""A saved map's folder: map.pgm and map.yaml for map_server, graph.msgpack to go on from, map.png for people."""

from pathlib import Path

from services.mapper.grid.edit_cells import with_edits
from services.mapper.maps.map_file import SavedMap, pack_map, unpack_map
from shared.grid import OccupancyGrid
from shared.ros_map import ros_map_files
from shared.types import Float64s
from zenav.maps.atomic_folder import read_together, replace_together
from zenav.render.map_picture import map_picture

GRAPH = "graph.msgpack"


def map_files(saved: SavedMap, trajectory: Float64s) -> dict[str, bytes]:
    """The folder's files; `trajectory` (n, 3) is drawn into the picture. Both pictures contain the edits."""
    grid = OccupancyGrid(saved.tiles.resolution, saved.tiles.map_id)
    grid.apply(with_edits(saved.tiles, saved.edits) if saved.edits else saved.tiles)
    ros_files = ros_map_files(grid.cells, grid.resolution, grid.x0, grid.y0)
    return ros_files | {GRAPH: pack_map(saved), "map.png": map_picture(grid, trajectory)}


def write_saved_map(folder: Path, saved: SavedMap) -> None:
    """Replaces the folder's map in one step. Raises UserError where the folder refuses; then the old one is whole."""
    replace_together(folder, map_files(saved, saved.graph.poses))


def read_saved_map(folder: Path) -> SavedMap:
    """The map of a folder. Raises UserError where there is none, or it is damaged, foreign or a newer program's."""
    return unpack_map(read_together(folder, GRAPH), str(folder / GRAPH))
