# SPDX-License-Identifier: Apache-2.0
"""The map that scans are matched with: points with normals in hashed cells, thinned, so that it grows with the area."""

from math import floor

import numpy as np
from numba import njit
from numpy.typing import NDArray

Float32s = NDArray[np.float32]
Float64s = NDArray[np.float64]
Int32s = NDArray[np.int32]
Int64s = NDArray[np.int64]
Bools = NDArray[np.bool_]

CELL = 0.25  # m: a search within 0.5 m looks at 25 cells
EMPTY = np.int64(-(2**63))
AGREE = 0.7  # cosine between normals of one surface


class PointMap:
    """Points (x, y, nx, ny), float64; (nx, ny) is 0 where the surface has no direction. Cells are lists in a hash.

    doubts, places: (n, 3, 3) and (n, 2), how unsure the pose was from which a point was drawn, and where that was.
    stamps: (n,) ns, when that was.
    """

    def __init__(self, spacing: float) -> None:
        self.spacing = spacing
        self.clear()

    def clear(self) -> None:
        self.n = 0
        self.n_cells = 0
        self.n_signed = 0
        self.points: Float64s = np.zeros((1024, 4))
        self.weights: Int32s = np.zeros(1024, np.int32)
        self.following: Int32s = np.zeros(1024, np.int32)
        self.doubts: Float32s = np.zeros((0, 3, 3), np.float32)  # as long as `points` from the first `sign` on
        self.places: Float32s = np.zeros((0, 2), np.float32)
        self.stamps: Int64s = np.zeros(0, np.int64)
        self.keys: Int64s = np.full(4096, EMPTY, np.int64)
        self.heads: Int32s = np.full(4096, -1, np.int32)

    def insert(self, points: Float64s, normals: Float64s) -> None:
        """Adds points (n, 2) m with normals (n, 2). A point of a known surface, nearer than `spacing`, sharpens it."""
        while self.n + len(points) > len(self.points):
            self.points = np.concatenate((self.points, np.zeros_like(self.points)))
            self.weights = np.concatenate((self.weights, np.zeros_like(self.weights)))
            self.following = np.concatenate((self.following, np.zeros_like(self.following)))
        while 2 * (self.n_cells + len(points)) > len(self.keys):
            keys, heads = np.full(2 * len(self.keys), EMPTY, np.int64), np.full(2 * len(self.keys), -1, np.int32)
            _rehash(self.keys, self.heads, keys, heads)
            self.keys, self.heads = keys, heads
        self.n, self.n_cells = _insert(
            points, normals, self.spacing, self.points, self.weights, self.following, self.keys, self.heads,
            self.n, self.n_cells,
        )  # fmt: skip

    def sign(self, x: float, y: float, doubt: Float64s | Float32s, stamp: int) -> None:
        """What is new since the last call was drawn from a pose at x, y m, with this covariance (3, 3), at stamp ns."""
        more = len(self.points) - len(self.doubts)
        if more:
            self.doubts = np.concatenate((self.doubts, np.zeros((more, 3, 3), np.float32)))
            self.places = np.concatenate((self.places, np.zeros((more, 2), np.float32)))
            self.stamps = np.concatenate((self.stamps, np.zeros(more, np.int64)))
        self.doubts[self.n_signed : self.n] = doubt
        self.places[self.n_signed : self.n] = x, y
        self.stamps[self.n_signed : self.n] = stamp
        self.n_signed = self.n

    def forget(self, gone: Bools) -> None:
        """Points (n,) that are there no more: nothing is matched with them again."""
        self.points[: self.n][gone, :2] = np.inf

    @property
    def index(self) -> tuple[Float64s, Int32s, Int64s, Int32s]:
        """What `nearest` needs of it."""
        return self.points, self.following, self.keys, self.heads


@njit(cache=True, nogil=True)
def slot_of(keys, ix, iy):  # type: ignore[no-untyped-def]  # compiled; -> index of the cell in keys, or of the place where it would be
    """Linear probing; the mask works because the length is a power of two."""
    key = (np.int64(ix) << 32) ^ (np.int64(iy) & np.int64(0xFFFFFFFF))
    mask = np.int64(len(keys) - 1)
    mixed = key * np.int64(-7046029254386353131)
    slot = (mixed ^ (mixed >> 29)) & mask
    while keys[slot] != key and keys[slot] != EMPTY:
        slot = (slot + 1) & mask
    return slot, key


@njit(cache=True, nogil=True)
def _rehash(keys, heads, new_keys, new_heads):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    for i in range(len(keys)):
        if keys[i] != EMPTY:
            low = keys[i] & np.int64(0xFFFFFFFF)
            iy = low - (np.int64(1) << 32) if low >= (np.int64(1) << 31) else low
            ix = (keys[i] ^ (iy & np.int64(0xFFFFFFFF))) >> 32
            slot, key = slot_of(new_keys, ix, iy)
            new_keys[slot], new_heads[slot] = key, heads[i]


@njit(cache=True, nogil=True)
def nearest(x, y, nx, ny, gate, points, following, keys, heads):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    """Index of the nearest point within `gate` (m) whose normal does not contradict, and its squared distance; or -1.

    Looks ring by ring, and stops when no farther ring can hold a nearer one.
    """
    ix, iy = floor(x / CELL), floor(y / CELL)
    best, best_d = -1, gate * gate
    directed = nx != 0.0 or ny != 0.0
    # m to the nearest side of the point's own cell: a ring r cells out is at least that + (r - 1) cells away
    fx, fy = x - ix * CELL, y - iy * CELL
    edge = min(min(fx, CELL - fx), min(fy, CELL - fy))
    for ring in range(int(gate / CELL) + 2):
        if ring > 0 and (edge + (ring - 1) * CELL) ** 2 > best_d:
            break
        for jy in range(iy - ring, iy + ring + 1):
            step = 1 if jy == iy - ring or jy == iy + ring or ring == 0 else 2 * ring
            for jx in range(ix - ring, ix + ring + 1, step):
                slot, key = slot_of(keys, jx, jy)
                if keys[slot] != key:
                    continue
                i = heads[slot]
                while i >= 0:
                    dx, dy = points[i, 0] - x, points[i, 1] - y
                    d = dx * dx + dy * dy
                    if d < best_d:
                        px, py = points[i, 2], points[i, 3]
                        if not directed or (px == 0.0 and py == 0.0) or px * nx + py * ny > AGREE:
                            best, best_d = i, d
                    i = following[i]
    return best, best_d


@njit(cache=True, nogil=True)
def _insert(  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    new, normals, spacing, points, weights, following, keys, heads, n, n_cells
):
    for k in range(len(new)):
        x, y, nx, ny = new[k, 0], new[k, 1], normals[k, 0], normals[k, 1]
        i, _ = nearest(x, y, nx, ny, spacing, points, following, keys, heads)
        if i >= 0:
            px, py = points[i, 2], points[i, 3]
            if px == 0.0 and py == 0.0:
                if nx != 0.0 or ny != 0.0:
                    points[i, 2], points[i, 3] = nx, ny
            elif (nx != 0.0 or ny != 0.0) and weights[i] < 20:
                # only across the surface: along it the spacing is to stay
                w = 1.0 / (weights[i] + 1)
                across = w * ((x - points[i, 0]) * px + (y - points[i, 1]) * py)
                points[i, 0] += across * px
                points[i, 1] += across * py
                px, py = px + w * (nx - px), py + w * (ny - py)
                length = np.sqrt(px * px + py * py)
                points[i, 2], points[i, 3] = px / length, py / length
                weights[i] += 1
            continue
        slot, key = slot_of(keys, floor(x / CELL), floor(y / CELL))
        if keys[slot] == EMPTY:
            keys[slot] = key
            n_cells += 1
        points[n, 0], points[n, 1], points[n, 2], points[n, 3] = x, y, nx, ny
        weights[n] = 1
        following[n] = heads[slot]
        heads[slot] = n
        n += 1
    return n, n_cells
