# SPDX-License-Identifier: Apache-2.0
"""Which way surfaces face: normals along a sweep, and surface points out of an occupancy grid."""

from math import hypot, inf, isnan, sqrt

import numpy as np
from numba import njit
from numpy.typing import NDArray

Float64s = NDArray[np.float64]
Bools = NDArray[np.bool_]

NEIGHBOURS = 3  # beams to each side that a normal is fitted to, at least
LEAST = 4  # points for a fit
STEEPEST = 12.0  # m along a surface a metre across the beams
LONGEST = 1.0  # m between neighbours of one surface
REACH = 0.15  # m to each side that a normal is fitted to, where the surface is as flat
MOST = 12  # beams to each side at most
THIN = 0.35  # largest ratio of the rms across to the rms along: a leg is no wall
BEFORE = 0.3  # m at least that what stands free is nearer than what is beside it
ABREAST = 0.1  # m the same, where much walks: of two that overlap, one is not much nearer
WIDE = 0.9  # m, wider than a person with a bag
THRONGED = 1.1  # m, wider than two abreast, or a person with a trolley
LONE = 0.15  # m to the neighbours from which a point without a direction is lone
SPARSE = 0.4  # m, at most: farther apart, the next sweep's point of the same surface is out of the kernel (0.2 m)
FLAT = 0.04  # m, largest rms distance from the fitted line
CELLS_REACH = 3.5  # cells of a grid to each side that a normal is fitted to


@njit(cache=True, nogil=True)
def sweep_usable(origins, ends):  # type: ignore[no-untyped-def]  # compiled; (n, 2), (n, 2) -> (n,) bool
    """Which beams measured a point that can be found again: not those that graze a surface, far from their neighbours.

    Down a corridor they fall on other spots of its walls each time; taken for points, they would hold the robot back.
    """
    n = len(ends)
    usable = np.zeros(n, np.bool_)
    for i in range(n):
        if isnan(ends[i, 0]):
            continue
        r = hypot(ends[i, 0] - origins[i, 0], ends[i, 1] - origins[i, 1])
        slope = 0
        usable[i] = False
        n_beside = 0
        for j in (i - 1, i + 1):
            if j < 0 or j >= n or isnan(ends[j, 0]):
                continue
            n_beside += 1
            ax, ay = ends[i, 0] - origins[i, 0], ends[i, 1] - origins[i, 1]
            bx, by = ends[j, 0] - origins[j, 0], ends[j, 1] - origins[j, 1]
            across = abs(ax * by - ay * bx) / max(hypot(bx, by), 1e-9)
            step = hypot(ends[j, 0] - ends[i, 0], ends[j, 1] - ends[i, 1])
            if step <= min(max(LONE, 3.0 * across), SPARSE):
                usable[i] = True
            slope += (1 if hypot(bx, by) > r else -1) * (j - i)
        # nearer, or farther, than both neighbours: a pole, or a gap between two
        usable[i] = usable[i] or n_beside == 0 or (n_beside == 2 and slope == 0)
    return usable


@njit(cache=True, nogil=True)
def sweep_lone(origins, ends, busy):  # type: ignore[no-untyped-def]  # compiled; (n, 2), (n, 2), bool -> (n,) bool
    """Which beams fell on something no wider than a person that stands free before what is behind it.

    Things end where the range jumps. A full circle goes on from its last beam to its first; beyond the ends of any
    other sweep all is far. busy: where much walks, what is wider is meant too, and what is hidden on one side by
    something that stands free.
    """
    lone = np.zeros(len(ends), np.bool_)
    beams = np.flatnonzero(~np.isnan(ends[:, 0]))
    n = len(beams)
    r = np.empty(n)
    for k in range(n):
        r[k] = hypot(ends[beams[k], 0] - origins[beams[k], 0], ends[beams[k], 1] - origins[beams[k], 1])
    jumps = np.zeros(n, np.bool_)  # from the beam before
    least = ABREAST if busy else BEFORE
    for k in range(n):
        jumps[k] = abs(r[k] - r[k - 1]) > least
    if n > 0:
        a, b = ends[beams[0]], ends[beams[n - 1]]
        jumps[0] = jumps[0] or hypot(a[0] - b[0], a[1] - b[1]) > BEFORE
    starts = np.flatnonzero(jumps)
    widest = THRONGED if busy else WIDE
    for again in range(3 if busy else 1):  # behind the first that stands free, and behind that
        before = lone.copy()
        for k in range(len(starts)):
            first, after = starts[k], starts[(k + 1) % len(starts)]
            last = (after - 1) % n
            if before[beams[first]]:
                continue
            farther_before = first == 0 or r[first - 1] > r[first]
            farther_after = after == 0 or r[after] > r[last]
            if again:
                free = (farther_before and before[beams[after]]) or (farther_after and before[beams[first - 1]])
            else:
                free = farther_before and farther_after
            a, b = ends[beams[first]], ends[beams[last]]
            if free and hypot(b[0] - a[0], b[1] - a[1]) < widest:
                for m in range((last - first) % n + 1):
                    lone[beams[(first + m) % n]] = True
    return lone


@njit(cache=True, nogil=True)
def sweep_normals(origins, ends):  # type: ignore[no-untyped-def]  # compiled; (n, 2), (n, 2) -> (n, 2) float64
    """Unit normals towards the laser, (0, 0) where no line fits: total least squares over beams without a gap.

    origins, ends: (n, 2) m, ends NaN without an echo. A gap is a step that is longer than a surface seen at 85 degrees
    from its normal makes, or that is out of proportion to the step beside it: two clusters always lie on a line.
    """
    n = len(ends)
    normals = np.zeros((n, 2))
    steps = np.full(n, inf)  # m from i to i + 1
    for i in range(n - 1):
        if isnan(ends[i, 0]) or isnan(ends[i + 1, 0]):
            continue
        ax, ay = ends[i, 0] - origins[i, 0], ends[i, 1] - origins[i, 1]
        bx, by = ends[i + 1, 0] - origins[i + 1, 0], ends[i + 1, 1] - origins[i + 1, 1]
        across = abs(ax * by - ay * bx) / max(hypot(ax, ay), 1e-9)
        step = hypot(ends[i + 1, 0] - ends[i, 0], ends[i + 1, 1] - ends[i, 1])
        steps[i] = step if step < max(STEEPEST * across, 0.06) and step < LONGEST else inf
    for i in range(n):
        if isnan(ends[i, 0]):
            continue
        nx = ny = 0.0
        # near surfaces need many beams, or noise turns the normals; where they bend within REACH, a few must do
        for reach in (REACH, 0.0):
            low, high = _neighbours(i, reach, ends, steps)
            if high - low + 1 < LEAST:
                break
            nx, ny, rms, spread = _line(ends[low : high + 1])
            if rms < FLAT and rms < THIN * spread:
                break
            nx = ny = 0.0
        if nx == 0.0 and ny == 0.0:
            continue
        towards = nx * (origins[i, 0] - ends[i, 0]) + ny * (origins[i, 1] - ends[i, 1])
        sign = 1.0 if towards >= 0 else -1.0
        normals[i, 0], normals[i, 1] = sign * nx, sign * ny
    return normals


@njit(cache=True, nogil=True)
def _neighbours(i, reach, ends, steps):  # type: ignore[no-untyped-def]  # compiled; -> first and last beam of the surface about i
    low = high = i
    before = after = min(steps[i - 1] if i > 0 else inf, steps[i])
    while low > 0 and _even(steps[low - 1], before):
        away = hypot(ends[low, 0] - ends[i, 0], ends[low, 1] - ends[i, 1])
        if i - low >= MOST or (i - low >= NEIGHBOURS and away >= reach):
            break
        low -= 1
        before = steps[low]
    while high < len(ends) - 1 and _even(steps[high], after):
        away = hypot(ends[high, 0] - ends[i, 0], ends[high, 1] - ends[i, 1])
        if high - i >= MOST or (high - i >= NEIGHBOURS and away >= reach):
            break
        after = steps[high]
        high += 1
    return low, high


@njit(cache=True, nogil=True)
def _even(step, beside):  # type: ignore[no-untyped-def]  # compiled; m, m -> bool
    return step < inf and step <= 3.0 * beside + 0.03 and beside <= 3.0 * step + 0.03


@njit(cache=True, nogil=True)
def _line(points):  # type: ignore[no-untyped-def]  # compiled; (n, 2) -> nx, ny, rms across, rms along
    n = len(points)
    mx = my = 0.0
    for i in range(n):
        mx += points[i, 0]
        my += points[i, 1]
    mx /= n
    my /= n
    xx = xy = yy = 0.0
    for i in range(n):
        dx, dy = points[i, 0] - mx, points[i, 1] - my
        xx += dx * dx
        xy += dx * dy
        yy += dy * dy
    # the eigenvector of the smaller eigenvalue of [[xx, xy], [xy, yy]]
    half = 0.5 * (xx - yy)
    root = sqrt(half * half + xy * xy)
    smaller = 0.5 * (xx + yy) - root
    if root < 1e-12:
        return 1.0, 0.0, 1e9, 0.0
    if half > 0:
        nx, ny = -xy, half + root
    else:
        nx, ny = root - half, -xy
    length = hypot(nx, ny)
    return nx / length, ny / length, sqrt(max(smaller, 0.0) / n), sqrt((smaller + 2 * root) / n)


@njit(cache=True, nogil=True)
def grid_surface(occupied, free, x0, y0, resolution):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    """Points and normals of the surfaces of a grid: (n, 2) m and (n, 2), normals towards free space or (0, 0).

    occupied, free: (h, w) bool, row 0 at y0.  A surface cell is occupied and touches a free one. Its point is moved
    onto the line through the surface cells within two cells, so that steps of one cell do not read as bumps.
    """
    h, w = occupied.shape
    surface = np.zeros((h, w), np.bool_)
    count = 0
    for r in range(h):
        for c in range(w):
            if occupied[r, c] and (
                (r > 0 and free[r - 1, c])
                or (r < h - 1 and free[r + 1, c])
                or (c > 0 and free[r, c - 1])
                or (c < w - 1 and free[r, c + 1])
            ):
                surface[r, c] = True
                count += 1
    points, normals = np.zeros((count, 2)), np.zeros((count, 2))
    near = np.empty((25, 2))
    i = 0
    for r in range(h):
        for c in range(w):
            if not surface[r, c]:
                continue
            k = 0
            fx = fy = 0.0  # from occupied towards free
            for rr in range(max(r - 2, 0), min(r + 3, h)):
                for cc in range(max(c - 2, 0), min(c + 3, w)):
                    if surface[rr, cc]:
                        near[k, 0], near[k, 1] = cc - c, rr - r
                        k += 1
                    if free[rr, cc]:
                        fx += cc - c
                        fy += rr - r
            px = py = 0.0
            if k >= LEAST:
                nx, ny, rms, _ = _line(near[:k])
                if rms < 0.8:
                    along = nx * fx + ny * fy
                    sign = 1.0 if along >= 0 else -1.0
                    normals[i, 0], normals[i, 1] = sign * nx, sign * ny
                    away = 0.0
                    for j in range(k):
                        away += nx * near[j, 0] + ny * near[j, 1]
                    px, py = nx * away / k, ny * away / k
            points[i, 0] = x0 + (c + 0.5 + px) * resolution
            points[i, 1] = y0 + (r + 0.5 + py) * resolution
            i += 1
    return points, normals


@njit(cache=True, nogil=True)
def cell_surface(centres, size):  # type: ignore[no-untyped-def]  # compiled; (n, 2) m, m -> (n, 2) m and (n, 2)
    """Points and normals of the surfaces that a sweep over a grid saw: centres (n, 2) m of its cells, from (0, 0).

    centres: in the order of the beams, of cells `size` m wide.  Each point is moved onto the line through those near it
    that were seen with it, so that neither steps of a cell nor the other side of a wall turn the surface. Normals are
    towards (0, 0), or (0, 0) where no line fits.
    """
    n = len(centres)
    points, normals = centres.copy(), np.zeros((n, 2))
    near = np.empty((2 * MOST + 1, 2))
    for i in range(n):
        k = 0
        for j in range(-min(MOST, (n - 1) // 2), min(MOST, (n - 1) // 2) + 1):
            dx, dy = centres[(i + j) % n, 0] - centres[i, 0], centres[(i + j) % n, 1] - centres[i, 1]
            if dx * dx + dy * dy <= (CELLS_REACH * size) ** 2:
                near[k, 0], near[k, 1] = dx, dy
                k += 1
        if k < LEAST:
            continue
        nx, ny, rms, spread = _line(near[:k])
        if rms >= min(0.5 * size, THIN * spread):
            continue
        away = 0.0
        for j in range(k):
            away += nx * near[j, 0] + ny * near[j, 1]
        points[i, 0] += nx * away / k
        points[i, 1] += ny * away / k
        sign = -1.0 if nx * centres[i, 0] + ny * centres[i, 1] > 0 else 1.0
        normals[i, 0], normals[i, 1] = sign * nx, sign * ny
    return points, normals
