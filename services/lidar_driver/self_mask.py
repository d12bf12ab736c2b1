# SPDX-License-Identifier: Apache-2.0
"""Which beams hit the robot itself?"""

from math import pi

import numpy as np

from services.lidar_driver.device import Bools, Float32s, Float64s
from shared.config import Mount


def masked_angles(angles: Float64s, masks: tuple[tuple[float, float], ...]) -> Bools:
    """(n,) rad -> (n,): whether an angle is in a mask (from, to), rad, counter-clockwise, both ends included."""
    found = np.zeros(len(angles), bool)
    for begin, end in masks:
        found |= (angles - begin + 1e-9) % (2 * pi) <= (end - begin) % (2 * pi) + 2e-9
    return found


def on_robot(ranges: Float32s, angles: Float64s, mount: Mount, corners: Float64s, margin: float) -> Bools:
    """(n,): whether a beam ends in the footprint, or within `margin` m of it.

    ranges, angles: (n,) m, rad in `laser`.  mount: base_from_laser.  corners: (c, 2) m in `base`, counter-clockwise.
    """
    reach = float(np.hypot(*corners.T).max()) + margin + float(np.hypot(mount.x, mount.y))
    near = np.flatnonzero(ranges <= reach)
    found = np.zeros(len(ranges), bool)
    if not len(near):
        return found
    heading = angles[near] + mount.yaw
    x, y = mount.x + ranges[near] * np.cos(heading), mount.y + ranges[near] * np.sin(heading)
    ends = np.roll(corners, -1, axis=0)
    inside = np.zeros(len(near), bool)
    closest = np.full(len(near), np.inf)
    for (ax, ay), (bx, by) in zip(corners, ends):
        crosses = (ay > y) != (by > y)
        slope = (bx - ax) / (by - ay) if by != ay else 0.0
        inside ^= crosses & (x < ax + slope * (y - ay))
        edge_x, edge_y = bx - ax, by - ay
        share = np.clip(((x - ax) * edge_x + (y - ay) * edge_y) / (edge_x**2 + edge_y**2), 0, 1)
        closest = np.minimum(closest, np.hypot(x - ax - share * edge_x, y - ay - share * edge_y))
    found[near] = inside | (closest < margin)
    return found
