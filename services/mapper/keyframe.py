# SPDX-License-Identifier: Apache-2.0
"""What is kept of a scan that joined the map."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from services.mapper.deskew import turned_back
from services.mapper.occupancy import Occupancy
from shared.geometry import Bools, Float64s, Pose2, wrapped_all

Float32s = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class Sweep:
    """The beams of a sweep that measured something: origins, points and normals (n, 2) in `base`.

    back: (n,), share of the sweep from each to its end.
    """

    origins: Float64s
    points: Float64s
    normals: Float64s
    back: Float64s

    def only(self, which: Bools) -> "Sweep":
        """Those beams (n,)."""
        return Sweep(self.origins[which], self.points[which], self.normals[which], self.back[which])

    def turned_back(self, twist: float) -> "Sweep":
        """As it is when the robot turned by `twist` rad more during it."""
        origins, points, normals = (
            turned_back(array, self.back, twist) for array in (self.origins, self.points, self.normals)
        )
        return Sweep(origins, points, normals, self.back)


SETTLED = np.zeros((3, 3), np.float32)
"""Doubt of what the graph was optimised with."""


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A sweep and where it was taken. Arrays are float32: thousands are kept.

    stamp: ns, end of the sweep.  local_from_base: in the front end's frame, which no closure moves.  origins, ends:
    (n, 2) m in `base`, ends NaN without an echo.  points, normals: (k, 2) m in `base`, what is matched.
    silent: (n, 2) m in `base`, up to where a beam without an echo is free, NaN elsewhere; or (0, 2): they say nothing.
    doubt: (3, 3), how unsure a map is that was drawn from it, until the graph is optimised; see `Belief`.
    off: what matches and odometry differ by, from the keyframe before to this one, in this one's axes.
    """

    stamp: int
    local_from_base: Pose2
    origins: Float32s
    ends: Float32s
    points: Float32s
    normals: Float32s
    silent: Float32s
    doubt: Float32s = field(default_factory=lambda: SETTLED, kw_only=True)
    off: Pose2 = field(default_factory=Pose2, kw_only=True)

    @classmethod
    def of(
        cls, stamp: int, local_from_base: Pose2, origins: Float64s, ends: Float64s, silent: Float64s, sweep: Sweep,
        doubt: Float64s, off: Pose2,
    ) -> "Keyframe":  # fmt: skip
        told = silent if not np.isnan(silent).all() else silent[:0]
        seen = (array.astype(np.float32) for array in (origins, ends, sweep.points, sweep.normals, told))
        return cls(stamp, local_from_base, *seen, doubt=doubt.astype(np.float32), off=off)

    @property
    def origin(self) -> Float64s:
        """(2,) m in `base`, where its beams begin in the mean."""
        return np.asarray(np.nanmean(self.origins, axis=0, dtype=np.float64))

    def draw(self, grid: Occupancy, pose: Pose2) -> None:
        """Draws all its beams into a grid, with `base` at a pose in that one's frame."""
        origins, ends = self.origins.astype(np.float64), self.ends.astype(np.float64)
        silent = pose @ self.silent.astype(np.float64) if len(self.silent) else np.full_like(ends, np.nan)
        grid.integrate(pose @ origins, pose @ ends, silent)

    def surface(self) -> tuple[Float64s, Float64s]:
        """Points and normals (k, 2), as the kernels take them."""
        return self.points.astype(np.float64), self.normals.astype(np.float64)


def frame_of(keyframes: Sequence[Keyframe], poses: Float64s) -> Pose2:
    """Where `local` lies in `map` by keyframes together, the last of them first to tell. poses: (n, 3) in `map`."""
    local = np.array([(k.local_from_base.x, k.local_from_base.y) for k in keyframes])
    turns = wrapped_all(poses[:, 2] - np.array([k.local_from_base.yaw for k in keyframes]))
    yaw = float(turns[-1] + wrapped_all(turns - turns[-1]).mean())
    x, y = (poses[:, :2] - Pose2(0, 0, yaw) @ local).mean(axis=0)
    return Pose2(float(x), float(y), yaw)
