# SPDX-License-Identifier: Apache-2.0
"""Ranges and times of an emulated laser's own beams, from a sweep on the robot's grid."""

from math import pi

import numpy as np

from shared.config import Laser
from shared.messages import LaserScan
from shared.types import Float64s


def ranges_mm(scan: LaserScan, angles: Float64s) -> Float64s:
    """(n,) rad in `laser` -> (n,) mm of the nearest beam; 0 where it read nothing, or none is near."""
    turn = 2 * pi / abs(scan.angle_increment)
    places = ((angles - scan.angle_min) / scan.angle_increment + 0.5) % turn
    index = places.astype(np.int64)
    near = index < len(scan.ranges)
    ranges = scan.ranges[np.where(near, index, 0)].astype(np.float64)
    return np.asarray(np.where(near & ~np.isnan(ranges), np.nan_to_num(ranges) * 1000, 0.0), np.float64)


def first_angle(scan: LaserScan, direction: int) -> float:
    """rad: where the sweep begins for a laser that turns that way (+1 counter-clockwise)."""
    forward = scan.angle_increment * direction > 0
    return scan.angle_min if forward else scan.angle_min + (len(scan.ranges) - 1) * scan.angle_increment


def turn_times(scan: LaserScan, laser: Laser, shares: Float64s) -> list[int]:
    """Times (ns) at which the laser has made these shares (n,) of a turn since the sweep's first beam."""
    return [scan.stamp + round(share * 1e9 / laser.rate) for share in shares.tolist()]


def timed_chunk(ready: int, data: bytes, baud: int) -> tuple[int, bytes]:
    """The time (ns) when the last byte of a chunk is sent, and the chunk. ready: ns, start.  baud: bits/s."""
    return ready + len(data) * 10_000_000_000 // baud, data
