# SPDX-License-Identifier: Apache-2.0
"""The other robots in the planner: those that stand are obstacles, and a robot that makes way plans to its refuge.

The rules are our own.
"""

from dataclasses import replace
from math import pi

import numpy as np

from shared.geometry import Pose2
from shared.messages import Goal, RightOfWay
from shared.types import Float64s

CORNERS = 12  # of the polygon about a robot
ANY_HEADING_RAD = 10.0
REFUGE_TOLERANCE_M = 0.1
SAME_PLACE_M = 0.1  # by which a robot that stands must have moved to count as elsewhere


class PlannerTraffic:
    """The newest right of way."""

    def __init__(self) -> None:
        self.refuge: Pose2 | None = None
        self._discs: Float64s = np.zeros((0, 3))  # x, y, radius m in `map`

    def update(self, told: RightOfWay) -> bool:
        """Takes a message. Returns whether the plan must be made again."""
        refuge = told.refuge if told.active and told.gives_way else None
        discs = np.column_stack((told.closed_xs, told.closed_ys, told.closed_radii)).astype(float)
        moved = discs.shape != self._discs.shape or bool((np.abs(discs - self._discs) > SAME_PLACE_M).any())
        if refuge == self.refuge and not moved:
            return False
        self.refuge, self._discs = refuge, discs if moved else self._discs
        return True

    @property
    def polygons(self) -> tuple[Float64s, ...]:
        """(CORNERS, 2) m in `map`, about each robot that stands."""
        angles = 2.0 * pi / CORNERS * np.arange(CORNERS)
        outline = np.column_stack((np.cos(angles), np.sin(angles)))
        return tuple(disc[:2] + disc[2] * outline for disc in self._discs)

    def goal(self, goal: Goal) -> Goal:
        """The goal to plan to: the refuge of a robot that makes way, with any heading."""
        if self.refuge is None:
            return goal
        return replace(goal, map_from_goal=self.refuge, tolerance=REFUGE_TOLERANCE_M, yaw_tolerance=ANY_HEADING_RAD)
