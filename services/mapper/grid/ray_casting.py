# SPDX-License-Identifier: Apache-2.0
"""Ray casting: beams lower the log odds of the cells that they cross and raise those of the cells that they hit.

Cells along a beam are those of Amanatides and Woo 1987, here in fixed point.
"""

import numpy as np
from numba import njit

KNOWN, CROSSED, HIT = np.uint8(1), np.uint8(3), np.uint8(5)
"""Values of `observed` for a cell. The last two are used only while a scan is drawn."""
CHANGED_BITS = np.uint64(0x0606060606060606)  # of eight cells: those of CROSSED and HIT that KNOWN has not
BEAM_LENGTH = 2.0**60  # of each beam, in units of the fixed-point traversal
SIGN_SHIFT = np.int64(63)  # shifts an int64 to its sign: -1 or 0


@njit(cache=True, nogil=True)
def drawable_beams(origins, ends, silent, range_max):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    """The ends (n, 2), NaN where they are farther than range_max, and the bounds low, high (2,) of all points, m.

    origins, ends, silent: (n, 2) m, as `Occupancy.insert_scan` takes them.  range_max: m.
    """
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
def pull_back_hits(origins, ends, hit_depth, resolution, directory, row0, column0, limit, log_odds):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    """Moves each end back, in place, to the first occupied cell on the last `hit_depth` m of its beam, if any.

    origins, ends: (n, 2) m.  directory: (rows, columns) int32 index of each tile, from row0 and column0; -1: none.
    limit: log odds of an occupied cell.  log_odds: (tiles, 64, 64) float32.  resolution: m a cell.
    Ranges are noisy. A cell behind a wall that one beam hits would stay occupied, as no later beam crosses it, and
    walls would grow outwards.
    """
    for k in range(len(ends)):
        if np.isnan(ends[k, 0]):
            continue
        dx, dy = ends[k, 0] - origins[k, 0], ends[k, 1] - origins[k, 1]
        length = np.hypot(dx, dy)
        step = 0.5 * resolution
        for m in range(int(min(hit_depth, length) / step + 1e-6), 0, -1):
            x, y = ends[k, 0] - m * step / length * dx, ends[k, 1] - m * step / length * dy
            column, row = int(np.floor(x / resolution)), int(np.floor(y / resolution))
            i, j = (row >> 6) - row0, (column >> 6) - column0
            if 0 <= i < directory.shape[0] and 0 <= j < directory.shape[1]:
                tile = directory[i, j]
                if tile >= 0 and log_odds[tile, row & 63, column & 63] > limit:
                    ends[k, 0], ends[k, 1] = x, y
                    break


@njit(cache=True, nogil=True)
def cast_rays(  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    origins, ends, silent, resolution, directory, row0, column0, n_tiles, hit, miss, min_log_odds, max_log_odds,
    log_odds, observed, packed_observed, modified,
):  # fmt: skip
    """Draws a scan, and returns the number of tiles after it.

    origins, ends, silent: (n, 2) m.  directory, row0, column0, resolution, log_odds: as in `pull_back_hits`; new tiles
    are added to the directory.  n_tiles: before the scan.  hit, miss, min_log_odds, max_log_odds: log odds.
    observed: (tiles, 64, 64) uint8.  modified: (tiles,) bool, set for the tiles that the scan changes.
    packed_observed: `observed`, eight cells in one uint64.  The beams only mark cells. The log odds of a cell change
    once a scan, as many beams cross the cells near the robot.
    """
    touched = np.zeros(len(log_odds), np.bool_)
    for k in range(len(ends)):
        ex, ey = ends[k, 0], ends[k, 1]
        if np.isnan(ex):
            ex, ey = silent[k, 0], silent[k, 1]
            if np.isnan(ex):
                continue
        # Amanatides & Woo 1987: all cells that the beam crosses, in order, without the last one. Whether the next
        # border is a column's is computed from a sign: the processor mispredicts a branch here one time in three.
        x, y = origins[k, 0] / resolution, origins[k, 1] / resolution
        dx, dy = ex / resolution - x, ey / resolution - y
        column, row = int(np.floor(x)), int(np.floor(y))
        left = abs(int(np.floor(ex / resolution)) - column) + abs(int(np.floor(ey / resolution)) - row)
        step_c, step_r = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
        each_c, first_c = _borders(x, dx, column)
        each_r, first_r = _borders(y, dy, row)
        ahead = first_c - first_r
        tile_r, tile_c, observed_here = row0 - 1, column0 - 1, observed[0]  # none yet
        for _ in range(left):
            if row >> 6 != tile_r or column >> 6 != tile_c:
                tile_r, tile_c = row >> 6, column >> 6
                tile, n_tiles = _tile(tile_r - row0, tile_c - column0, directory, n_tiles)
                if tile < 0:
                    break  # the directory covers all origins and ends
                touched[tile] = True
                observed_here = observed[tile]
            observed_here[np.uint64(row & 63), np.uint64(column & 63)] = CROSSED
            sideways = ahead >> SIGN_SHIFT
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
            observed[tile, row & 63, column & 63] = HIT
    for tile in np.flatnonzero(touched):
        modified[tile] = True
        for r in range(packed_observed.shape[1]):
            for eight in range(packed_observed.shape[2]):
                if packed_observed[tile, r, eight] & CHANGED_BITS:
                    _update_eight_cells(
                        log_odds[tile, r], observed[tile, r], 8 * eight, hit, miss, min_log_odds, max_log_odds
                    )
    return n_tiles


@njit(cache=True, nogil=True, inline="always")
def _update_eight_cells(log_odds, observed, first, hit, miss, min_log_odds, max_log_odds):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    for c in range(first, first + 8):
        if observed[c] > KNOWN:
            log_odds[c] = min(max(log_odds[c] + (hit if observed[c] == HIT else miss), min_log_odds), max_log_odds)
            observed[c] = KNOWN


@njit(cache=True, nogil=True, inline="always")
def _borders(start, along, cell):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    """Length along the beam between two borders, and to the first one; two beam lengths if it meets none."""
    if along == 0:
        return np.int64(2 * BEAM_LENGTH), np.int64(2 * BEAM_LENGTH)
    first = (cell + (along > 0) - start) / along
    return np.int64(min(abs(1 / along), 2.0) * BEAM_LENGTH), np.int64(min(first, 2.0) * BEAM_LENGTH)


@njit(cache=True, nogil=True, inline="always")
def _tile(i, j, directory, n_tiles):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    """Index of the tile in a cell of the directory, added if missing, -1 outside; and the number of tiles after it."""
    if i < 0 or j < 0 or i >= directory.shape[0] or j >= directory.shape[1]:
        return -1, n_tiles
    if directory[i, j] < 0:
        directory[i, j] = n_tiles
        n_tiles += 1
    return directory[i, j], n_tiles
