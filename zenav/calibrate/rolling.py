# SPDX-License-Identifier: Apache-2.0
"""Where would the wheels have carried the robot, had they these radii and this distance? For any radii, at any time.

Poses are (n, 3) rows x, y, yaw; yaw is not wrapped.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from shared.config import Drive
from shared.messages import WheelState
from shared.types import Float64s, Int64s

MAX_GAP_NS = 0.25  # s between two wheel states beyond which the motion between them is unknown


class WheelGeometry(NamedTuple):
    """What calibration finds of the drive: m, m, m."""

    left_radius: float
    right_radius: float
    distance: float

    @classmethod
    def of(cls, drive: Drive) -> "WheelGeometry":
        """As configured."""
        return cls(drive.left_radius, drive.right_radius, drive.wheel_distance)

    @property
    def radius(self) -> float:
        """m, mean"""
        return (self.left_radius + self.right_radius) / 2

    @property
    def ratio(self) -> float:
        """right over left"""
        return self.right_radius / self.left_radius


class WheelTravel(NamedTuple):
    """Angles of both wheels (n,) rad, continuous, at stamps (n,) ns, strictly rising.

    broken: (n,) bool, whether the motion that led to a sample is unknown: a restarted driver, missing messages.
    """

    stamps: Int64s
    left: Float64s
    right: Float64s
    broken: NDArray[np.bool_]

    @classmethod
    def of(cls, states: Sequence[WheelState]) -> "WheelTravel":
        """From wheel states in order of their stamps; a new epoch goes on where the last one ended."""
        stamps = np.array([s.stamp for s in states], np.int64)
        epochs = np.array([s.epoch for s in states], np.int64)
        new = np.concatenate(([False], np.diff(epochs) != 0))
        left, right = (
            np.cumsum(np.where(new, 0.0, np.diff(angles, prepend=angles[:1])))
            for angles in (np.array([s.left for s in states]), np.array([s.right for s in states]))
        )
        late = np.concatenate(([False], np.diff(stamps) > MAX_GAP_NS * 1e9))
        return cls(stamps, left, right, new | late)

    def at(self, stamps: Int64s) -> tuple[Float64s, Float64s]:
        """Both wheels' angles (n,) rad at times (ns), interpolated; held before the first and after the last sample."""
        seconds, own = (stamps - self.stamps[0]) * 1e-9, (self.stamps - self.stamps[0]) * 1e-9
        return np.interp(seconds, own, self.left), np.interp(seconds, own, self.right)

    def is_known(self, begin: Int64s, end: Int64s) -> NDArray[np.bool_]:
        """(n,) bool: whether the motion from each begin to its end (ns) is known throughout."""
        n_broken = np.concatenate(([0], np.cumsum(self.broken)))
        first = np.searchsorted(self.stamps, begin, "right")
        last = np.minimum(np.searchsorted(self.stamps, end, "left"), len(self.stamps) - 1)
        inside = (begin >= self.stamps[0]) & (end <= self.stamps[-1])
        return np.asarray(inside & (n_broken[last + 1] - n_broken[np.minimum(first, last + 1)] == 0))

    def with_samples(self, stamps: Int64s) -> "WheelTravel":
        """The same motion, sampled at these times (ns) too."""
        added = np.setdiff1d(stamps, self.stamps)
        left, right = self.at(added)
        order = np.argsort(np.concatenate((self.stamps, added)), kind="stable")
        # what is interpolated in a gap is as unknown as the gap's end
        follows = np.minimum(np.searchsorted(self.stamps, added, "left"), len(self.stamps) - 1)
        return WheelTravel(
            np.concatenate((self.stamps, added))[order],
            np.concatenate((self.left, left))[order],
            np.concatenate((self.right, right))[order],
            np.concatenate((self.broken, self.broken[follows]))[order],
        )

    def poses(self, wheels: WheelGeometry) -> Float64s:
        """(n, 3) poses at the samples from the first one's, along the circular arcs that the wheels rolled."""
        left, right = np.diff(self.left) * wheels.left_radius, np.diff(self.right) * wheels.right_radius
        turn, forward = (right - left) / wheels.distance, (left + right) / 2
        yaw = np.concatenate(([0.0], np.cumsum(turn)))
        chord = forward * np.sinc(turn / (2 * np.pi))
        middle = yaw[:-1] + turn / 2
        x = np.concatenate(([0.0], np.cumsum(chord * np.cos(middle))))
        y = np.concatenate(([0.0], np.cumsum(chord * np.sin(middle))))
        return np.column_stack((x, y, yaw))


def relative_poses(a: Float64s, b: Float64s) -> Float64s:
    """(n, 3) motions a_from_b of poses a and b (n, 3); yaw is not wrapped."""
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    dx, dy = b[:, 0] - a[:, 0], b[:, 1] - a[:, 1]
    return np.column_stack((c * dx + s * dy, c * dy - s * dx, b[:, 2] - a[:, 2]))


def composed_poses(a: Float64s, b: Float64s) -> Float64s:
    """(n, 3) a @ b of poses (n, 3) or (3,); yaw is not wrapped."""
    a, b = np.atleast_2d(a), np.atleast_2d(b)
    c, s = np.cos(a[:, 2]), np.sin(a[:, 2])
    x, y = a[:, 0] + c * b[:, 0] - s * b[:, 1], a[:, 1] + s * b[:, 0] + c * b[:, 1]
    return np.column_stack((x, y, a[:, 2] + b[:, 2]))
