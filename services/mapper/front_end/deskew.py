# SPDX-License-Identifier: Apache-2.0
"""De-skewing: the beams of a sweep in the frame of the robot at the sweep's end.

A laser turns while the robot moves, so each beam starts at another pose. The pose at each beam is interpolated from
odometry, as in KISS-ICP (Vizzo et al., RA-L 2023, section III-A), but linearly between samples of odometry.
"""

from math import cos, isnan, nan, sin

import numpy as np
from numba import njit

from shared.config import Mount
from shared.geometry import Pose2
from shared.messages import LaserScan
from shared.types import Float64s


def deskew(scan: LaserScan, mount: Mount, times: Float64s, end_from_base: Float64s) -> tuple[Float64s, Float64s]:
    """Origins and ends of the beams: two (n, 2) float64, m in `base` at the sweep's end; ends are NaN without an echo.

    times: (k,) s from the sweep's end, <= 0 and rising.  end_from_base: (k, 3) x, y m and yaw rad at these times, yaw
    unwrapped. The motion between them is linear. A range that is NaN, under range_min, or not under range_max has no
    echo.
    """
    origins, ends = _deskew(
        scan.ranges.astype(np.float64),  # a message's array is read-only: numba would compile for that type too
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


def redeskew(points: Float64s, assumed: Pose2, actual: Pose2, remaining: Float64s) -> Float64s:
    """Points (n, 2) m in `base`, de-skewed with an assumed motion, as they are with the actual one. NaN stays NaN.

    assumed, actual: motion over some time.  remaining: (n,) share of that time that follows each beam.
    """
    rows = [np.outer(remaining, (p.x, p.y, p.yaw)) for p in (assumed.inverse(), actual.inverse())]
    (x, y, yaw), (x1, y1, yaw1) = rows[0].T, rows[1].T
    dx, dy = points[:, 0] - x, points[:, 1] - y
    c, s = np.cos(yaw1 - yaw), np.sin(yaw1 - yaw)
    return np.column_stack((x1 + c * dx - s * dy, y1 + s * dx + c * dy))


def remove_twist(remaining: Float64s, twist: float, *arrays: Float64s) -> tuple[Float64s, ...]:
    """Points or normals, arrays (n, 2) in `base`, without the sweep's twist.

    twist: rad that the robot turned during the sweep beyond the turn that de-skewing removed.
    remaining: (n,) share of the sweep that follows each beam: 1 for the first beam, 0 for the last.
    """
    if twist == 0:
        return arrays
    c, s = np.cos(remaining * twist), np.sin(remaining * twist)
    turned = tuple(np.empty_like(array) for array in arrays)
    for array, out in zip(arrays, turned):
        x, y = array[:, 0], array[:, 1]
        out[:, 0] = c * x + s * y
        out[:, 1] = c * y - s * x
    return turned


@njit(cache=True, nogil=True)
def _deskew(  # type: ignore[no-untyped-def]  # compiled; `deskew` is its typed interface
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
