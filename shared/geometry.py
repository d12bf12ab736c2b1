# SPDX-License-Identifier: Apache-2.0
"""Planar rigid motion, REP 103: x forward, y left, yaw counter-clockwise, metres and radians."""

from dataclasses import dataclass
from math import atan2, cos, pi, sin, sqrt
from typing import overload

import numpy as np
from numpy.typing import NDArray

Float64s = NDArray[np.float64]
Bools = NDArray[np.bool_]


def wrapped(angle: float) -> float:
    """The same direction in [-pi, pi)."""
    turned = (angle + pi) % (2 * pi) - pi
    return turned if turned < pi else -pi


def wrapped_all(angles: Float64s) -> Float64s:
    """`wrapped`, for an array of any shape."""
    return (angles + pi) % (2 * pi) - pi


@dataclass(frozen=True, slots=True)
class Pose2:
    """A pose, or the motion that leads to it. Name transforms `target_from_source`.

    `a_from_b @ b_from_c` is `a_from_c`; `a_from_b @ points_in_b`, with points (n, 2), gives (n, 2) in a.
    """

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0

    @overload
    def __matmul__(self, other: "Pose2") -> "Pose2": ...
    @overload
    def __matmul__(self, other: Float64s) -> Float64s: ...
    def __matmul__(self, other: "Pose2 | Float64s") -> "Pose2 | Float64s":
        c, s = cos(self.yaw), sin(self.yaw)
        if isinstance(other, Pose2):
            return Pose2(
                self.x + c * other.x - s * other.y, self.y + s * other.x + c * other.y, wrapped(self.yaw + other.yaw)
            )
        x, y = other[:, 0], other[:, 1]
        out = np.empty(other.shape)  # what `column_stack` does, in half the time
        out[:, 0] = self.x + c * x - s * y
        out[:, 1] = self.y + s * x + c * y
        return out

    def inverse(self) -> "Pose2":
        """`b_from_a` of `a_from_b`."""
        c, s = cos(self.yaw), sin(self.yaw)
        return Pose2(-c * self.x - s * self.y, s * self.x - c * self.y, wrapped(-self.yaw))

    def distance(self, other: "Pose2") -> float:
        """Metres between the two positions."""
        return sqrt((other.x - self.x) ** 2 + (other.y - self.y) ** 2)

    def bearing(self, other: "Pose2") -> float:
        """Direction from here to the other position, in the frame that both are given in."""
        return atan2(other.y - self.y, other.x - self.x)


def arc(forward: float, turn: float) -> Pose2:
    """The motion along a circular arc of length `forward` (m) that turns by `turn` (rad); exact for any turn."""
    half = turn / 2
    chord = forward * (sin(half) / half if abs(half) > 1e-9 else 1.0)
    return Pose2(chord * cos(half), chord * sin(half), wrapped(turn))


def interpolated(a: Pose2, b: Pose2, share: float) -> Pose2:
    """The pose at `share` of the constant-velocity motion's chord from a (0) to b (1); beyond 1 it extrapolates."""
    turn = wrapped(b.yaw - a.yaw)
    return Pose2(a.x + share * (b.x - a.x), a.y + share * (b.y - a.y), wrapped(a.yaw + share * turn))


def inside(polygon: Float64s, points: Float64s) -> Bools:
    """Which points (n, 2) lie in the simple polygon (k, 2): (n,) bool, even-odd rule."""
    x, y = points[:, 0][:, None], points[:, 1][:, None]
    x0, y0 = polygon[:, 0], polygon[:, 1]
    x1, y1 = np.roll(x0, -1), np.roll(y0, -1)
    crosses = (y0 > y) != (y1 > y)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # of edges that do not cross
        left_of = x < x0 + (y - y0) * (x1 - x0) / (y1 - y0)
    return np.asarray((crosses & left_of).sum(axis=1) % 2 == 1)


def to_outline(polygon: Float64s, x: float, y: float) -> float:
    """m from a point, inside or outside, to the nearest edge of the polygon (k, 2)."""
    edges, away = np.roll(polygon, -1, axis=0) - polygon, np.array((x, y)) - polygon
    along = np.clip((away * edges).sum(axis=1) / (edges * edges).sum(axis=1), 0.0, 1.0)
    return float(np.hypot(*(away - along[:, None] * edges).T).min())
