# SPDX-License-Identifier: Apache-2.0
"""Robots with the true map and their poses on it drive to random goals, one after the other: in lockstep or live."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

import numpy as np

from services.mapper.maps.map_file import pack_map
from shared import requests
from shared.config import UserError
from shared.geometry import Pose2
from shared.messages import Localization, MapMode, NavState, NavStatus, PoseEstimate, Truth
from shared.requests import Navigate
from shared.ros_map import write_ros_map
from shared.task_state import FINAL_STATES
from zenav.client.map_transfer import give_map, start_mode
from zenav.maps.foreign_map import read_map
from zenav.scenario.path_finder import PathFinder

LOOK_S = 0.2  # s between two looks at the robots
HEARD_S = 2.5  # s until a mapper has its map, and the robots hear each other on it
MAX_WAITS = 4  # of HEARD_S
MIN_WAY_M = 3.0  # m to a new goal
MAX_DRAWS = 1000  # poses that are drawn for one goal; of a world that is too small the farthest one is taken
MOVES_MPS, MOVES_RPS = 0.02, 0.05


@dataclass(slots=True)
class RobotRecord:
    """What one robot did. longest_standstill: s without motion on the way."""

    name: str
    n_reached: int = 0
    n_failed: int = 0
    n_contacts: int = 0
    distance: float = 0.0
    longest_standstill: float = 0.0
    killed_at: float | None = None  # s
    reasons: dict[str, int] = field(default_factory=dict)


class DrivenRobot(Protocol):
    """A robot in a simulated world, in lockstep or live: what it says, and how it is asked."""

    name: str
    world_name: str
    start: Pose2

    @property
    def nav(self) -> NavStatus | None: ...

    @property
    def truth(self) -> Truth | None: ...

    @property
    def pose(self) -> PoseEstimate | None: ...

    def now(self) -> int: ...

    def ask(self, request: requests.Request[Any, Any], message: Any) -> Any: ...


class RandomGoals:
    """Gives one robot one random goal after the other."""

    def __init__(self, robot: DrivenRobot, paths: PathFinder, rng: np.random.Generator) -> None:
        self.robot, self._paths, self._rng = robot, paths, rng
        self.record = RobotRecord(robot.name)
        self._task_id = -1
        self._standstill = 0.0

    @property
    def is_lost(self) -> bool:
        """Whether the mapper does not know the pose."""
        return self.robot.pose is None or self.robot.pose.state is Localization.LOST

    def step(self) -> None:
        """Looks at the robot after LOOK_S."""
        nav, truth, record = self.robot.nav, self.robot.truth, self.record
        if nav is None or truth is None:
            return
        record.n_contacts, record.distance = truth.n_contacts, truth.distance
        if record.killed_at is not None:
            return
        if nav.task_id == self._task_id and nav.state not in FINAL_STATES:
            moves = abs(truth.v) > MOVES_MPS or abs(truth.w) > MOVES_RPS
            self._standstill = 0.0 if moves else self._standstill + LOOK_S
            record.longest_standstill = round(max(record.longest_standstill, self._standstill), 1)
            return
        if nav.task_id == self._task_id:
            record.n_reached += nav.state is NavState.REACHED
            if nav.state is NavState.FAILED:
                record.n_failed += 1
                record.reasons[nav.reason] = record.reasons.get(nav.reason, 0) + 1
        self._task_id = -1
        self._send(truth.world_from_base)

    def _send(self, here: Pose2) -> None:
        goal = here
        for _ in range(MAX_DRAWS):
            goal = max(goal, self._paths.random_pose(self._rng), key=here.distance)
            if here.distance(goal) >= MIN_WAY_M:
                break
        reply = self.robot.ask(requests.NAVIGATE, Navigate(self.robot.now(), (goal,), 0.0, 1, True))
        if reply.accepted:
            self._task_id, self._standstill = reply.task_id, 0.0


def place(drivers: Sequence[RandomGoals], paths: PathFinder, wait: Callable[[float], None]) -> None:
    """Lets each mapper track its robot on the true map from its true pose.

    Robots side by side hide the walls from each other. Their mappers search again once they hear the others. Raises
    UserError where that does not help.
    """
    content = packed_map(paths)
    for driver in drivers:
        robot = driver.robot
        start_mode(robot, wait, MapMode.LOCALISE, give_map(robot, wait, content), robot.start, robot.world_name)
    for _ in range(MAX_WAITS):
        wait(HEARD_S)
        lost = [driver.robot.name for driver in drivers if driver.is_lost]
        if not lost:
            return
    raise UserError(f"{', '.join(lost)} cannot be found on the map", "name fewer robots")


def packed_map(paths: PathFinder) -> bytes:
    """The true map for a mapper, as a map of another program."""
    grid = paths.grid
    with TemporaryDirectory() as folder:
        write_ros_map(Path(folder), grid.cells, grid.resolution, grid.x0, grid.y0)
        return pack_map(read_map(Path(folder), grid.resolution))
