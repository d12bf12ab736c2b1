# SPDX-License-Identifier: Apache-2.0
"""Map of surface points with normals in hashed cells, for nearest-neighbour search.

The points keep a distance from each other, so that the map grows with the area and not with the number of scans. As the
voxel map of KISS-ICP (Vizzo et al., RA-L 2023, section III-C), with normals.
"""

from math import floor

import numpy as np
from numba import njit

from shared.types import Bools, Float32s, Float64s, Int32s, Int64s

CELL_M = 0.25  # a search within 0.5 m reads 25 cells
EMPTY = np.int64(-(2**63))  # key of a free slot
MIN_NORMAL_COSINE = 0.7  # between two normals of one surface


class PointMap:
    """Points (n, 4) float64: x, y m and normal nx, ny, which is (0, 0) where the surface has no direction.

    spacing: m between two points, at least.

    Arrays have room for more than `n` rows. `following` chains the points of a cell; `keys` and `heads` are the hash
    table from cell to first point.
    covariances, positions, stamps: (n, 3, 3) m and rad, (n, 2) m and (n,) ns of the pose at which a point was seen.
    """

    def __init__(self, spacing: float) -> None:
        self.spacing = spacing
        self.clear()

    def clear(self) -> None:
        """Removes all points."""
        self.n = 0
        self.n_cells = 0
        self.n_with_pose = 0
        self.points: Float64s = np.zeros((1024, 4))
        self.weights: Int32s = np.zeros(1024, np.int32)
        self.following: Int32s = np.zeros(1024, np.int32)
        # as long as `points` after the first `set_pose_of_new_points`
        self.covariances: Float32s = np.zeros((0, 3, 3), np.float32)
        self.positions: Float32s = np.zeros((0, 2), np.float32)
        self.stamps: Int64s = np.zeros(0, np.int64)
        self.keys: Int64s = np.full(4096, EMPTY, np.int64)
        self.heads: Int32s = np.full(4096, -1, np.int32)

    def insert(self, points: Float64s, normals: Float64s) -> None:
        """Adds points (k, 2) m with normals (k, 2). A point within `spacing` of a known one refines its surface."""
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

    def set_pose_of_new_points(self, x: float, y: float, covariance: Float64s | Float32s, stamp: int) -> None:
        """Sets the pose of the points that are new since the last call: x, y m, its covariance (3, 3), stamp ns."""
        more = len(self.points) - len(self.covariances)
        if more:
            self.covariances = np.concatenate((self.covariances, np.zeros((more, 3, 3), np.float32)))
            self.positions = np.concatenate((self.positions, np.zeros((more, 2), np.float32)))
            self.stamps = np.concatenate((self.stamps, np.zeros(more, np.int64)))
        self.covariances[self.n_with_pose : self.n] = covariance
        self.positions[self.n_with_pose : self.n] = x, y
        self.stamps[self.n_with_pose : self.n] = stamp
        self.n_with_pose = self.n

    def remove(self, mask: Bools) -> None:
        """Removes the points of a mask (n,). They keep their rows, at infinity."""
        self.points[: self.n][mask, :2] = np.inf

    @property
    def index(self) -> tuple[Float64s, Int32s, Int64s, Int32s]:
        """The last four arguments of `nearest`."""
        return self.points, self.following, self.keys, self.heads


@njit(cache=True, nogil=True)
def slot_of(keys, ix, iy):  # type: ignore[no-untyped-def]  # compiled
    """Slot in `keys` of the cell at column ix and row iy, or the free one for it, and the key of that cell.

    Linear probing; len(keys) is a power of two.
    """
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
    """Index of the nearest point with a compatible normal, and its squared distance, m^2; -1 without one in `gate` m.

    x, y: m.  nx, ny: normal, (0, 0) if unknown.  The last four: `PointMap.index`.  The search goes ring by ring, until
    no ring can hold a nearer point.
    """
    ix, iy = floor(x / CELL_M), floor(y / CELL_M)
    best, best_d = -1, gate * gate
    directed = nx != 0.0 or ny != 0.0
    # m to the nearest side of the point's own cell: a ring r cells out is at least that + (r - 1) cells away
    fx, fy = x - ix * CELL_M, y - iy * CELL_M
    edge = min(min(fx, CELL_M - fx), min(fy, CELL_M - fy))
    for ring in range(int(gate / CELL_M) + 2):
        if ring > 0 and (edge + (ring - 1) * CELL_M) ** 2 > best_d:
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
                        if not directed or (px == 0.0 and py == 0.0) or px * nx + py * ny > MIN_NORMAL_COSINE:
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
                # moves across the surface only: along it the spacing must stay
                w = 1.0 / (weights[i] + 1)
                across = w * ((x - points[i, 0]) * px + (y - points[i, 1]) * py)
                points[i, 0] += across * px
                points[i, 1] += across * py
                px, py = px + w * (nx - px), py + w * (ny - py)
                length = np.sqrt(px * px + py * py)
                points[i, 2], points[i, 3] = px / length, py / length
                weights[i] += 1
            continue
        slot, key = slot_of(keys, floor(x / CELL_M), floor(y / CELL_M))
        if keys[slot] == EMPTY:
            keys[slot] = key
            n_cells += 1
        points[n, 0], points[n, 1], points[n, 2], points[n, 3] = x, y, nx, ny
        weights[n] = 1
        following[n] = heads[slot]
        heads[slot] = n
        n += 1
    return n, n_cells
