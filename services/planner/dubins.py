# SPDX-License-Identifier: Apache-2.0
"""The shortest forward paths between two poses by arcs of one radius and a straight line: Dubins 1957.

The six words as in Shkel and Lumelsky 2001; and an arc with a line where the last heading does not matter. A path is
three pieces (curvature, length): positive curvature turns left; any unit of length.
"""

from math import acos, atan2, cos, hypot, pi, sin, sqrt

from numba import njit

from shared.types import Float64s

N_WORDS = 6
_MIN_CURVATURE = 1e-9  # curvature below which a piece is a line


@njit(cache=True, nogil=True)
def dubins_word(i: int, start: Float64s, end: Float64s, radius: float, any_heading: bool, pieces: Float64s) -> bool:
    """Fills pieces (3, 2) with word i, 0 to N_WORDS - 1, between poses (x, y, yaw). Returns whether it exists.

    radius: of the arcs, in the unit of x and y; yaw: rad. any_heading: the yaw of `end` does not count.
    """
    dx, dy = end[0] - start[0], end[1] - start[1]
    if any_heading:
        return i < 2 and _arc_and_line(1.0 if i == 0 else -1.0, dx, dy, start[2], radius, pieces)
    d, theta = hypot(dx, dy) / radius, atan2(dy, dx)
    a, b = _wrapped_two_pi(start[2] - theta), _wrapped_two_pi(end[2] - theta)
    sa, sb, ca, cb, cab = sin(a), sin(b), cos(a), cos(b), cos(a - b)
    first, second, third = 0, 0, 0
    t = p = q = 0.0
    if i == 0:  # left, straight, left
        squared = 2 + d * d - 2 * cab + 2 * d * (sa - sb)
        if squared < 0:
            return False
        away = atan2(cb - ca, d + sa - sb)
        t, p, q = _wrapped_two_pi(away - a), sqrt(squared), _wrapped_two_pi(b - away)
        first, third = 1, 1
    elif i == 1:  # right, straight, right
        squared = 2 + d * d - 2 * cab + 2 * d * (sb - sa)
        if squared < 0:
            return False
        away = atan2(ca - cb, d - sa + sb)
        t, p, q = _wrapped_two_pi(a - away), sqrt(squared), _wrapped_two_pi(away - b)
        first, third = -1, -1
    elif i == 2:  # left, straight, right
        squared = -2 + d * d + 2 * cab + 2 * d * (sa + sb)
        if squared < 0:
            return False
        p = sqrt(squared)
        away = atan2(-ca - cb, d + sa + sb) - atan2(-2.0, p)
        t, q = _wrapped_two_pi(away - a), _wrapped_two_pi(away - b)
        first, third = 1, -1
    elif i == 3:  # right, straight, left
        squared = d * d - 2 + 2 * cab - 2 * d * (sa + sb)
        if squared < 0:
            return False
        p = sqrt(squared)
        away = atan2(ca + cb, d - sa - sb) - atan2(2.0, p)
        t, q = _wrapped_two_pi(a - away), _wrapped_two_pi(b - away)
        first, third = -1, 1
    else:  # three arcs
        side = -1.0 if i == 4 else 1.0  # right, left, right; or its mirror image
        cosine = (6 - d * d + 2 * cab + side * 2 * d * (sb - sa)) / 8
        if abs(cosine) > 1:
            return False
        p = 2 * pi - acos(cosine)
        away = atan2(ca - cb, d - sa + sb) if i == 4 else atan2(ca - cb, d + sa - sb)
        if i == 4:
            t = _wrapped_two_pi(a - away + p / 2)
            q = _wrapped_two_pi(a - b - t + p)
        else:
            t = _wrapped_two_pi(-a - away + p / 2)
            q = _wrapped_two_pi(b - a - t + p)
        first, second, third = int(side), int(-side), int(side)
    pieces[0, 0], pieces[0, 1] = first / radius, t * radius
    pieces[1, 0], pieces[1, 1] = second / radius, p * radius
    pieces[2, 0], pieces[2, 1] = third / radius, q * radius
    return True


@njit(cache=True, nogil=True)
def _arc_and_line(side: float, dx: float, dy: float, yaw: float, radius: float, pieces: Float64s) -> bool:
    """Fills pieces with an arc and the line to a point, at any heading there."""
    ahead, aside = cos(yaw) * dx + sin(yaw) * dy, side * (cos(yaw) * dy - sin(yaw) * dx)
    away = hypot(ahead, aside - radius)  # of the point from the centre of the arc
    if away < radius:
        return False
    line = sqrt(max(away * away - radius * radius, 0.0))
    # from the arc's end the point lies `line` ahead, and the centre a radius aside
    turn = _wrapped_two_pi(atan2(aside - radius, ahead) + atan2(radius, line))
    pieces[:] = 0.0
    pieces[0, 0], pieces[0, 1] = side / radius, turn * radius
    pieces[1, 1] = line
    return True


@njit(cache=True, nogil=True)
def _wrapped_two_pi(angle: float) -> float:
    """The angle in [0, 2 pi); a full turn less rounding is 0."""
    angle %= 2 * pi
    return 0.0 if angle > 2 * pi - 1e-9 else angle


@njit(cache=True, nogil=True)
def pose_after(pose: Float64s, curvature: float, length: float, out: Float64s) -> None:
    """Fills `out` (3,) with the pose (x, y, yaw) at the end of a piece.

    curvature: rad per unit of length, positive to the left; length: in the unit of x and y.
    """
    x, y, yaw = pose
    if abs(curvature) < _MIN_CURVATURE:
        out[0], out[1], out[2] = x + length * cos(yaw), y + length * sin(yaw), yaw
        return
    there = yaw + curvature * length
    out[0] = x + (sin(there) - sin(yaw)) / curvature
    out[1] = y + (cos(yaw) - cos(there)) / curvature
    out[2] = there
