# SPDX-License-Identifier: Apache-2.0
"""Keyframes: the scans that are nodes of the pose graph, and the sweeps that they are made of.

A keyframe is what Cartographer calls a trajectory node; its `silent` are the misses of Cartographer's range data.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from services.mapper.front_end.deskew import remove_twist
from services.mapper.grid.occupancy import Occupancy
from shared.geometry import Pose2, wrapped_all
from shared.types import Bools, Float32s, Float64s, Int64s


@dataclass(frozen=True, slots=True)
class Sweep:
    """Beams of a sweep with an echo: origins, points and normals (n, 2) in `base`, m.

    remaining: (n,) fraction of the sweep time from each beam to the end of the sweep.
    """

    origins: Float64s
    points: Float64s
    normals: Float64s
    remaining: Float64s

    def only(self, which: Bools) -> "Sweep":
        """Returns the beams that a mask (n,) selects."""
        return Sweep(self.origins[which], self.points[which], self.normals[which], self.remaining[which])

    def without_twist(self, twist: float) -> "Sweep":
        """Returns the sweep de-skewed for a turn that is greater by `twist` rad."""
        origins, points, normals = remove_twist(self.remaining, twist, self.origins, self.points, self.normals)
        return Sweep(origins, points, normals, self.remaining)


NO_COVARIANCE = np.zeros((3, 3), np.float32)
"""Covariance of a keyframe that the graph was optimized with."""
NO_RESIDUAL = Pose2()
AnyFloats = Float32s | Float64s

OBJECT_BYTES = 1000  # of a keyframe's Python objects


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A sweep and the pose where it was measured. Its arrays are float32 in one block, as a map holds thousands.

    stamp: ns, end of the sweep.  local_from_base: in the front end's frame, which no closure moves.
    covariance: (3, 3) of the pose relative to the local map, until the graph is optimized (see `pose_covariance`).
    odometry_residual: odometry^-1 @ match for the motion from the keyframe before, in this one's axes.
    by_odometry: the pose by odometry alone, in a frame of its own; None without odometry, or of a saved map.
    """

    stamp: int
    local_from_base: Pose2
    _block: Float32s  # origins, ends, silent, normals, and points that are no ends
    _n_beams: int
    _n_silent: int
    _n_points: int
    _is_point: bytes  # a bit for each end: whether it is one of the points; empty where points are in the block
    covariance: Float32s = field(default_factory=lambda: NO_COVARIANCE, kw_only=True)
    odometry_residual: Pose2 = field(default_factory=Pose2, kw_only=True)
    by_odometry: Pose2 | None = field(default=None, kw_only=True)

    @classmethod
    def of(
        cls,
        stamp: int,
        local_from_base: Pose2,
        origins: AnyFloats,
        ends: AnyFloats,
        points: AnyFloats,
        normals: AnyFloats,
        silent: AnyFloats,
        covariance: AnyFloats = NO_COVARIANCE,
        odometry_residual: Pose2 = NO_RESIDUAL,
        by_odometry: Pose2 | None = None,
    ) -> "Keyframe":
        """Returns a keyframe with the arrays as float32. The other arguments are the fields of these names.

        origins, ends: (n, 2) m in `base`, ends NaN without an echo.
        points, normals: (k, 2) m in `base`, for registration.
        silent: (n, 2) m in `base`, free range of each beam without an echo, NaN elsewhere; dropped where all are NaN.
        """
        silent = silent[:0] if np.isnan(silent).all() else silent
        ends, points = ends.astype(np.float32), points.astype(np.float32)
        is_point = np.isin(_as_numbers(ends), _as_numbers(points))
        apart = points if not np.array_equal(ends[is_point], points) else points[:0]
        return cls(
            stamp,
            local_from_base,
            np.concatenate([array.astype(np.float32) for array in (origins, ends, silent, normals, apart)]),
            len(ends),
            len(silent),
            len(points),
            b"" if len(apart) else np.packbits(is_point).tobytes(),
            covariance=covariance.astype(np.float32),
            odometry_residual=odometry_residual,
            by_odometry=by_odometry,
        )

    @property
    def origins(self) -> Float32s:
        """(n, 2) m in `base`."""
        return self._block[: self._n_beams]

    @property
    def ends(self) -> Float32s:
        """(n, 2) m in `base`, NaN without an echo."""
        return self._block[self._n_beams : 2 * self._n_beams]

    @property
    def silent(self) -> Float32s:
        """(n, 2) m in `base`, free range of each beam without an echo, NaN elsewhere; (0, 2) if there is none."""
        return self._block[2 * self._n_beams :][: self._n_silent]

    @property
    def normals(self) -> Float32s:
        """(k, 2) of the points."""
        return self._block[2 * self._n_beams + self._n_silent :][: self._n_points]

    @property
    def points(self) -> Float32s:
        """(k, 2) m in `base`, for registration; often a copy."""
        if not self._is_point:
            return self._block[len(self._block) - self._n_points :]
        bits = np.unpackbits(np.frombuffer(self._is_point, np.uint8), count=self._n_beams)
        return self.ends[bits.astype(np.bool_)]

    @property
    def n_bytes(self) -> int:
        """Memory of the block and of the Python objects, bytes."""
        return OBJECT_BYTES + self._block.nbytes

    @property
    def origin(self) -> Float64s:
        """Mean origin of the beams, (2,) m in `base`."""
        return np.asarray(np.nanmean(self.origins, axis=0, dtype=np.float64))

    def draw(self, grid: Occupancy, pose: Pose2) -> None:
        """Draws all beams into a grid.  pose: of `base` in the grid's frame."""
        origins, ends = self.origins.astype(np.float64), self.ends.astype(np.float64)
        silent = pose @ self.silent.astype(np.float64) if len(self.silent) else np.full_like(ends, np.nan)
        grid.insert_scan(pose @ origins, pose @ ends, silent)

    def surface(self) -> tuple[Float64s, Float64s]:
        """Returns points (k, 2) m and normals (k, 2) in `base`, float64 for the kernels."""
        return self.points.astype(np.float64), self.normals.astype(np.float64)


def _as_numbers(points: Float32s) -> Int64s:
    """(n,) the bits of each point (n, 2): equal where both coordinates are."""
    return np.ascontiguousarray(points).view(np.int64).ravel()


def mean_map_from_local(keyframes: Sequence[Keyframe], poses: Float64s) -> Pose2:
    """Returns the mean map_from_local of keyframes, as the yaw of a single one would turn all that is far away.

    keyframes: (n,).  poses: (n, 3) m, m, rad of them in `map`.
    """
    local = np.array([(k.local_from_base.x, k.local_from_base.y) for k in keyframes])
    turns = wrapped_all(poses[:, 2] - np.array([k.local_from_base.yaw for k in keyframes]))
    yaw = float(turns[-1] + wrapped_all(turns - turns[-1]).mean())
    x, y = (poses[:, :2] - Pose2(0, 0, yaw) @ local).mean(axis=0)
    return Pose2(float(x), float(y), yaw)
