# SPDX-License-Identifier: Apache-2.0
"""Robots that wait for each other in a circle: which one makes way, and where to.

The reservation of whole pieces makes no circle by itself. A new goal does: its path leads through a robot that already
waits. Then the last robot of the circle in the order makes way, unless it has no place to go. Its way to the refuge
comes before all others, so robots behind it make way in turn (priority inheritance as in Okumura, Machida, Defago,
Tamura 2022).
"""

from collections import deque
from collections.abc import Mapping, Sequence

import numpy as np

from services.traffic.conflicts import Clearances, TrafficRobot, reach_of
from shared.distance_field import distance_field
from shared.geometry import Pose2
from shared.grid import FREE_UP_TO, OccupancyGrid
from shared.types import NS_PER_S, Bools, Float64s

WINDOW_M = 12.0  # to each side of the robot in which a refuge is looked for
CELL_M = 0.2  # about: a whole number of the map's cells
ROOM_M = 0.05  # between the robot's outline and walls on the way to a refuge
CIRCLE_NS = 3 * NS_PER_S // 2
"""ns that a circle must last: messages are on their way."""
STUCK_NS = 5 * NS_PER_S
"""ns after which a robot that found no refuge looks again."""
SLACK_M = 0.2  # m farther from the others' paths than needed: the goal's tolerance, and what paths and poses change
ARRIVED_M = 0.35
MAX_YIELD_NS = 45 * NS_PER_S
MIN_REST_NS = 2 * NS_PER_S
NEIGHBOURS = ((0, 1), (1, 0), (0, -1), (-1, 0), (1, 1), (1, -1), (-1, 1), (-1, -1))


def circle(name: str, waits_for: Mapping[str, Sequence[str]]) -> frozenset[str]:
    """The robots that wait for each other with this one; empty where there is no circle."""

    def reached(begin: str) -> set[str]:
        found: set[str] = set()
        open_ = list(waits_for.get(begin, ()))
        while open_:
            robot = open_.pop()
            if robot not in found:
                found.add(robot)
                open_ += waits_for.get(robot, ())
        return found

    members = reached(name)
    return frozenset(other for other in members if name in reached(other)) if name in members else frozenset()


def yielder(robots: Sequence[TrafficRobot], members: frozenset[str]) -> str:
    """The member that makes way: the last one in the order that can. Empty where none can."""
    able = [robot for robot in robots if robot.name in members and not robot.stuck]
    return max(able, key=lambda robot: robot.order).name if able else ""


def refuge(
    grid: OccupancyGrid, me: TrafficRobot, others: Sequence[TrafficRobot], clearances: Clearances
) -> Pose2 | None:
    """The nearest place on the map at which this robot is in no robot's way, by a way on which none stands; or None.

    Breadth-first search on cells of CELL_M.
    """
    free, x0, y0, cell_size = _free_cells(grid, me)
    if not free.size:
        return None
    rows, columns = np.indices(free.shape)
    xs = np.asarray(x0 + columns * cell_size)
    ys = np.asarray(y0 + rows * cell_size)
    passable, hidden = free, np.ones(free.shape, bool)
    for other in others:
        reach = reach_of(me, other, clearances)
        passable = passable & ~_within(xs, ys, np.concatenate((other.place, other.path[: other.held])), reach, me)
        hidden &= ~_within(xs, ys, np.concatenate((other.place, other.path)), reach + SLACK_M, None)
    start = round((me.y - y0) / cell_size), round((me.x - x0) / cell_size)
    passable[start] = True
    queue, seen = deque([start]), {start}
    while queue:
        row, column = queue.popleft()
        if hidden[row, column] and free[row, column]:
            return Pose2(float(xs[row, column]), float(ys[row, column]), 0.0)
        for up, right in NEIGHBOURS:
            cell = row + up, column + right
            if cell not in seen and 0 <= cell[0] < free.shape[0] and 0 <= cell[1] < free.shape[1] and passable[cell]:
                seen.add(cell)
                queue.append(cell)
    return None


def _free_cells(grid: OccupancyGrid, me: TrafficRobot) -> tuple[Bools, float, float, float]:
    """(h, w) bool: where the robot has room; x, y m of the centre of cell (0, 0); m a cell. It stands on a centre."""
    row, column = grid.cell(me.x, me.y)
    if not grid.holds(row, column):
        return np.zeros((0, 0), bool), 0.0, 0.0, CELL_M
    reach = round(WINDOW_M / grid.resolution)
    low_row, low_column = max(0, row - reach), max(0, column - reach)
    cells = grid.cells[low_row : row + reach, low_column : column + reach]
    room = distance_field(np.ascontiguousarray((cells < 0) | (cells > FREE_UP_TO)), grid.resolution)
    stride = max(1, round(CELL_M / grid.resolution))
    first_row, first_column = (row - low_row) % stride, (column - low_column) % stride
    free = room[first_row::stride, first_column::stride] > me.radius + ROOM_M
    x0 = grid.x0 + (low_column + first_column + 0.5) * grid.resolution
    y0 = grid.y0 + (low_row + first_row + 0.5) * grid.resolution
    return np.asarray(free), x0, y0, stride * grid.resolution


def _within(xs: Float64s, ys: Float64s, points: Float64s, reach: float, me: TrafficRobot | None) -> Bools:
    """(h, w) bool: cells nearer than `reach` m to a point (n, 2), and with `me` nearer than this robot is now."""
    found = np.zeros(xs.shape, bool)
    low, high = (xs.min() - reach, ys.min() - reach), (xs.max() + reach, ys.max() + reach)
    for x, y in points[((points >= low) & (points <= high)).all(axis=1)].tolist():
        limit = reach if me is None else min(reach, float(np.hypot(me.x - x, me.y - y)) - CELL_M)
        found |= np.hypot(xs - x, ys - y) < limit
    return found


class GivingWay:
    """Whether this robot makes way, and where it stands meanwhile."""

    def __init__(self) -> None:
        self.refuge: Pose2 | None = None
        self.stuck = False
        self.for_robots: frozenset[str] = frozenset()
        self._circle_since: int | None = None
        self._since = self._rests_since = self._stuck_at = 0  # ns
        self._left: TrafficRobot | None = None  # this robot where it was in the way

    def end(self) -> None:
        """Goes on with the goal."""
        self.refuge, self._circle_since, self.for_robots = None, None, frozenset()

    def update(
        self,
        me: TrafficRobot,
        others: Sequence[TrafficRobot],
        grid: OccupancyGrid,
        clearances: Clearances,
        now: int,
    ) -> None:
        """Begins to make way, or ends it. me: with its present path.  now: ns."""
        self.stuck = self.stuck and now - self._stuck_at < STUCK_NS
        if self.refuge is not None:
            if self._is_over(me, others, clearances, now):
                self.end()
            elif self._rests(now) and any(_covers(other, me, clearances) for other in self._served(others)):
                self._move_on(refuge(grid, me, others, clearances), me, others, now)
            return
        members = circle(me.name, {robot.name: robot.waits_for for robot in (me, *others)})
        if not members:
            self._circle_since = None
            return
        self._circle_since = now if self._circle_since is None else self._circle_since
        if now - self._circle_since < CIRCLE_NS or self.stuck or yielder((me, *others), members) != me.name:
            return
        self.refuge = refuge(grid, me, others, clearances)
        if self.refuge is None:
            self.stuck, self._stuck_at = True, now
        else:
            self.for_robots = members - {me.name}
            self._left, self._since, self._rests_since = me, now, 0

    def _is_over(self, me: TrafficRobot, others: Sequence[TrafficRobot], clearances: Clearances, now: int) -> bool:
        """Whether those it made way for have passed the place where it was, or it took too long."""
        assert self.refuge is not None
        assert self._left is not None
        if now - self._since > MAX_YIELD_NS:
            return True
        if not self._rests_since and np.hypot(me.x - self.refuge.x, me.y - self.refuge.y) < ARRIVED_M:
            self._rests_since = now
        return self._rests(now) and not any(_covers(other, self._left, clearances) for other in self._served(others))

    def _rests(self, now: int) -> bool:
        """Whether it has stood at its refuge for a while. now: ns."""
        return bool(self._rests_since) and now - self._rests_since >= MIN_REST_NS

    def _served(self, others: Sequence[TrafficRobot]) -> list[TrafficRobot]:
        """The robots that it makes way for."""
        return [other for other in others if other.name in self.for_robots]

    def _move_on(self, found: Pose2 | None, me: TrafficRobot, others: Sequence[TrafficRobot], now: int) -> None:
        """Takes another refuge: a new path of a robot that it makes way for leads to this one.

        Where there is none, and that robot waits, it makes way no more. Then another one of the circle has its turn.
        """
        if found is not None:
            self.refuge, self._rests_since = found, 0
        elif any(me.name in other.waits_for for other in self._served(others)):
            self.end()
            self.stuck, self._stuck_at = True, now


def _covers(other: TrafficRobot, me: TrafficRobot, clearances: Clearances) -> bool:
    """Whether another robot is, or comes on its path, where this robot was."""
    points = np.concatenate((other.place, other.path))
    return bool((np.hypot(points[:, 0] - me.x, points[:, 1] - me.y) < reach_of(me, other, clearances)).any())
