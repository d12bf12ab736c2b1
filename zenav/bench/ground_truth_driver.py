# SPDX-License-Identifier: Apache-2.0
"""The driver of the simulated robot in benchmarks of the mapper alone. It knows the true world and the true pose.

The planner plans its paths on the true map. Its speeds are those of local control. The simulator gives wheels,
encoders, odometry and laser. So the mapper's inputs are like those of a drive of the whole stack, at a tenth of the
cost.
"""

from math import atan2, copysign, hypot, sin

import numpy as np

from shared.geometry import Pose2, wrapped
from shared.messages import Truth
from shared.types import Float64s
from zenav.scenario.path_finder import CELL, GOAL_TOLERANCE, PERSON, PathFinder

ARRIVED = 0.15  # m from the end of a way
MAX_GOAL_DISTANCE = GOAL_TOLERANCE + 2 * ARRIVED  # m from the goal that count as reached
LOOK = 0.45  # m: how far down the way it heads for
TURN_FROM, TURN_UNTIL = 0.9, 0.25  # rad off the way at which a robot turns on the spot
TURN_RATE = 1.5  # rad/s at most, on the spot
FULL_SPEED_CLEARANCE_M, MIN_SPEED_SHARE = 0.3, 0.25  # full speed from this clearance; share of it at no clearance
ACROSS, BRAKING = 2.0, 0.5  # m/s^2 at most in a bend: v^2 times the curvature; before the end of a way
CREEP = 0.1  # m/s, from a stand and at the end
AHEAD = 0.9  # m of the way that must be free of people
PATIENCE, ENOUGH = 2.5, 25.0  # s that it stands before people until it drives around them; until it gives up


class GroundTruthDriver:
    """Follows one way after the other: pure pursuit (Coulter 1992) by the true pose; stops for people."""

    def __init__(self, paths: PathFinder) -> None:
        self.paths, self.drive = paths, paths.robot.drive
        self.goal = Pose2()
        self.waited = self.barred = 0.0  # s that it stands before people now; that it stood before, on this way
        self._follow(np.zeros((0, 2)))

    def go(self, goal: Pose2, truth: Truth) -> bool:
        """Drives there from now on; says whether there is a way."""
        self.goal = goal
        self.waited = self.barred = 0.0
        self._follow(self.paths.path(truth.world_from_base, goal))
        return len(self.points) > 0

    def _follow(self, path: Float64s) -> None:
        self.points, self.at = path, 0
        self.turning = False

    def command(self, truth: Truth, seconds: float) -> tuple[float, float] | None:
        """v m/s and w rad/s for the next `seconds`; None where the way has ended, or people bar it for too long."""
        pose = truth.world_from_base
        if self.waited > PATIENCE:
            self.barred, self.waited = self.barred + self.waited, 0.0
            around = self.paths.path(pose, self.goal, np.column_stack((truth.people_x, truth.people_y)))
            if len(around):
                self._follow(around)
        if not len(self.points) or self.barred > ENOUGH:
            return None
        ahead = self.points[self.at : self.at + 60]
        self.at += int(np.argmin(np.hypot(ahead[:, 0] - pose.x, ahead[:, 1] - pose.y)))
        left = hypot(*(self.points[-1] - (pose.x, pose.y)))
        if left < ARRIVED or (self.at >= len(self.points) - 2 and left < 2 * ARRIVED):
            return None
        carrot = self.points[min(self.at + round(LOOK / CELL), len(self.points) - 1)]
        off = wrapped(atan2(carrot[1] - pose.y, carrot[0] - pose.x) - pose.yaw)
        if abs(off) > TURN_FROM or (self.turning and abs(off) > TURN_UNTIL):
            self.turning = True
            return 0.0, copysign(min(TURN_RATE, 0.3 + 2.0 * abs(off)), off)
        self.turning = False
        if self._is_person_ahead(truth):
            self.waited += seconds
            return 0.0, 0.0
        self.waited = 0.0
        curvature = 2 * sin(off) / max(hypot(carrot[0] - pose.x, carrot[1] - pose.y), 0.2)
        room = min(self.paths.clear_at(pose.x, pose.y), self.paths.clear_at(*carrot.tolist()))
        v = self.drive.max_speed * min(max(room / FULL_SPEED_CLEARANCE_M, MIN_SPEED_SHARE), 1.0)
        v = min(v, (ACROSS / max(abs(curvature), 1e-3)) ** 0.5, (CREEP + 2 * BRAKING * left) ** 0.5)
        v = min(v, max(truth.v, CREEP) + self.drive.max_acceleration * seconds * 1.5)  # more, as the motors lag
        return self.drive.clamped(v, curvature * v)

    def _is_person_ahead(self, truth: Truth) -> bool:
        ahead = self.points[self.at : self.at + round(AHEAD / CELL) : 2]
        distances = np.hypot(ahead[:, :1] - truth.people_x, ahead[:, 1:] - truth.people_y)
        return bool((distances < PERSON + self.paths.robot.inscribed_radius + 0.05).any())
