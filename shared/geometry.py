# SPDX-License-Identifier: Apache-2.0
"""Planar rigid motion, REP 103: x forward, y left, yaw counter-clockwise, metres and radians."""

from dataclasses import dataclass
from math import atan2, cos, pi, sin, sqrt
from typing import overload

import numpy as np

from shared.types import Float64s


def wrapped(angle: float) -> float:
    """The angle (rad) in [-pi, pi)."""
    turned = (angle + pi) % (2 * pi) - pi
    return turned if turned < pi else -pi


def wrapped_all(angles: Float64s) -> Float64s:
    """The angles (rad) in [-pi, pi), for an array of any shape."""
    return (angles + pi) % (2 * pi) - pi


@dataclass(frozen=True, slots=True)
class Pose2:
    """A pose, or the motion that leads to it: x, y in m, yaw in rad. Name transforms `target_from_source`.

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
        """Direction (rad) from this position to the other, in the frame of both."""
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
