# SPDX-License-Identifier: Apache-2.0
"""Surface normals of a sweep and of an occupancy grid, and which beams measured a usable or free-standing point.

Normals are those of lines by total least squares, the planar case of Hoppe et al., "Surface reconstruction from
unorganized points", SIGGRAPH 1992. Gaps are found as by the adaptive breakpoint detector (Borges and Aldon, "Line
extraction in 2D range images for mobile robotics", 2004). The neighbours in a fit, and free-standing beams, are our
own.
"""

from math import hypot, inf, isnan, sqrt

import numpy as np
from numba import njit

MIN_NEIGHBOURS, MAX_NEIGHBOURS = 3, 12  # beams to each side in the fit of a normal
FIT_RADIUS_M = 0.15  # to each side in the fit of a normal, where the surface is flat
MIN_FIT_POINTS = 4
MAX_SLOPE = 12.0  # m along a surface per m across the beams
MAX_GAP_M = 1.0  # between neighbours on one surface
MAX_RMS_RATIO = 0.35  # of the rms across the line to that along it: a leg is no wall
MAX_RMS_M = 0.04  # of the distances from the fitted line
MIN_RANGE_JUMP_M = 0.3  # from a free-standing object to the surfaces beside it
MIN_CROWD_RANGE_JUMP_M = 0.1  # the same in a crowd: two people that overlap are about equally near
MAX_PERSON_M = 0.9  # width of a person with a bag
MAX_PAIR_M = 1.1  # width of two people side by side, or of a person with a trolley
MAX_STEP_M = 0.15  # to a neighbour, of a point without a normal
MAX_SPARSE_STEP_M = 0.4  # farther apart, the next sweep's point on the surface is outside the kernel (0.2 m)
GRID_FIT_CELLS = 3.5  # to each side, in the fit of a normal on a grid


@njit(cache=True, nogil=True)
def usable_beams(origins, ends):  # type: ignore[no-untyped-def]  # compiled; (n, 2), (n, 2) -> (n,) bool
    """Beams whose point the next sweep sees again. Not so are beams that graze a surface, far from their neighbours.

    origins, ends: (n, 2) m, ends NaN without an echo.  Along a corridor such beams hit other spots of the walls each
    time. As points without a normal they would bias the motion towards zero.
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
            if step <= min(max(MAX_STEP_M, 3.0 * across), MAX_SPARSE_STEP_M):
                usable[i] = True
            slope += (1 if hypot(bx, by) > r else -1) * (j - i)
        # nearer or farther than both neighbours: a pole, or a gap between two poles
        usable[i] = usable[i] or n_beside == 0 or (n_beside == 2 and slope == 0)
    return usable


@njit(cache=True, nogil=True)
def free_standing_beams(origins, ends, crowd):  # type: ignore[no-untyped-def]  # compiled; (n, 2), (n, 2), bool -> (n,) bool
    """Beams on an object no wider than a person that stands in front of its background.

    origins, ends: (n, 2) m, ends NaN without an echo.  An object ends where the range jumps. A full circle is closed;
    beside the ends of any other sweep the background counts as far.
    crowd: count wider objects too, and those that a free-standing object hides on one side.
    """
    free_standing = np.zeros(len(ends), np.bool_)
    beams = np.flatnonzero(~np.isnan(ends[:, 0]))
    n = len(beams)
    ranges = np.empty(n)
    for k in range(n):
        ranges[k] = hypot(ends[beams[k], 0] - origins[beams[k], 0], ends[beams[k], 1] - origins[beams[k], 1])
    jumps = np.zeros(n, np.bool_)  # from the previous beam
    min_jump = MIN_CROWD_RANGE_JUMP_M if crowd else MIN_RANGE_JUMP_M
    for k in range(n):
        jumps[k] = abs(ranges[k] - ranges[k - 1]) > min_jump
    if n > 0:
        a, b = ends[beams[0]], ends[beams[n - 1]]
        jumps[0] = jumps[0] or hypot(a[0] - b[0], a[1] - b[1]) > MIN_RANGE_JUMP_M
    starts = np.flatnonzero(jumps)
    max_width = MAX_PAIR_M if crowd else MAX_PERSON_M
    for i_pass in range(3 if crowd else 1):  # the later passes find objects behind those of the earlier ones
        before = free_standing.copy()
        for k in range(len(starts)):
            first, after = starts[k], starts[(k + 1) % len(starts)]
            last = (after - 1) % n
            if before[beams[first]]:
                continue
            farther_before = first == 0 or ranges[first - 1] > ranges[first]
            farther_after = after == 0 or ranges[after] > ranges[last]
            if i_pass:
                stands = (farther_before and before[beams[after]]) or (farther_after and before[beams[first - 1]])
            else:
                stands = farther_before and farther_after
            a, b = ends[beams[first]], ends[beams[last]]
            if stands and hypot(b[0] - a[0], b[1] - a[1]) < max_width:
                for m in range((last - first) % n + 1):
                    free_standing[beams[(first + m) % n]] = True
    return free_standing


@njit(cache=True, nogil=True)
def sweep_normals(origins, ends):  # type: ignore[no-untyped-def]  # compiled; (n, 2), (n, 2) -> (n, 2) float64
    """(n, 2) unit normals towards the laser, (0, 0) where no line fits.

    origins, ends: (n, 2) m, ends NaN without an echo.  The line is fitted by total least squares over beams without a
    gap. A gap is a step longer than on a surface seen at 85 degrees from its normal. A step out of proportion to the
    step beside it is a gap, too, as two clusters always lie on a line.
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
        steps[i] = step if step < max(MAX_SLOPE * across, 0.06) and step < MAX_GAP_M else inf
    for i in range(n):
        if isnan(ends[i, 0]):
            continue
        nx = ny = 0.0
        # near surfaces need many beams, or noise turns the normals; where they bend within FIT_RADIUS_M, few must do
        for reach in (FIT_RADIUS_M, 0.0):
            low, high = _neighbours(i, reach, ends, steps)
            if high - low + 1 < MIN_FIT_POINTS:
                break
            nx, ny, rms, spread = _fit_line(ends[low : high + 1])
            if rms < MAX_RMS_M and rms < MAX_RMS_RATIO * spread:
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
    while low > 0 and _is_even(steps[low - 1], before):
        away = hypot(ends[low, 0] - ends[i, 0], ends[low, 1] - ends[i, 1])
        if i - low >= MAX_NEIGHBOURS or (i - low >= MIN_NEIGHBOURS and away >= reach):
            break
        low -= 1
        before = steps[low]
    while high < len(ends) - 1 and _is_even(steps[high], after):
        away = hypot(ends[high, 0] - ends[i, 0], ends[high, 1] - ends[i, 1])
        if high - i >= MAX_NEIGHBOURS or (high - i >= MIN_NEIGHBOURS and away >= reach):
            break
        after = steps[high]
        high += 1
    return low, high


@njit(cache=True, nogil=True)
def _is_even(step, beside):  # type: ignore[no-untyped-def]  # compiled; m, m -> bool
    return step < inf and step <= 3.0 * beside + 0.03 and beside <= 3.0 * step + 0.03


@njit(cache=True, nogil=True)
def _fit_line(points):  # type: ignore[no-untyped-def]  # compiled; (n, 2) -> nx, ny, rms across, rms along
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
    """Points (n, 2) m and normals (n, 2) of the surfaces of a grid. A normal points to free space, or is (0, 0).

    occupied, free: (h, w) bool, row 0 at y0.  x0, y0: m, lower left corner.  resolution: m a cell.
    A surface cell is occupied and touches a free one. Its point is projected onto the line through the surface cells
    within two cells, so that steps of one cell do not appear as bumps.
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
            if k >= MIN_FIT_POINTS:
                nx, ny, rms, _ = _fit_line(near[:k])
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
    """Points (n, 2) m and normals (n, 2) of the surfaces that a sweep from (0, 0) over a grid sees.

    centres: (n, 2) m, cells `size` m wide, in the order of the beams.  Each point is projected onto the line through
    the near points of the same sweep. So neither steps of a cell nor the other side of a wall turn the surface.
    Normals point to (0, 0), or are (0, 0) where no line fits.
    """
    n = len(centres)
    points, normals = centres.copy(), np.zeros((n, 2))
    near = np.empty((2 * MAX_NEIGHBOURS + 1, 2))
    for i in range(n):
        k = 0
        for j in range(-min(MAX_NEIGHBOURS, (n - 1) // 2), min(MAX_NEIGHBOURS, (n - 1) // 2) + 1):
            dx, dy = centres[(i + j) % n, 0] - centres[i, 0], centres[(i + j) % n, 1] - centres[i, 1]
            if dx * dx + dy * dy <= (GRID_FIT_CELLS * size) ** 2:
                near[k, 0], near[k, 1] = dx, dy
                k += 1
        if k < MIN_FIT_POINTS:
            continue
        nx, ny, rms, spread = _fit_line(near[:k])
        if rms >= min(0.5 * size, MAX_RMS_RATIO * spread):
            continue
        away = 0.0
        for j in range(k):
            away += nx * near[j, 0] + ny * near[j, 1]
        points[i, 0] += nx * away / k
        points[i, 1] += ny * away / k
        sign = -1.0 if nx * centres[i, 0] + ny * centres[i, 1] > 0 else 1.0
        normals[i, 0], normals[i, 1] = sign * nx, sign * ny
    return points, normals
