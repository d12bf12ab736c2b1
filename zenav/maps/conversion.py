# SPDX-License-Identifier: Apache-2.0
"""`zenav map convert`: maps of ROS map_server into a folder that the stack loads, and the stack's for map_server."""

import sys
from math import degrees
from pathlib import Path
from typing import Literal

import numpy as np

from shared.config import UserError
from shared.grid import UNKNOWN, OccupancyGrid, update_of_cells
from shared.ros_map import read_turned_ros_map, ros_map_files
from shared.types import Int8s
from zenav.maps.atomic_folder import replace_together
from zenav.maps.map_files import find_map
from zenav.maps.rotated_map import axis_aligned
from zenav.maps.saved_map import GRAPH
from zenav.render.map_picture import map_picture

Mode = Literal["trinary", "scale", "raw"]


def convert(place: str, out: Path, mode: Mode, negate: bool, force: bool) -> None:
    """Writes map.yaml, its picture and map.png into the folder `out`. Raises UserError.

    A map that is turned is turned back: its cells are then the nearest ones, and walls keep their thickness at least.
    """
    path = find_map(place)
    cells, resolution, x0, y0, yaw = read_turned_ros_map(path)
    if (out / "map.yaml").exists() and not force:
        raise UserError(f"there is a map in {out}", "choose another folder, or overwrite it: --force")
    if out.resolve() in (path.parent.resolve(), path.resolve().parent):  # whose picture may have the same name
        raise UserError(f"{out} is the folder of what is to be read", "choose another folder")
    if abs(yaw) > 1e-6:
        cells, x0, y0 = axis_aligned(cells, resolution, x0, y0, yaw)
        sys.stderr.write(f"{path} is turned by {degrees(yaw):.1f} degrees: it was turned back, to the nearest cells\n")
    write(out, cells, resolution, x0, y0, mode, negate)
    seen = float((cells != UNKNOWN).mean()) * 100
    size = cells.shape[1] * resolution, cells.shape[0] * resolution
    sys.stdout.write(f"{out}/map.yaml: {size[0]:.1f} x {size[1]:.1f} m, {resolution:g} m a cell, {seen:.0f} % known\n")


def write(
    out: Path, cells: Int8s, resolution: float, x0: float, y0: float, mode: Mode = "trinary", negate: bool = False
) -> None:
    """The folder's files, all or none; a pose graph that lies there is of another map. Raises UserError."""
    files = {"map.pgm": b"", GRAPH: b""} | ros_map_files(cells, resolution, x0, y0, "map", mode, negate)
    if mode != "scale":  # whose picture has that name
        grid = OccupancyGrid(resolution)
        grid.apply(update_of_cells(cells, resolution, x0, y0))
        files["map.png"] = map_picture(grid, np.zeros((0, 3)))
    replace_together(out, files)
