# SPDX-License-Identifier: Apache-2.0
"""Which beams hit the robot itself?"""

from math import pi

import numpy as np

from shared.config import Mount
from shared.polygon import signed_distances
from shared.types import Bools, Float32s, Float64s


def masked_angles(angles: Float64s, masks: tuple[tuple[float, float], ...]) -> Bools:
    """(n,) rad -> (n,): whether an angle is in a mask (from, to), rad, counter-clockwise, both ends included."""
    is_masked = np.zeros(len(angles), bool)
    for begin, end in masks:
        is_masked |= (angles - begin + 1e-9) % (2 * pi) <= (end - begin) % (2 * pi) + 2e-9
    return is_masked


def on_robot(ranges: Float32s, angles: Float64s, mount: Mount, corners: Float64s, margin: float) -> Bools:
    """(n,): whether a beam ends in the footprint, or within `margin` m of it.

    ranges, angles: (n,) m, rad in `laser`.  mount: base_from_laser.  corners: (c, 2) m in `base`, counter-clockwise.
    """
    reach = float(np.hypot(*corners.T).max()) + margin + float(np.hypot(mount.x, mount.y))
    near = np.flatnonzero(ranges <= reach)
    is_on_robot = np.zeros(len(ranges), bool)
    if not len(near):
        return is_on_robot
    heading = angles[near] + mount.yaw
    x, y = mount.x + ranges[near] * np.cos(heading), mount.y + ranges[near] * np.sin(heading)
    is_on_robot[near] = signed_distances(corners, np.column_stack((x, y))) < margin
    return is_on_robot
