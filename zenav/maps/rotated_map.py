# SPDX-License-Identifier: Apache-2.0
"""A map that is turned, on a grid along the axes."""

from math import ceil, cos, floor, sin

import numpy as np

from shared.grid import OCCUPIED_FROM, UNKNOWN
from shared.types import Int8s

QUARTERS = -0.25, 0.25  # of a cell: where a turned map is looked up


def axis_aligned(cells: Int8s, resolution: float, x0: float, y0: float, yaw: float) -> tuple[Int8s, float, float]:
    """Cells (h, w) that are turned by yaw about their lower left corner, on a grid along the axes; and its corner, m.

    A cell takes what lies at its middle, and is occupied where a quarter of it is: a thin wall gets no holes.
    """
    h, w = cells.shape
    c, s = cos(yaw), sin(yaw)
    corners = np.array([(0, 0), (w, 0), (0, h), (w, h)]) @ np.array([(c, s), (-s, c)])  # in cells
    left, low = floor(corners[:, 0].min() + 1e-6), floor(corners[:, 1].min() + 1e-6)
    right, high = ceil(corners[:, 0].max() - 1e-6), ceil(corners[:, 1].max() - 1e-6)
    x, y = np.meshgrid(np.arange(left, right) + 0.5, np.arange(low, high) + 0.5)

    def at(dx: float, dy: float) -> Int8s:
        u, v = c * (x + dx) + s * (y + dy), -s * (x + dx) + c * (y + dy)
        column, row = np.floor(u).astype(np.int64), np.floor(v).astype(np.int64)
        inside = (column >= 0) & (column < w) & (row >= 0) & (row < h)
        return np.where(inside, cells[np.clip(row, 0, h - 1), np.clip(column, 0, w - 1)], UNKNOWN).astype(np.int8)

    out = at(0.0, 0.0)
    for dx in QUARTERS:
        for dy in QUARTERS:
            quarter = at(dx, dy)
            out = np.where(quarter >= OCCUPIED_FROM, np.maximum(out, quarter), out).astype(np.int8)
    return out, x0 + left * resolution, y0 + low * resolution
