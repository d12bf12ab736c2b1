# SPDX-License-Identifier: Apache-2.0
"""De-skewed beams of one point in time: those of one laser, or of two lasers, the first laser's first.

To collate the lasers into one set of points, and to match that, is Cartographer's (`num_laser_scans`, its
RangeDataCollator). Surfaces are found in each sweep alone, as neighbouring beams belong to one laser.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from services.mapper.back_end.keyframe import Sweep
from services.mapper.front_end.deskew import redeskew, remove_twist
from services.mapper.front_end.surface_normals import (
    MAX_NEIGHBOURS,
    free_standing_beams,
    sweep_normals,
    usable_beams,
)
from shared.geometry import Pose2
from shared.types import Bools, Float64s


@dataclass(frozen=True, slots=True)
class Beams:
    """Beams in `base` at the end of the first laser's sweep.

    origins, ends: (n, 2) m, ends NaN without an echo.
    silent: (n, 2) m, end of the free part of a beam without an echo, NaN elsewhere.
    remaining: (n,) time from each beam to that end, as a share of the first laser's sweep: 1 to 0 for its own beams.
    n_first: number of the first laser's beams.
    """

    origins: Float64s
    ends: Float64s
    silent: Float64s
    remaining: Float64s
    n_first: int

    @property
    def has_second(self) -> bool:
        """Whether beams of a second laser follow those of the first one."""
        return self.n_first < len(self.ends)

    @property
    def first(self) -> "Beams":
        """The beams of the first laser."""
        return self._part(slice(self.n_first), self.n_first)

    @property
    def second(self) -> "Beams":
        """The beams of the second laser."""
        return self._part(slice(self.n_first, None), 0)

    def joined(self, second: "Beams") -> "Beams":
        """These beams, of the first laser, followed by those of the second one."""
        return Beams(
            origins=np.concatenate((self.origins, second.origins)),
            ends=np.concatenate((self.ends, second.ends)),
            silent=np.concatenate((self.silent, second.silent)),
            remaining=np.concatenate((self.remaining, second.remaining)),
            n_first=self.n_first,
        )

    def sweep(self) -> tuple[Sweep, Bools]:
        """The beams for registration, and (n,) bool: which of all beams these are."""
        normals = self._of_each_laser(sweep_normals)
        valid = self._of_each_laser(usable_beams) | normals.any(axis=1)
        if self.has_second:
            valid &= self._of_each_laser(_is_inside)
        return Sweep(self.origins, self.ends, normals, self.remaining).only(valid), valid

    def free_standing(self, crowd: bool) -> Bools:
        """(n,) bool: beams on free-standing objects; see `free_standing_beams`."""
        return np.asarray(self._of_each_laser(free_standing_beams, crowd), bool)

    def without_twist(self, twist: float) -> "Beams":
        """The beams de-skewed for a turn that is greater by `twist` rad in the first laser's sweep."""
        origins, ends = remove_twist(self.remaining, twist, self.origins, self.ends)
        return replace(self, origins=origins, ends=ends)

    def redeskewed(self, assumed: Pose2, actual: Pose2, share: float) -> "Beams":
        """The beams, de-skewed with an assumed motion, as they are with the actual one.

        assumed, actual: motion between the ends of the last two sweeps.  share: part of that time that the sweep took.
        """
        remaining = share * self.remaining
        origins, ends = (redeskew(points, assumed, actual, remaining) for points in (self.origins, self.ends))
        return replace(self, origins=origins, ends=ends)

    def _part(self, which: slice, n_first: int) -> "Beams":
        return Beams(self.origins[which], self.ends[which], self.silent[which], self.remaining[which], n_first)

    def _of_each_laser(self, kernel: Callable[..., Any], *options: bool) -> Any:
        """The results of a kernel for the origins and ends of each laser, one after the other."""
        bounds = (0, self.n_first, len(self.ends))
        parts = [slice(a, b) for a, b in pairwise(bounds) if a < b] or [slice(0)]
        return np.concatenate([kernel(self.origins[part], self.ends[part], *options) for part in parts])


def _is_inside(origins: Float64s, ends: Float64s) -> Bools:
    """(n,) bool: beams of a sweep that are not at its ends.

    There a line has neighbours on one side only: noise turns it where beams are dense, or no line fits. Beside a wall
    such beams hold the robot back along it. Two lasers have enough other beams.
    """
    beams = np.arange(len(ends))
    return np.asarray((beams >= MAX_NEIGHBOURS) & (beams < len(ends) - MAX_NEIGHBOURS))
