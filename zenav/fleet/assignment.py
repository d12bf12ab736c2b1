# SPDX-License-Identifier: Apache-2.0
"""Which robot gets which task: the oldest task first, and of the robots that are free the nearest one."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from math import hypot, inf
from pathlib import Path

import numpy as np

from services.planner.search import GridSearch
from shared import topics
from shared.distance_field import distance_field
from shared.messages import GuardState, Localization
from shared.reasons import reason_text
from shared.robot_view import NO_TASK, RobotView
from zenav.fleet.task_queue import FleetTask
from zenav.maps.map_files import grid_of

RETRY_S = 30.0  # after which a robot that failed a task may try it again
CLEARANCE_M = 0.2  # to walls, on the way whose length is compared
SNAP_M = 1.0  # from a pose to the nearest cell with that clearance
UNIT = 8  # cost of a step to the next cell
Point = tuple[float, float]
WayLength = Callable[[Point, Point], float]


@dataclass(frozen=True, slots=True)
class FreeRobot:
    """A robot that can take a task. former_id: of its last one.  x, y: m, on its map."""

    name: str
    stack: str
    former_id: int
    x: float
    y: float


def refusal(view: RobotView, at: float, min_battery: float) -> str:
    """Why a robot can take no task, in words; empty where it can. at: s, monotonic.  min_battery: V."""
    row, base = view.row(at), view.latest(topics.BASE_STATUS)
    if row.state == "silent":
        return "it is silent"
    if row.state == GuardState.STOPPED:
        return "STOP is pressed"
    if row.state not in NO_TASK:
        return f"it is {row.state}"
    if base is not None and base.fault:
        return reason_text(base.fault)
    if row.x is None or row.pose_state != Localization.GOOD:
        return "its pose is not known"
    if row.battery is not None and row.battery < min_battery:
        return f"its battery has {row.battery:.1f} V"
    return ""


def assignments(
    tasks: Iterable[FleetTask], robots: Iterable[FreeRobot], length: WayLength, now: float
) -> list[tuple[FleetTask, FreeRobot]]:
    """Pairs of a task that waits and its robot: at most one task a robot. now: s, wall clock.

    A robot that failed a task gets it again after RETRY_S, and only if no other one is free.
    """
    free, pairs = list(robots), []
    for task in tasks:
        rested = now - task.changed >= RETRY_S
        able = [
            robot for robot in free if task.only_robot in ("", robot.name) and (rested or robot.name not in task.failed)
        ]
        to_drive = {robot: length((robot.x, robot.y), task.targets[0][:2]) for robot in able}
        able = [robot for robot in able if to_drive[robot] < inf]
        if not able:
            continue
        best = min(able, key=lambda robot: (robot.name in task.failed, to_drive[robot], robot.name))
        free.remove(best)
        pairs.append((task, best))
    return pairs


def straight(a: Point, b: Point) -> float:
    """m, without a map."""
    return hypot(a[0] - b[0], a[1] - b[1])


class MapWays:
    """Lengths of ways on a saved map, m: by A* on the cells that are free, CLEARANCE_M off all others."""

    def __init__(self, path: Path) -> None:
        self._grid = grid_of(path)
        cells, resolution = self._grid.cells, self._grid.resolution
        closed = self._grid.occupied | (cells < 0)
        room = distance_field(closed, 1.0) * resolution >= CLEARANCE_M
        room[[0, -1]] = room[:, [0, -1]] = False
        self._costs = np.ascontiguousarray(np.where(room, UNIT, 0).astype(np.uint16))
        self._rooms = np.column_stack(np.nonzero(room))
        self._search = GridSearch()

    def __call__(self, a: Point, b: Point) -> float:
        """inf where there is no way, or a point is SNAP_M off every free cell."""
        start, goal = self._cell(a), self._cell(b)
        if start is None or goal is None:
            return inf
        cells = self._search.cheapest_path(self._costs, start, goal, UNIT, UNIT)
        if not len(cells):
            return inf
        return float(np.hypot(*np.diff(cells, axis=0).T).sum() * self._grid.resolution)

    def _cell(self, point: Point) -> tuple[int, int] | None:
        """The nearest free cell, row and column."""
        if not len(self._rooms):
            return None
        away = np.hypot(*(self._rooms - np.array(self._grid.cell(*point))).T)
        nearest = int(np.argmin(away))
        if away[nearest] * self._grid.resolution > SNAP_M:
            return None
        return int(self._rooms[nearest, 0]), int(self._rooms[nearest, 1])
