# SPDX-License-Identifier: Apache-2.0
"""The result of a drive through a BARN world, and its score by the rule of the challenge."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from shared.config import Robot
from shared.geometry import Pose2

Float64s = NDArray[np.float64]

REFERENCE_SPEED = 2.0  # m/s: the optimal time is the reference path's length over this
MIN_TIME_RATIO, MAX_TIME_RATIO = 2.0, 8.0  # of the optimal time: the rule clips the time to this range
N_DECIMALS_M = 4  # decimals of metres in a report


@dataclass(frozen=True, slots=True, eq=False)
class BarnCourse:
    """The world of a run, with the figures of its rule.

    cylinders: (n, 3) x, y, radius, m.  start: pose.  goal: m.
    place, file: the simulator's `world` and `barn_file`.  walkers: radius of the moving cylinders, m.
    """

    world: str
    place: str
    file: str
    cylinders: Float64s
    start: Pose2
    goal: tuple[float, float]
    goal_radius: float
    time_limit: float
    optimal_length: float
    walkers: float = 0.0


@dataclass(slots=True)
class BarnResult:
    """The result of a run.

    rows: (n, 6) s since the goal was sent; x, y m and heading rad in the world; v m/s; w rad/s.
    """

    course: BarnCourse
    robot: Robot
    status: str  # success, collision or timeout
    time: float  # s on the challenge's clock
    clearance: float  # m, the smallest
    rows: Float64s
    plan: Float64s = field(default_factory=lambda: np.empty((0, 2)))  # (k, 2) m in the world, the last one
    n_recoveries: int = 0
    why: str = ""  # what the stack said at the end
    stood: bool = False  # when it was touched
    walkers: Float64s = field(default_factory=lambda: np.empty((0, 2)))  # (p, 2) m, where they were at the end

    @property
    def length(self) -> float:
        """m driven."""
        return round(float(np.hypot(*np.diff(self.rows[:, 1:3], axis=0).T).sum()), N_DECIMALS_M)

    @property
    def score(self) -> float:
        """The challenge's."""
        return barn_score(self.status, self.time, self.course.optimal_length)


def barn_score(status: str, time: float, optimal_length: float) -> float:
    """The challenge's: success * OT / clip(AT, 2 OT, 8 OT), at most 0.5."""
    optimal = optimal_length / REFERENCE_SPEED
    return optimal / min(max(time, MIN_TIME_RATIO * optimal), MAX_TIME_RATIO * optimal) if status == "success" else 0.0
