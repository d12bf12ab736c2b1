# SPDX-License-Identifier: Apache-2.0
"""A run as a picture in the world's frame: the map, the true outline, the driven and the true way, the goals."""

from collections.abc import Sequence
from io import BytesIO
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from services.sim.world import World
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.types import Float64s
from zenav.metrics.evaluation import MAX_WALL_ERROR_M, RunTrack, map_errors, occupied_middles

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw


WALL, FREE, UNKNOWN = (30, 33, 40), (252, 252, 250), (196, 200, 206)
OUTLINE, TRUE_WAY, DRIVEN_WAY = (120, 60, 200), (40, 150, 70), (222, 74, 54)
REACHED, FAILED = (24, 100, 210), (230, 130, 20)
ASTRAY = (225, 30, 160)
MARGIN, LEGEND = 0.6, 64  # m around the world; pixels below it
WIDTH = 1800  # pixels, about


class GoalMark(NamedTuple):
    """A goal in the picture. pose: in `map`."""

    name: str
    pose: Pose2
    reached: bool


def floor_plan(track: RunTrack, world: World, goals: Sequence[GoalMark]) -> bytes:
    """A PNG of the run in the world's frame."""
    from PIL import Image, ImageDraw, ImageFont

    low_x, low_y, high_x, high_y = (b + s * MARGIN for b, s in zip(world.bounds, (-1, -1, 1, 1)))
    scale = WIDTH / (high_x - low_x)
    height = round((high_y - low_y) * scale)
    canvas = np.full((height + LEGEND, WIDTH, 3), 255, np.uint8)
    canvas[:height] = _map_pixels(track.grid, track.world_from_map, (low_x, high_y), scale, (height, WIDTH))
    image = Image.fromarray(canvas)
    draw, font = ImageDraw.Draw(image), ImageFont.load_default(18)

    def pixels(points: Float64s) -> list[tuple[float, float]]:
        return [((x - low_x) * scale, (high_y - y) * scale) for x, y in points[:, :2].tolist()]

    for segment in world.outline():
        draw.line(pixels(segment.reshape(2, 2)), fill=OUTLINE, width=1)
    for trajectory, colour, width in (
        (track.true_trajectory, TRUE_WAY, 4),
        (track.estimated_trajectory, DRIVEN_WAY, 2),
    ):
        if len(trajectory) > 1:
            draw.line(pixels(trajectory), fill=colour, width=width, joint="curve")
    errors, half = map_errors(track.grid, world, track.world_from_map), track.grid.resolution * scale / 2
    middles = occupied_middles(track.grid, track.world_from_map)
    for x, y in pixels(middles[errors > MAX_WALL_ERROR_M]) if len(errors) else ():
        draw.rectangle((x - half, y - half, x + half, y + half), fill=ASTRAY)
    for number, goal in enumerate(goals, 1):
        pose = track.world_from_map @ goal.pose
        ahead = pose @ Pose2(0.5)
        (x, y), (tip_x, tip_y) = pixels(np.array([[pose.x, pose.y], [ahead.x, ahead.y]]))
        colour = REACHED if goal.reached else FAILED
        draw.line((x, y, tip_x, tip_y), fill=colour, width=4)
        draw.ellipse((x - 13, y - 13, x + 13, y + 13), fill=colour, outline="white", width=2)
        draw.text((x, y), str(number), fill="white", font=font, anchor="mm")
    _legend(draw, font, height, scale, goals)
    stream = BytesIO()
    image.save(stream, "PNG")
    return stream.getvalue()


def _map_pixels(
    grid: OccupancyGrid, world_from_map: Pose2, corner: tuple[float, float], scale: float, shape: tuple[int, int]
) -> NDArray[np.uint8]:
    """(h, w, 3) the map's colours at each pixel's middle; `corner` is the upper left pixel's, m in the world."""
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    points = np.column_stack((corner[0] + (columns.ravel() + 0.5) / scale, corner[1] - (rows.ravel() + 0.5) / scale))
    cells = grid.cells_of(world_from_map.inverse() @ points)
    h, w = grid.cells.shape
    inside = (cells >= 0).all(axis=1) & (cells[:, 0] < h) & (cells[:, 1] < w)
    values = np.full(len(cells), -1, np.int8)
    values[inside] = grid.cells[cells[inside, 0], cells[inside, 1]]
    share = np.clip(values[:, None] / 100.0, 0, 1)
    colours = np.where(values[:, None] < 0, UNKNOWN, np.array(FREE) + share * (np.array(WALL) - np.array(FREE)))
    return colours.astype(np.uint8).reshape(*shape, 3)


def _legend(draw: "ImageDraw", font: object, top: int, scale: float, goals: Sequence[GoalMark]) -> None:
    x = 20.0
    rows = (
        (WALL, "mapped wall"), (ASTRAY, "over 5 cm off"), (UNKNOWN, "unknown"), (OUTLINE, "true outline"),
        (TRUE_WAY, "true way"), (DRIVEN_WAY, "estimated way"), (REACHED, "goal reached"), (FAILED, "goal not reached"),
    )  # fmt: skip
    for colour, text in rows:
        draw.rectangle((x, top + 12, x + 22, top + 26), fill=colour)
        draw.text((x + 30, top + 19), text, fill="black", font=font, anchor="lm")  # type: ignore[arg-type]  # Pillow's own
        x += 30 + draw.textlength(text, font=font) + 26  # type: ignore[arg-type]  # as above
    draw.line((x, top + 19, x + scale, top + 19), fill="black", width=3)
    draw.text((x + scale + 8, top + 19), "1 m", fill="black", font=font, anchor="lm")  # type: ignore[arg-type]  # as above
    names = "   ".join(f"{number} {goal.name}" for number, goal in enumerate(goals, 1))
    draw.text((20, top + 47), names, fill="black", font=font, anchor="lm")  # type: ignore[arg-type]  # as above
