# SPDX-License-Identifier: Apache-2.0
"""A short open tour through frontiers: nearest neighbour and Or-2-opt (Croes 1958)."""

import numpy as np
from numba import njit

from shared.types import Float64s, Int64s

_MIN_GAIN_M = 1e-9  # of an improvement


@njit(cache=True, nogil=True)
def tours(first: Float64s, between: Float64s) -> Float64s:
    """(n,) m: for each place the length of a short tour through all places that begins with it.

    first: (n,) m from the robot. between: (n, n) m, symmetric.
    """
    n = len(first)
    lengths = np.empty(n)
    for start in range(n):
        order = _nearest_neighbour_order(start, between)
        while _improve(order, between):
            pass
        lengths[start] = first[start] + _length(order, between)
    return lengths


@njit(cache=True, nogil=True)
def _length(order: Int64s, between: Float64s) -> float:
    length = 0.0
    for i in range(len(order) - 1):
        length += between[order[i], order[i + 1]]
    return length


@njit(cache=True, nogil=True)
def _nearest_neighbour_order(start: int, between: Float64s) -> Int64s:
    n = len(between)
    order = np.empty(n, np.int64)
    todo = np.ones(n, np.bool_)
    here = start
    for i in range(n):
        order[i] = here
        todo[here] = False
        nearest, min_distance = -1, np.inf
        for k in range(n):
            if todo[k] and between[here, k] < min_distance:
                nearest, min_distance = k, between[here, k]
        here = nearest
    return order


@njit(cache=True, nogil=True)
def _improve(order: Int64s, between: Float64s) -> bool:
    """Reverses a section, or moves one place, where that shortens the tour. The first place stays. Returns whether it
    did.
    """
    n = len(order)
    for i in range(1, n - 1):
        for k in range(i + 1, n):
            before = between[order[i - 1], order[i]]
            after = between[order[i - 1], order[k]]
            if k + 1 < n:
                before += between[order[k], order[k + 1]]
                after += between[order[i], order[k + 1]]
            if after < before - _MIN_GAIN_M:
                order[i : k + 1] = order[i : k + 1][::-1].copy()
                return True
    for i in range(1, n):
        moved = order[i]
        rest = np.concatenate((order[:i], order[i + 1 :]))
        for k in range(1, n):
            candidate = np.concatenate((rest[:k], np.array([moved]), rest[k:]))
            if _length(candidate, between) < _length(order, between) - _MIN_GAIN_M:
                order[:] = candidate
                return True
    return False
