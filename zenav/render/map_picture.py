# SPDX-License-Identifier: Apache-2.0
"""A map with the driven way, as a picture for people."""

from io import BytesIO

import numpy as np

from shared.grid import OccupancyGrid
from shared.messages import TILE_CELLS
from shared.types import Float64s

WALL, FREE, UNKNOWN = (25, 28, 36), (250, 250, 248), (188, 192, 198)
WAY, START, END = (214, 62, 48), (30, 140, 60), (30, 90, 200)
MAX_SIDE_PIXELS = 2400  # of an image


def map_picture(grid: OccupancyGrid, poses: Float64s) -> bytes:
    """A PNG of the known map with the way (n, 3) on it, its start green and its end blue, and a scale bar.

    A row of NaN interrupts the way.
    """
    from PIL import Image, ImageDraw

    rows, columns = np.nonzero(grid.cells >= 0)
    if not len(rows):
        rows = columns = np.array([0])
    margin = 20
    r0, r1 = int(rows.min()) - margin, int(rows.max()) + margin + 1
    c0, c1 = int(columns.min()) - margin, int(columns.max()) + margin + 1
    cells = np.full((r1 - r0, c1 - c0), -1, np.int8)
    inner = grid.cells[max(r0, 0) : r1, max(c0, 0) : c1]
    cells[max(-r0, 0) : max(-r0, 0) + inner.shape[0], max(-c0, 0) : max(-c0, 0) + inner.shape[1]] = inner
    shades = np.array(FREE) + np.linspace(0, 1, 101)[:, None] * (np.array(WALL) - np.array(FREE))
    colours = np.vstack((UNKNOWN, shades)).astype(np.uint8)[cells + 1]
    scale = max(1, min(4, MAX_SIDE_PIXELS // max(cells.shape)))
    image = Image.fromarray(colours[::-1]).resize(
        (cells.shape[1] * scale, cells.shape[0] * scale), Image.Resampling.NEAREST
    )
    if max(image.size) > MAX_SIDE_PIXELS:
        image.thumbnail((MAX_SIDE_PIXELS, MAX_SIDE_PIXELS), Image.Resampling.BOX)
    pixel = image.size[0] / cells.shape[1]
    draw = ImageDraw.Draw(image)
    x = ((poses[:, 0] - grid.x0) / grid.resolution - c0) * pixel
    y = image.size[1] - ((poses[:, 1] - grid.y0) / grid.resolution - r0) * pixel
    points = np.column_stack((x, y))
    for drive in np.split(points, np.flatnonzero(np.isnan(x))):
        line = [(a, b) for a, b in drive[~np.isnan(drive[:, 0])].tolist()]
        if len(line) > 1:
            draw.line(line, fill=WAY, width=max(1, round(pixel / 2)), joint="curve")
    for (a, b), colour in ((points[0].tolist(), START), (points[-1].tolist(), END)) if len(points) else ():
        draw.ellipse((a - 5, b - 5, a + 5, b + 5), fill=colour)
    metre = pixel / grid.resolution
    bar = next((m for m in (10, 5, 2, 1) if m * metre < image.size[0] / 3), 1)
    draw.line((12, image.size[1] - 12, 12 + bar * metre, image.size[1] - 12), fill=WALL, width=3)
    draw.text((12, image.size[1] - 28), f"{bar} m", fill=WALL)
    stream = BytesIO()
    image.save(stream, "PNG")
    return stream.getvalue()


DIFFERS, OTHER_WAY = (240, 150, 30), (40, 100, 220)


def two_runs(grid: OccupancyGrid, trajectory: Float64s, other_grid: OccupancyGrid, other_trajectory: Float64s) -> bytes:
    """A PNG of two runs: what both maps agree on, in orange the cells that differ; one trajectory red, the other blue.

    trajectory, other_trajectory: (n, 3) map_from_base.
    """
    from PIL import Image, ImageDraw

    from zenav.metrics.run_metrics import cell_classes, on_one_window

    cells, others, (row, column) = on_one_window(grid, other_grid)
    colours = np.array((UNKNOWN, FREE, UNKNOWN, WALL), np.uint8)[cell_classes(cells)]
    colours[cell_classes(cells) != cell_classes(others)] = DIFFERS
    rows, columns = np.nonzero((cells >= 0) | (others >= 0))
    r0, r1, c0, c1 = (int(v) for v in (rows.min(), rows.max() + 1, columns.min(), columns.max() + 1))
    scale = max(1, min(4, MAX_SIDE_PIXELS // max(r1 - r0, c1 - c0)))
    image = Image.fromarray(colours[r0:r1, c0:c1][::-1])
    image = image.resize((image.size[0] * scale, image.size[1] * scale), Image.Resampling.NEAREST)
    draw, cell = ImageDraw.Draw(image), grid.resolution
    for path, colour in ((trajectory, WAY), (other_trajectory, OTHER_WAY)):
        x = (path[:, 0] / cell - column * TILE_CELLS - c0) * scale
        y = image.size[1] - (path[:, 1] / cell - row * TILE_CELLS - r0) * scale
        points = [(float(a), float(b)) for a, b in zip(x, y)]
        if len(points) > 1:
            draw.line(points, fill=colour, width=max(1, scale // 2), joint="curve")
    stream = BytesIO()
    image.save(stream, "PNG")
    return stream.getvalue()
