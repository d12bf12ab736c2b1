# SPDX-License-Identifier: Apache-2.0
"""Maps as files, and in the terminal."""

import sys
from math import degrees
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shared import topics
from shared.config import UserError, load_robot, nearest
from shared.grid import OccupancyGrid, update_of_cells
from shared.messages import Localization, MapUpdate, PoseEstimate
from shared.reasons import NO_MAP, NO_SUCH_MAP, POSE_LOST
from shared.ros_map import read_ros_map, ros_map_files
from shared.runners.transport import where_from
from zenav.client import Client
from zenav.picture import map_picture
from zenav.saved_map import GRAPH
from zenav.store import replace_together

Int8s = NDArray[np.int8]

FOLDER = Path("maps")
WIDEST = 100  # characters of a map in the terminal


def picture_files(grid: OccupancyGrid) -> dict[str, bytes]:
    """The files of a map without a pose graph, for zenav.store; one that lies there is of another map."""
    drawn = ros_map_files(grid.cells, grid.resolution, grid.x0, grid.y0)
    return drawn | {"map.png": map_picture(grid, np.zeros((0, 3))), GRAPH: b""}


def write(grid: OccupancyGrid, folder: Path) -> Path:
    """Writes a map without a pose graph; returns the YAML's path. Raises UserError where the folder refuses."""
    replace_together(folder, picture_files(grid))
    return folder / "map.yaml"


def show(robot: str, stack: str, place: str) -> None:
    """Draws a map with half blocks: two cells above each other are one character."""
    told = ""
    if place:
        grid = grid_of(found(place))
    else:
        with Client(load_robot(robot).robot.name, where_from(stack)) as client:
            grid = present(client)
            estimate = client.kept(topics.POSE)
            told = whereabouts(estimate) + "\n" if estimate is not None else ""
    rows, columns = np.nonzero(grid.cells >= 0)
    if not len(rows):
        raise UserError("the map is empty", "nothing was seen yet")
    cells = grid.cells[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    step = max(1, -(-cells.shape[1] // WIDEST))
    picture = coarse(cells, step)
    colour = sys.stdout.isatty()
    for upper in range(picture.shape[0] - 1, -1, -2):
        line = picture[upper], picture[upper - 1] if upper else np.full_like(picture[0], -1)
        sys.stdout.write(_coloured(*line) if colour else "".join(" .#"[_shade(v)] for v in np.maximum(*line)) + "\n")
    size = cells.shape[1] * grid.resolution, cells.shape[0] * grid.resolution
    sys.stdout.write(f"{size[0]:.1f} x {size[1]:.1f} m, a character is {step * grid.resolution:.2f} m wide\n")
    sys.stdout.write(told)


def whereabouts(estimate: PoseEstimate) -> str:
    """The mapper's mode, and where the robot is, or what helps to find it."""
    if estimate.state is Localization.LOST:
        return f"{estimate.mode}: {POSE_LOST.text}; {POSE_LOST.mend}"
    pose = estimate.map_from_base
    return f"{estimate.mode}: the robot is at {pose.x:.2f} {pose.y:.2f} {degrees(pose.yaw):.0f}, {estimate.state}"


def present(client: Client) -> OccupancyGrid:
    """The running stack's map. Raises UserError where there is none."""
    client.follow(topics.MAP)
    update = client.wait(topics.MAP, lambda u: len(u.rows) > 0, 5.0)
    whole = client.kept(topics.MAP) or update
    if whole is None:
        raise UserError(NO_MAP.text, NO_MAP.mend)
    return grown(whole)


def grown(update: MapUpdate) -> OccupancyGrid:
    """The grid that an update with every tile makes."""
    grid = OccupancyGrid(update.resolution, update.map_id)
    grid.apply(update)
    return grid


def found(place: str) -> Path:
    """The YAML of a map given as a name below maps/, a folder, or a path. Raises UserError."""
    for path in (Path(place), Path(place) / "map.yaml", FOLDER / place / "map.yaml"):
        if path.is_file():
            return path
    saved = tuple(sorted(p.parent.name for p in FOLDER.glob("*/map.yaml")))
    raise UserError(
        f"{NO_SUCH_MAP.text}: {place}", nearest(place, saved) if saved else "save one: zenav map save office"
    )


def grid_of(path: Path) -> OccupancyGrid:
    """A saved map as a grid of whole tiles. Its lower left corner is moved to a whole cell."""
    return grown(update_of(path))


def update_of(path: Path) -> MapUpdate:
    """A saved map as the message that carries it: see update_of_cells."""
    return update_of_cells(*read_ros_map(path))


def coarse(cells: Int8s, step: int) -> Int8s:
    """(h, w) int8 -> one cell for step x step: the most occupied of them, so that walls stay."""
    h, w = -(-cells.shape[0] // step), -(-cells.shape[1] // step)
    padded = np.full((h * step, w * step), -1, np.int8)
    padded[: cells.shape[0], : cells.shape[1]] = cells
    return np.asarray(padded.reshape(h, step, w, step).max(axis=(1, 3)))


def _shade(value: int) -> int:
    return 0 if value < 0 else 1 if value < 65 else 2


def _coloured(
    upper: "np.ndarray[tuple[int, ...], np.dtype[np.int8]]", lower: "np.ndarray[tuple[int, ...], np.dtype[np.int8]]"
) -> str:
    grey = (240, 255, 232)  # unknown, free, occupied: the terminal's 256 colours
    return "".join(f"\033[38;5;{grey[_shade(a)]};48;5;{grey[_shade(b)]}m▀" for a, b in zip(upper, lower)) + "\033[0m\n"
