# SPDX-License-Identifier: Apache-2.0
"""A scan thinned evenly over space, so that a near wall with many beams does not outvote the rest."""

from math import floor

import numpy as np
from numba import njit

from services.mapper.point_map import EMPTY, slot_of
from shared.geometry import Float64s

GROWTH = 1.25  # of the voxels from one try to the next


def thinned(points: Float64s, most: int, voxel: float) -> Float64s:
    """At most `most` of the points (n, 2): the first of each voxel, the voxels as small as that allows, from `voxel` m.

    Even over space, so that a near wall with many beams does not outvote the rest (Cartographer's adaptive filter).
    """
    while True:
        kept: Float64s = points[_first_in_voxels(points, voxel)]
        if len(kept) <= most:
            return kept
        voxel *= GROWTH


@njit(cache=True, nogil=True)
def _first_in_voxels(points, voxel):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    n_slots = 16
    while n_slots < 2 * len(points):
        n_slots *= 2
    keys = np.full(n_slots, EMPTY, np.int64)
    first = np.zeros(len(points), np.bool_)
    for k in range(len(points)):
        slot, key = slot_of(keys, floor(points[k, 0] / voxel), floor(points[k, 1] / voxel))
        if keys[slot] != key:
            keys[slot] = key
            first[k] = True
    return first
