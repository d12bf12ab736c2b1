# SPDX-License-Identifier: Apache-2.0
"""The running map, or a saved one, in the terminal."""

import sys
from math import degrees

import numpy as np

from shared import topics
from shared.config import UserError, load_robot
from shared.grid import OccupancyGrid
from shared.messages import Localization, PoseEstimate
from shared.reasons import NO_MAP, POSE_LOST
from shared.runners.transport import stack_address
from zenav.client import Client
from zenav.maps.map_files import coarse_cells, find_map, grid_from_update, grid_of

MAX_WIDTH = 100  # characters of a map in the terminal


def show_map(robot: str, stack: str, place: str) -> None:
    """Draws a map with half blocks: two cells above each other are one character."""
    pose_line = ""
    if place:
        grid = grid_of(find_map(place))
    else:
        with Client(load_robot(robot).robot.name, stack_address(stack)) as client:
            grid = current_map(client)
            estimate = client.latched_value(topics.POSE)
            pose_line = pose_text(estimate) + "\n" if estimate is not None else ""
    rows, columns = np.nonzero(grid.cells >= 0)
    if not len(rows):
        raise UserError("the map is empty", "nothing was seen yet")
    cells = grid.cells[rows.min() : rows.max() + 1, columns.min() : columns.max() + 1]
    step = max(1, -(-cells.shape[1] // MAX_WIDTH))
    picture = coarse_cells(cells, step)
    colour = sys.stdout.isatty()
    for upper in range(picture.shape[0] - 1, -1, -2):
        line = picture[upper], picture[upper - 1] if upper else np.full_like(picture[0], -1)
        sys.stdout.write(_coloured(*line) if colour else "".join(" .#"[_shade(v)] for v in np.maximum(*line)) + "\n")
    size = cells.shape[1] * grid.resolution, cells.shape[0] * grid.resolution
    sys.stdout.write(f"{size[0]:.1f} x {size[1]:.1f} m, a character is {step * grid.resolution:.2f} m wide\n")
    sys.stdout.write(pose_line)


def pose_text(estimate: PoseEstimate) -> str:
    """The mapper's mode, and where the robot is, or what helps to find it."""
    if estimate.state is Localization.LOST:
        return f"{estimate.mode}: {POSE_LOST.text}; {POSE_LOST.hint}"
    pose = estimate.map_from_base
    return f"{estimate.mode}: the robot is at {pose.x:.2f} {pose.y:.2f} {degrees(pose.yaw):.0f}, {estimate.state}"


def current_map(client: Client) -> OccupancyGrid:
    """The running stack's map. Raises UserError where there is none."""
    client.follow(topics.MAP)
    update = client.wait(topics.MAP, lambda u: len(u.rows) > 0, 5.0)
    whole = client.latched_value(topics.MAP) or update
    if whole is None:
        raise UserError(NO_MAP.text, NO_MAP.hint)
    return grid_from_update(whole)


def _shade(value: int) -> int:
    return 0 if value < 0 else 1 if value < 65 else 2


def _coloured(
    upper: "np.ndarray[tuple[int, ...], np.dtype[np.int8]]", lower: "np.ndarray[tuple[int, ...], np.dtype[np.int8]]"
) -> str:
    grey = (240, 255, 232)  # unknown, free, occupied: the terminal's 256 colours
    return "".join(f"\033[38;5;{grey[_shade(a)]};48;5;{grey[_shade(b)]}m▀" for a, b in zip(upper, lower)) + "\033[0m\n"
