# SPDX-License-Identifier: Apache-2.0
"""A saved map's folder: map.pgm and map.yaml for map_server, graph.msgpack to go on from, map.png for people."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from services.mapper.saved_map import SavedMap, packed, unpacked
from services.mapper.service import MapperService
from shared.grid import OccupancyGrid
from shared.ros_map import ros_map_files
from zenav.picture import map_picture
from zenav.store import read_together, replace_together

Float64s = NDArray[np.float64]

GRAPH = "graph.msgpack"


def map_files(saved: SavedMap, way: Float64s) -> dict[str, bytes]:
    """The folder's files; `way` (n, 3) is drawn into the picture."""
    grid = OccupancyGrid(saved.tiles.resolution, saved.tiles.map_id)
    grid.apply(saved.tiles)
    drawn = ros_map_files(grid.cells, grid.resolution, grid.x0, grid.y0)
    return drawn | {GRAPH: packed(saved), "map.png": map_picture(grid, way)}


def saved_by(mapper: MapperService) -> SavedMap:
    """What another run can go on with."""
    back_end = mapper.back_end
    whole = mapper.grid.whole(0)
    return SavedMap(back_end.graph.snapshot(), tuple(back_end.keyframes), np.array(back_end.driven), whole)


def write_saved_map(folder: Path, saved: SavedMap) -> None:
    """Replaces the folder's map in one step. Raises UserError where the folder refuses; then the old one is whole."""
    replace_together(folder, map_files(saved, saved.graph.poses))


def read_saved_map(folder: Path) -> SavedMap:
    """The map of a folder. Raises UserError where there is none, or it is damaged, foreign or a newer program's."""
    return unpacked(read_together(folder, GRAPH), str(folder / GRAPH))
