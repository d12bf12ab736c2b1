# SPDX-License-Identifier: Apache-2.0
"""`zenav map`: the running stack's map to files, files to the mapper, and either to the terminal."""

import sys
from math import radians
from pathlib import Path

import numpy as np

from shared import requests, topics
from shared.config import UserError, load_robot, nearest
from shared.geometry import Pose2, wrapped
from shared.grid import OccupancyGrid
from shared.messages import TILE_CELLS, MapUpdate
from shared.reasons import NO_MAP, NO_SUCH_MAP
from shared.requests import LoadMap
from shared.ros_map import read_ros_map, replace_file, write_ros_map
from shared.runners.transport import where_from
from zenav.client import Client
from zenav.drive import refusal
from zenav.picture import map_picture

FOLDER = Path("maps")
WIDEST = 100  # characters of a map in the terminal


def save(robot: str, stack: str, place: str) -> None:
    """Writes the present map into a folder."""
    folder = FOLDER / place if place.replace("_", "").replace("-", "").isalnum() else Path(place)
    written = write(present(robot, stack), folder)
    sys.stdout.write(f"{written}\n")


def write(grid: OccupancyGrid, folder: Path) -> Path:
    """Writes map.pgm, map.yaml and map.png; returns the YAML's path. Raises UserError where the folder refuses."""
    yaml = write_ros_map(folder, grid.cells, grid.resolution, grid.x0, grid.y0)
    replace_file(folder / "map.png", map_picture(grid, np.zeros((0, 3))))
    return yaml


def load(robot: str, stack: str, place: str, at: tuple[float, float, float]) -> int:
    """Gives a saved map to the mapper; `at` is where the robot stands on it: m, m, degrees."""
    update = update_of(found(place))
    pose = Pose2(at[0], at[1], wrapped(radians(at[2])))
    with Client(load_robot(robot).robot.name, where_from(stack)) as client:
        client.answers(requests.LOAD_MAP, 3.0)
        reply = client.ask(requests.LOAD_MAP, LoadMap(client.now(), update, pose), timeout=20.0)
    if not reply.accepted:
        raise refusal(reply)
    sys.stdout.write(f"{reply.detail}\n")
    return 0


def show(robot: str, stack: str, place: str) -> None:
    """Draws a map with half blocks: two cells above each other are one character."""
    grid = grid_of(found(place)) if place else present(robot, stack)
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


def present(robot: str, stack: str) -> OccupancyGrid:
    """The running stack's map. Raises UserError where there is none."""
    with Client(load_robot(robot).robot.name, where_from(stack)) as client:
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
    """A saved map as the message that carries it; the corner is moved by up to half a cell onto the tiles' cells."""
    cells, resolution, x0, y0 = read_ros_map(path)
    row, column = round(y0 / resolution), round(x0 / resolution)
    first_row, first_column = row // TILE_CELLS, column // TILE_CELLS
    top, right = row - first_row * TILE_CELLS, column - first_column * TILE_CELLS
    h, w = -(-(top + cells.shape[0]) // TILE_CELLS), -(-(right + cells.shape[1]) // TILE_CELLS)
    whole = np.full((h * TILE_CELLS, w * TILE_CELLS), -1, np.int8)
    whole[top : top + cells.shape[0], right : right + cells.shape[1]] = cells
    tiles = whole.reshape(h, TILE_CELLS, w, TILE_CELLS).swapaxes(1, 2).reshape(h * w, TILE_CELLS * TILE_CELLS)
    rows, columns = np.divmod(np.arange(h * w, dtype=np.int32), np.int32(w))
    seen = (tiles >= 0).any(axis=1)
    return MapUpdate(
        0, 0, 1, resolution, (rows + first_row)[seen].astype(np.int32), (columns + first_column)[seen].astype(np.int32),
        np.ascontiguousarray(tiles[seen]),
    )  # fmt: skip


def coarse(
    cells: "np.ndarray[tuple[int, ...], np.dtype[np.int8]]", step: int
) -> "np.ndarray[tuple[int, ...], np.dtype[np.int8]]":
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
