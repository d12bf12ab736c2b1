# SPDX-License-Identifier: Apache-2.0
"""Where each beam of a sweep started and ended, seen from the robot at the sweep's end."""

from math import cos, isnan, nan, sin

import numpy as np
from numba import njit
from numpy.typing import NDArray

from shared.config import Mount
from shared.geometry import Pose2
from shared.messages import LaserScan

Float64s = NDArray[np.float64]


def deskewed(scan: LaserScan, mount: Mount, times: Float64s, end_from_base: Float64s) -> tuple[Float64s, Float64s]:
    """Origins and end points of the beams in `base` at the sweep's end: two (n, 2) m; ends are NaN without an echo.

    times: (k,) s before the sweep's end (<= 0, rising).  end_from_base: (k, 3) poses then, yaw unwrapped.
    Between them the motion is linear. A range at or over range_max, under range_min or NaN is no measurement.
    """
    origins, ends = _deskewed(
        scan.ranges.astype(np.float64),  # a message's array is read-only, which is another type to the compiler
        scan.angle_min,
        scan.angle_increment,
        scan.scan_time,
        scan.range_min,
        scan.range_max,
        (mount.x, mount.y, mount.yaw),
        times,
        end_from_base,
    )
    return origins, ends


def straightened(points: Float64s, taken: Pose2, moved: Pose2, share: float) -> Float64s:
    """Points (n, 2) m in `base`, de-skewed with a motion that was not, as they are with the one that was.

    taken, moved: the motion since the sweep before.  share: of it, that the sweep took. NaN stays NaN.
    """
    back = share * np.linspace(1, 0, len(points))
    rows = [np.outer(back, (p.x, p.y, p.yaw)) for p in (taken.inverse(), moved.inverse())]
    (x, y, yaw), (x1, y1, yaw1) = rows[0].T, rows[1].T
    dx, dy = points[:, 0] - x, points[:, 1] - y
    c, s = np.cos(yaw1 - yaw), np.sin(yaw1 - yaw)
    return np.column_stack((x1 + c * dx - s * dy, y1 + s * dx + c * dy))


def turned_back(points: Float64s, back: Float64s, twist: float) -> Float64s:
    """Points, or normals, (n, 2) in `base` of a sweep that was twisted by `twist` rad more than it was de-skewed with.

    back: (n,), share of the sweep from each to its end, where the robot is.
    """
    if twist == 0:
        return points
    c, s = np.cos(back * twist), np.sin(back * twist)
    return np.column_stack((c * points[:, 0] + s * points[:, 1], c * points[:, 1] - s * points[:, 0]))


@njit(cache=True, nogil=True)
def _deskewed(  # type: ignore[no-untyped-def]  # compiled; `deskewed` is the typed door
    ranges, angle_min, angle_increment, scan_time, range_min, range_max, mount, times, poses
):
    n, k = len(ranges), len(times)
    origins, ends = np.empty((n, 2)), np.empty((n, 2))
    a = 0
    for i in range(n):
        time = scan_time * (i / (n - 1) - 1) if n > 1 else 0.0
        while a < k - 2 and times[a + 1] < time:
            a += 1
        x, y, yaw = poses[a]
        if k > 1:
            span = times[a + 1] - times[a]
            share = min(max((time - times[a]) / span, 0.0), 1.0) if span > 0 else 1.0
            x += share * (poses[a + 1, 0] - x)
            y += share * (poses[a + 1, 1] - y)
            yaw += share * (poses[a + 1, 2] - yaw)
        c, s = cos(yaw), sin(yaw)
        origins[i, 0] = x + c * mount[0] - s * mount[1]
        origins[i, 1] = y + s * mount[0] + c * mount[1]
        r = float(ranges[i])
        if isnan(r) or r < range_min or r >= range_max or r <= 0.0:
            ends[i] = nan
        else:
            angle = yaw + mount[2] + angle_min + i * angle_increment
            ends[i, 0] = origins[i, 0] + r * cos(angle)
            ends[i, 1] = origins[i, 1] + r * sin(angle)
    return origins, ends
