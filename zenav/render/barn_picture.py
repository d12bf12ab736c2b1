# SPDX-License-Identifier: Apache-2.0
"""A failed BARN run as a picture: the world, the driven path, the plan, the robot at the end, and the reasons."""

from io import BytesIO
from math import cos, sin

import numpy as np

from shared.types import Float64s
from zenav.metrics.barn import BarnResult
from zenav.render.map_picture import END, FREE, OTHER_WAY, START, WALL, WAY

PIXELS = 90  # a metre
MARGIN = 0.5  # m
LINE = 18  # pixels of text
ROBOT, WALKER = (250, 200, 60), (150, 120, 190)


def failure_picture(driven: BarnResult) -> bytes:
    """A PNG; the way driven is red, the last plan blue, the robot at the end yellow, the goal's circle blue."""
    from PIL import Image, ImageDraw

    course = driven.course
    places = np.concatenate((course.cylinders[:, :2], [course.goal], [(course.start.x, course.start.y)]))
    places = np.concatenate((places, driven.rows[:, 1:3]))
    low, high = places.min(axis=0) - MARGIN, places.max(axis=0) + MARGIN
    text = [
        f"world {course.world}: {driven.status} after {driven.time:.1f} s, {driven.n_recoveries} recoveries",
        f"nearest {1000 * driven.clearance:.0f} mm" + (", stood when it was touched" if driven.stood else ""),
        *driven.why.split(", "),
    ]
    width, height = (int(extent * PIXELS) for extent in high - low)
    image = Image.new("RGB", (width, height + LINE * len(text) + 8), FREE)
    draw = ImageDraw.Draw(image)

    def at(points: Float64s) -> list[tuple[float, float]]:
        return [((x - low[0]) * PIXELS, height - (y - low[1]) * PIXELS) for x, y in points.tolist()]

    def disc(x: float, y: float, radius: float) -> tuple[float, float, float, float]:
        ((a, b),) = at(np.array([[x, y]]))
        return a - radius * PIXELS, b - radius * PIXELS, a + radius * PIXELS, b + radius * PIXELS

    for x, y, radius in course.cylinders.tolist():
        draw.ellipse(disc(x, y, radius), fill=WALL)
    for x, y in driven.walkers.tolist():
        draw.ellipse(disc(x, y, course.walkers), fill=WALKER)
    draw.ellipse(disc(*course.goal, course.goal_radius), outline=END, width=2)
    draw.ellipse(disc(course.start.x, course.start.y, 0.06), fill=START)
    *_, (_, x, y, yaw, _, _) = driven.rows.tolist()
    c, s = cos(yaw), sin(yaw)
    corners = driven.robot.corners
    outline = np.column_stack((x + c * corners[:, 0] - s * corners[:, 1], y + s * corners[:, 0] + c * corners[:, 1]))
    draw.polygon(at(outline), fill=ROBOT, outline=WALL)
    draw.line(at(np.array([[x, y], [x + 0.3 * c, y + 0.3 * s]])), fill=WALL, width=2)
    if len(driven.plan) > 1:
        draw.line(at(driven.plan), fill=OTHER_WAY, width=2)
    draw.line(at(driven.rows[:, 1:3]), fill=WAY, width=2, joint="curve")
    for i, line in enumerate(text):
        draw.text((8, height + 4 + i * LINE), line, fill=WALL)
    stream = BytesIO()
    image.save(stream, "PNG")
    return stream.getvalue()
