# SPDX-License-Identifier: Apache-2.0
"""A route: a sequence of poses, for some rounds or endless, with a dwell time at each."""

from dataclasses import dataclass
from itertools import pairwise

from services.navigator.config import NavigatorConfig
from shared.geometry import Pose2
from shared.requests import Navigate


@dataclass(slots=True)
class Route:
    """State of a route. loops: rounds, 0 endless; dwells: s at each pose; tolerance: m, rad.

    pass_through: no pose but the last is stopped at, and the headings of the others do not count.
    """

    poses: tuple[Pose2, ...]
    dwells: tuple[float, ...]
    loops: int
    any_heading: bool
    tolerance: float
    yaw_tolerance: float
    pass_through: bool = False
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
    def ends_here(self) -> bool:
        """Whether the present pose is the last of the last round."""
        return self.index + 1 == len(self.poses) and 0 < self.loops <= self.round + 1

    @property
    def heading_free(self) -> bool:
        """Whether the present pose is reached at any heading."""
        return self.any_heading or (self.pass_through and not self.ends_here)

    @property
    def passes(self) -> bool:
        """Whether the robot may pass without a stop: no dwell time, no heading, the next pose not reached here too."""
        if self.dwell or not self.heading_free or self.ends_here:
            return False
        return self.target.distance(self.poses[(self.index + 1) % len(self.poses)]) > self.tolerance

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


def route_of(request: Navigate, config: NavigatorConfig) -> Route:
    """The route of a request, with the configured tolerances where it has none."""
    return Route(
        poses=request.poses,
        dwells=request.stays,
        loops=request.loops,
        any_heading=request.any_heading,
        tolerance=request.tolerance or config.tolerance,
        yaw_tolerance=request.yaw_tolerance or config.yaw_tolerance,
        pass_through=request.pass_through,
    )
