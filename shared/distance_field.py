# SPDX-License-Identifier: Apache-2.0
"""Exact Euclidean distance transform of a grid: distance of each cell to the nearest occupied one."""

import numpy as np
from numba import njit

from shared.types import Bools, Float32s, Int32s, Int64s

NONE = 1 << 30  # cells: 'no occupied cell in this column'


def distance_field(occupied: Bools, resolution: float) -> Float32s:
    """Exact distance between cell centres to the nearest occupied cell.

    occupied: (h, w) bool, row 0 at the lower edge.  resolution: m a cell.
    Returns (h, w) float32 m, 0 in occupied cells; inf where nothing is occupied.
    Felzenszwalb & Huttenlocher 2012, section 2: one dimension after the other. The first one has binary input and takes
    two sweeps as in Meijster et al. 2000. Integers up to the last square root make equal distances equal numbers.
    """
    out = np.empty(occupied.shape, np.float32)
    distance_field_into(occupied, resolution, out)
    return out


@njit(cache=True, nogil=True)
def distance_field_into(occupied: Bools, resolution: float, out: Float32s) -> None:
    """`distance_field`, from any (h, w) bool array into `out` (h, w) float32, m."""
    h, w = occupied.shape
    if h * w == 0:
        return
    to_column = np.empty((h, w), np.int32)
    _along_columns(occupied, to_column)
    places = np.empty(w, np.int64)  # columns of the parabolas that make up the lower envelope
    heights = np.empty(w, np.int64)  # their squared distances along the column
    from_column = np.empty(w, np.int64)  # where each parabola becomes the lowest
    for row in range(h):
        n = _lower_envelope(to_column[row], places, heights, from_column)
        if n == 0:
            out[row] = np.inf
            continue
        i = 0
        for column in range(w):
            while i + 1 < n and from_column[i + 1] <= column:
                i += 1
            away = column - places[i]
            out[row, column] = resolution * np.sqrt(float(away * away + heights[i]))


@njit(cache=True, nogil=True)
def _along_columns(occupied: Bools, out: Int32s) -> None:
    """Distance in cells to the nearest occupied cell of the same column, NONE without one."""
    h, w = occupied.shape
    for column in range(w):
        out[0, column] = 0 if occupied[0, column] else NONE
    for row in range(1, h):
        for column in range(w):
            out[row, column] = 0 if occupied[row, column] else min(NONE, out[row - 1, column] + 1)
    for row in range(h - 2, -1, -1):
        for column in range(w):
            out[row, column] = min(out[row, column], out[row + 1, column] + 1)


@njit(cache=True, nogil=True)
def _lower_envelope(distances: Int32s, places: Int64s, heights: Int64s, from_column: Int64s) -> int:
    """The parabolas that make up the lower envelope of (x - column)^2 + distance^2; returns how many there are."""
    n = 0
    for column in range(len(distances)):
        if distances[column] == NONE:
            continue
        height = np.int64(distances[column]) * np.int64(distances[column])
        start = np.int64(0)
        while n > 0:
            # first whole column at which the new parabola is not above the last one: a rounded-up quotient
            gap = 2 * (column - places[n - 1])
            rise = height + column * column - heights[n - 1] - places[n - 1] * places[n - 1]
            start = -((-rise) // gap)
            if start > from_column[n - 1]:
                break
            n -= 1
        if n == 0:
            start = np.int64(0)
        places[n], heights[n], from_column[n] = column, height, start
        n += 1
    return n
