# SPDX-License-Identifier: Apache-2.0
"""The path as points at a fixed spacing, and how wide the passage is across it, from the map."""

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from shared.grid import FREE_UP_TO, OccupancyGrid
from shared.types import Float64s

SPACING_M = 0.3  # between two points of a path
SAMPLE_M = 0.05  # of the path between two measured widths: a cell of the map, as a wall may be one cell thick
MAX_WIDTH_M = 4.0  # to each side within which a wall is looked for
STEP_M = 0.05  # along the line across the path


def points_from_end(path: Float64s) -> Float64s:
    """Points (k, 2) every SPACING_M m along the polyline (n, 2), counted from its end: of a rest they are the same."""
    legs = np.hypot(*np.diff(path, axis=0).T)
    to_end = np.concatenate((np.cumsum(legs[::-1])[::-1], [0.0]))
    wanted = np.arange(int(to_end[0] / SPACING_M + 1e-6), -1, -1) * SPACING_M
    back = to_end[::-1]
    return np.column_stack((np.interp(wanted, back, path[::-1, 0]), np.interp(wanted, back, path[::-1, 1])))


def passage_widths(points: Float64s, grid: OccupancyGrid) -> Float64s:
    """(n,) m of free floor across a path (n, 2) m in `map`: to the first cell on each side that is not free.

    The smallest width between the point before and the point behind counts. A door is shorter than SPACING_M, so it is
    measured every SAMPLE_M. Unknown floor is no passage.
    """
    if not len(points) or grid.empty:
        return np.zeros(len(points))
    along = np.gradient(points, axis=0) if len(points) > 1 else np.array([[1.0, 0.0]])
    n_parts = round(SPACING_M / SAMPLE_M)
    at = np.arange((len(points) - 1) * n_parts + 1) / n_parts
    fine, along = (_interpolated(at, values) for values in (points, along))
    length = np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-9)
    across = np.column_stack((-along[:, 1], along[:, 0])) / length[:, None]
    steps = np.linspace(0.0, MAX_WIDTH_M, round(MAX_WIDTH_M / STEP_M) + 1)
    widths = _free_distance(fine, across, steps, grid) + _free_distance(fine, -across, steps, grid)
    around = sliding_window_view(np.pad(widths, n_parts, mode="edge"), 2 * n_parts + 1)
    return np.asarray(around.min(axis=1)[::n_parts])


def _interpolated(at: Float64s, values: Float64s) -> Float64s:
    """(k, 2): values (n, 2) at fractional indices (k,)."""
    indices = np.arange(len(values))
    return np.column_stack((np.interp(at, indices, values[:, 0]), np.interp(at, indices, values[:, 1])))


def _free_distance(points: Float64s, direction: Float64s, steps: Float64s, grid: OccupancyGrid) -> Float64s:
    """(n,) m from each point along its direction to the first cell that is not free."""
    samples = points[:, None, :] + steps[None, :, None] * direction[:, None, :]
    columns = np.floor((samples[:, :, 0] - grid.x0) / grid.resolution).astype(np.int64)
    rows = np.floor((samples[:, :, 1] - grid.y0) / grid.resolution).astype(np.int64)
    h, w = grid.cells.shape
    inside = (rows >= 0) & (rows < h) & (columns >= 0) & (columns < w)
    cells = grid.cells[np.clip(rows, 0, h - 1), np.clip(columns, 0, w - 1)]
    closed = ~inside | (cells < 0) | (cells > FREE_UP_TO)
    first = np.where(closed.any(axis=1), closed.argmax(axis=1), len(steps) - 1)
    return np.asarray(steps[first])
