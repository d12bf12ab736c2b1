# SPDX-License-Identifier: Apache-2.0
"""Voxel filter: one point of a scan for each voxel, so that a near wall with many beams does not dominate."""

from math import floor

import numpy as np
from numba import njit

from services.mapper.front_end.point_map import EMPTY, slot_of
from shared.types import Float64s

GROWTH = 1.25  # ratio of the voxel sizes of two tries


def voxel_downsample(points: Float64s, max_points: int, voxel: float) -> Float64s:
    """(k, 2) m, k <= max_points: the first of the points (n, 2) in each voxel.

    voxel: m, smallest size. It grows until few enough points are left, as in Cartographer's adaptive voxel filter.
    """
    while True:
        filtered: Float64s = points[_first_in_voxels(points, voxel)]
        if len(filtered) <= max_points:
            return filtered
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
