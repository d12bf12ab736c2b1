# SPDX-License-Identifier: Apache-2.0
"""Maps as files, and in the terminal."""

from pathlib import Path

import numpy as np

from shared.config import UserError, nearest
from shared.grid import OccupancyGrid, update_of_cells
from shared.messages import MapUpdate
from shared.reasons import NO_SUCH_MAP
from shared.ros_map import read_ros_map, ros_map_files
from shared.types import Int8s
from zenav.maps.atomic_folder import replace_together, settle
from zenav.maps.saved_map import GRAPH
from zenav.render.map_picture import map_picture

MAPS_FOLDER = Path("maps")
YAML = "map.yaml"


def picture_files(grid: OccupancyGrid) -> dict[str, bytes]:
    """The files of a map without a pose graph, for zenav.maps.atomic_folder; one that lies there is of another map."""
    ros_files = ros_map_files(grid.cells, grid.resolution, grid.x0, grid.y0)
    return ros_files | {"map.png": map_picture(grid, np.zeros((0, 3))), GRAPH: b""}


def write_map(grid: OccupancyGrid, folder: Path) -> Path:
    """Writes a map without a pose graph; returns the YAML's path. Raises UserError where the folder refuses."""
    replace_together(folder, picture_files(grid))
    return folder / YAML


def grid_from_update(update: MapUpdate) -> OccupancyGrid:
    """The grid that an update with every tile makes."""
    grid = OccupancyGrid(update.resolution, update.map_id)
    grid.apply(update)
    return grid


def find_map(place: str) -> Path:
    """The YAML of a map given as a name below maps/, a folder, or a path. Raises UserError."""
    for path in (Path(place), Path(place) / YAML, MAPS_FOLDER / place / YAML):
        if path.name == YAML:
            settle(path.parent)
        if path.is_file():
            return path
    saved = tuple(sorted(p.parent.name for p in MAPS_FOLDER.glob(f"*/{YAML}")))
    raise UserError(
        f"{NO_SUCH_MAP.text}: {place}", nearest(place, saved) if saved else "save one: zenav map save office"
    )


def folder_for(place: str) -> Path:
    """The folder of a map to be written: a name is one below maps/, anything else a path."""
    return MAPS_FOLDER / place if place.replace("_", "").replace("-", "").isalnum() else Path(place)


def grid_of(path: Path) -> OccupancyGrid:
    """A saved map as a grid of whole tiles. Its lower left corner is moved to a whole cell."""
    return grid_from_update(update_of(path))


def update_of(path: Path) -> MapUpdate:
    """A saved map as the message that carries it: see update_of_cells."""
    return update_of_cells(*read_ros_map(path))


def coarse_cells(cells: Int8s, step: int) -> Int8s:
    """(h, w) int8 -> one cell for step x step: the most occupied of them, so that walls stay."""
    h, w = -(-cells.shape[0] // step), -(-cells.shape[1] // step)
    padded = np.full((h * step, w * step), -1, np.int8)
    padded[: cells.shape[0], : cells.shape[1]] = cells
    return np.asarray(padded.reshape(h, step, w, step).max(axis=(1, 3)))
