# SPDX-License-Identifier: Apache-2.0
"""Cost of a straight line over the costmap, and whether it touches a blocked cell.

Points are (x, y) in cells: the centre of cell (row, column) is (column + 0.5, row + 0.5). Costs are those of `costmap`.
"""

from math import hypot

import numpy as np
from numba import njit

from shared.types import Float64s, UInt16s

BLOCKED = -1.0
"""The cost of a line that touches a blocked cell."""


@njit(cache=True, nogil=True)
def path_cost(costs: UInt16s, points: Float64s) -> float:
    """The cost of the polyline through points (n, 2), cost times cells; BLOCKED where it touches a blocked cell.

    costs: (h, w) uint16, 0 blocked.
    """
    total = 0.0
    for i in range(len(points) - 1):
        cost = line_cost(costs, points[i, 0], points[i, 1], points[i + 1, 0], points[i + 1, 1], np.inf)
        if cost < 0:
            return BLOCKED
        total += cost
    return total


@njit(cache=True, nogil=True)
def line_cost(costs: UInt16s, x0: float, y0: float, x1: float, y1: float, max_cost: float = np.inf) -> float:
    """The integral of the costs along a line, cost times cells, or BLOCKED (Amanatides and Woo 1987).

    costs: (h, w) uint16, 0 blocked. x0, y0, x1, y1: cells. A line through a corner touches all four cells. Where the
    cost exceeds `max_cost`, the rest of the line is not tested.
    """
    column, row = int(np.floor(x0)), int(np.floor(y0))
    last_column, last_row = int(np.floor(x1)), int(np.floor(y1))
    h, w = costs.shape
    if min(row, last_row, column, last_column) < 0 or max(row, last_row) >= h or max(column, last_column) >= w:
        return BLOCKED
    dx, dy = x1 - x0, y1 - y0
    length = hypot(dx, dy)
    across, up = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
    # shares of the line at which it leaves the present column and row
    t_column = ((column + (dx > 0)) - x0) / dx if dx != 0 else np.inf
    t_row = ((row + (dy > 0)) - y0) / dy if dy != 0 else np.inf
    per_column = abs(1 / dx) if dx != 0 else np.inf
    per_row = abs(1 / dy) if dy != 0 else np.inf
    here, total = 0.0, 0.0
    share = max_cost / length if length > 0 else np.inf
    n_steps = abs(last_column - column) + abs(last_row - row)
    while n_steps > 0:
        cost = costs[row, column]
        if cost == 0:
            return BLOCKED
        before, between = here, t_column - t_row
        if abs(between) < 1e-9 and column != last_column and row != last_row:
            if costs[row + up, column] == 0 or costs[row, column + across] == 0:
                return BLOCKED
            here = t_row
            column += across
            row += up
            t_column += per_column
            t_row += per_row
            n_steps -= 2
        elif row == last_row or (between < 0 and column != last_column):
            here = t_column
            column += across
            t_column += per_column
            n_steps -= 1
        else:
            here = t_row
            row += up
            t_row += per_row
            n_steps -= 1
        total += (here - before) * cost
        if total > share:
            return float(total * length)
    if costs[last_row, last_column] == 0:
        return BLOCKED
    return float((total + (1.0 - here) * costs[last_row, last_column]) * length)
