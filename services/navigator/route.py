# SPDX-License-Identifier: Apache-2.0
"""A route: a sequence of poses, for some rounds or endless, with a dwell time at each."""

from dataclasses import dataclass
from itertools import pairwise

from shared.geometry import Pose2


@dataclass(slots=True)
class Route:
    """State of a route. loops: rounds, 0 endless; dwells: s at each pose; tolerance: m, rad."""

    poses: tuple[Pose2, ...]
    dwells: tuple[float, ...]
    loops: int
    any_heading: bool
    tolerance: float
    yaw_tolerance: float
    index: int = 0
    round: int = 0

    @property
    def target(self) -> Pose2:
        return self.poses[self.index]

    @property
    def dwell(self) -> float:
        """s to stay at the present pose."""
        return self.dwells[self.index]

    @property
    def passes(self) -> bool:
        """Whether the robot may pass without a stop: no dwell time, no heading, the next pose not reached here too."""
        last = self.index + 1 == len(self.poses)
        if self.dwell or not self.any_heading or (last and self.loops and self.round + 1 >= self.loops):
            return False
        return self.target.distance(self.poses[0 if last else self.index + 1]) > self.tolerance

    def advance(self) -> bool:
        """Goes on to the next pose. Returns False at the end."""
        if self.index + 1 < len(self.poses):
            self.index += 1
            return True
        if self.loops and self.round + 1 >= self.loops:
            return False
        self.round += 1
        self.index = 0
        return True

    def beyond(self) -> float:
        """m, straight, from the present pose through the rest of this round."""
        rest = self.poses[self.index :]
        return sum(a.distance(b) for a, b in pairwise(rest))

    def stays_beyond(self) -> float:
        """s of dwell time at the poses after the present one, in the rest of this round."""
        return sum(self.dwells[self.index + 1 :])
