# SPDX-License-Identifier: Apache-2.0
"""Beams drawn into tiles of log-odds: what they crossed is free, where they ended is not."""

import numpy as np
from numba import njit

KNOWN, CROSSED, HIT = np.uint8(1), np.uint8(3), np.uint8(5)
"""What `seen` says of a cell; the last two only while a scan is drawn, which knows it then."""
OF_THIS_SCAN = np.uint64(0x0606060606060606)  # of eight cells
WHOLE = 2.0**60  # a beam, in the units in which it is walked along
SIGN = np.int64(63)


@njit(cache=True, nogil=True)
def drawable(origins, ends, silent, range_max):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    """The ends, NaN where they are farther than range_max, and the least and greatest x and y of all there is."""
    ends = ends.copy()
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for k in range(len(ends)):
        if np.hypot(ends[k, 0] - origins[k, 0], ends[k, 1] - origins[k, 1]) > range_max:
            ends[k] = np.nan
        for a in range(2):
            for value in (origins[k, a], ends[k, a], silent[k, a]):
                if value < low[a]:
                    low[a] = value
                if value > high[a]:
                    high[a] = value
    return ends, low, high


@njit(cache=True, nogil=True)
def explain(origins, ends, behind, resolution, directory, row0, column0, limit, odds):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    """Moves each end back to the first occupied cell on the last `behind` m of its beam, where there is one.

    Ranges are noisy, and nobody looks behind a wall: a cell there that was hit once would stay for ever, and walls grow
    outwards. What a surface explains is no evidence of another one behind it.
    """
    for k in range(len(ends)):
        if np.isnan(ends[k, 0]):
            continue
        dx, dy = ends[k, 0] - origins[k, 0], ends[k, 1] - origins[k, 1]
        length = np.hypot(dx, dy)
        step = 0.5 * resolution
        for m in range(int(min(behind, length) / step + 1e-6), 0, -1):
            x, y = ends[k, 0] - m * step / length * dx, ends[k, 1] - m * step / length * dy
            column, row = int(np.floor(x / resolution)), int(np.floor(y / resolution))
            i, j = (row >> 6) - row0, (column >> 6) - column0
            if 0 <= i < directory.shape[0] and 0 <= j < directory.shape[1]:
                tile = directory[i, j]
                if tile >= 0 and odds[tile, row & 63, column & 63] > limit:
                    ends[k, 0], ends[k, 1] = x, y
                    break


@njit(cache=True, nogil=True)
def carve(  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    origins, ends, silent, resolution, directory, row0, column0, n_tiles, hit, miss, lowest, highest, odds, seen,
    eights, dirty,
):  # fmt: skip
    """Draws a scan, and returns how many tiles there are then. eights: `seen`, eight cells in one number.

    The beams only mark cells, since most of those near the robot are crossed by many: a cell's odds change once.
    """
    touched = np.zeros(len(odds), np.bool_)
    for k in range(len(ends)):
        ex, ey = ends[k, 0], ends[k, 1]
        if np.isnan(ex):
            ex, ey = silent[k, 0], silent[k, 1]
            if np.isnan(ex):
                continue
        # Amanatides & Woo 1987: every cell that the beam crosses, in order, without the one in which it ends. Whether
        # the next border is a column's is a sign, and no branch: it would be guessed wrong every third time.
        x, y = origins[k, 0] / resolution, origins[k, 1] / resolution
        dx, dy = ex / resolution - x, ey / resolution - y
        column, row = int(np.floor(x)), int(np.floor(y))
        left = abs(int(np.floor(ex / resolution)) - column) + abs(int(np.floor(ey / resolution)) - row)
        step_c, step_r = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
        each_c, first_c = _borders(x, dx, column)
        each_r, first_r = _borders(y, dy, row)
        ahead = first_c - first_r
        tile_r, tile_c, seen_here = row0 - 1, column0 - 1, seen[0]  # none yet
        for _ in range(left):
            if row >> 6 != tile_r or column >> 6 != tile_c:
                tile_r, tile_c = row >> 6, column >> 6
                tile, n_tiles = _tile(tile_r - row0, tile_c - column0, directory, n_tiles)
                if tile < 0:
                    break  # it covers all origins and ends: a beam that leaves it is none
                touched[tile] = True
                seen_here = seen[tile]
            seen_here[np.uint64(row & 63), np.uint64(column & 63)] = CROSSED
            sideways = ahead >> SIGN
            column += step_c & sideways
            row += step_r & ~sideways
            ahead += (each_c & sideways) - (each_r & ~sideways)
    for k in range(len(ends)):
        if np.isnan(ends[k, 0]):
            continue
        column, row = int(np.floor(ends[k, 0] / resolution)), int(np.floor(ends[k, 1] / resolution))
        tile, n_tiles = _tile((row >> 6) - row0, (column >> 6) - column0, directory, n_tiles)
        if tile >= 0:
            touched[tile] = True
            seen[tile, row & 63, column & 63] = HIT
    for tile in np.flatnonzero(touched):
        dirty[tile] = True
        for r in range(eights.shape[1]):
            for eight in range(eights.shape[2]):
                if eights[tile, r, eight] & OF_THIS_SCAN:
                    _weigh(odds[tile, r], seen[tile, r], 8 * eight, hit, miss, lowest, highest)
    return n_tiles


@njit(cache=True, nogil=True, inline="always")
def _weigh(odds, seen, first, hit, miss, lowest, highest):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    for c in range(first, first + 8):
        if seen[c] > KNOWN:
            odds[c] = min(max(odds[c] + (hit if seen[c] == HIT else miss), lowest), highest)
            seen[c] = KNOWN


@njit(cache=True, nogil=True, inline="always")
def _borders(start, along, cell):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    """How far along the beam it is from a border to the next, and to the first; twice the beam where it never comes."""
    if along == 0:
        return np.int64(2 * WHOLE), np.int64(2 * WHOLE)
    first = (cell + (along > 0) - start) / along
    return np.int64(min(abs(1 / along), 2.0) * WHOLE), np.int64(min(first, 2.0) * WHOLE)


@njit(cache=True, nogil=True, inline="always")
def _tile(i, j, directory, n_tiles):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    """The tile at a place of the directory, a new one where there is none, -1 outside; and how many there are then."""
    if i < 0 or j < 0 or i >= directory.shape[0] or j >= directory.shape[1]:
        return -1, n_tiles
    if directory[i, j] < 0:
        directory[i, j] = n_tiles
        n_tiles += 1
    return directory[i, j], n_tiles
