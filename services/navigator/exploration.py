# SPDX-License-Identifier: Apache-2.0
"""Choice of the next frontier: the first of the shortest tour, with hysteresis and a bound of visits."""

from dataclasses import dataclass
from math import hypot

import numpy as np
from pydantic import Field

from services.navigator.frontiers import Frontier, FrontierConfig, Frontiers, Snapshot, find_frontiers
from services.navigator.shared_exploration import SharedExploration, SharingConfig
from services.navigator.tour import tours
from shared import reasons
from shared.config import Section
from shared.geometry import Pose2, wrapped
from shared.grid import OccupancyGrid
from shared.joint_map import joined
from shared.messages import TILE_CELLS
from shared.reasons import Reason
from shared.types import Float64s, Int8s, Int64s

Cell = tuple[int, int]

_SAME_TARGET_M = 0.5  # between a frontier and the target that are the same
_GIVE_UP_RADIUS_M = 1.0  # around a target that is given up with it
_BEYOND_TOUR_COST_M = 1e6  # extra cost of frontiers that are too far for the tour
_CLOSED_AROUND_M = 0.3  # around the places of a border at which another robot saw no more
_SEEN_FROM_M = 3.0  # from a frontier that vanishes, within which it was seen
_SMALL_SIZES = 2.0  # in min_size: a frontier up to here that was seen before is no frontier again
_VISIT_CELL_M = 0.5  # side of the squares by which visits are counted


class ExplorationConfig(Section):
    """How frontiers are chosen and given up."""

    frontier: FrontierConfig = FrontierConfig()
    size_weight: float = Field(0.3, ge=0, le=20, description="m of driving that a metre of frontier is worth")
    turn_weight: float = Field(0.5, ge=0, le=20, description="m of driving that a radian of turning costs")
    switch_gain: float = Field(2.0, ge=0, le=50, description="m (weighted) by which another frontier must be better")
    switch_after: int = Field(3, ge=1, le=20, description="successive searches that must find it so")
    look_time: float = Field(0.8, ge=0.2, le=30, description="s at a frontier that stays, until it is given up")
    max_visits: int = Field(4, ge=1, le=100, description="maximum times that one place is chosen")
    patience: float = Field(
        0.5,
        ge=0.05,
        le=1,
        description="share of the blocked, unreachable and progress times of a goal that a frontier gets",
    )
    max_recoveries: int = Field(2, ge=0, le=10, description="recoveries for one frontier, until another is chosen")
    settle_time: float = Field(3.0, ge=0, le=60, description="s without a frontier until exploring ends")
    blocked_time: float = Field(
        10.0, ge=0, le=300, description="the same, s, where dynamic obstacles may block the path to some"
    )
    tolerance: float = Field(0.3, ge=0.05, le=2, description="m to the pose from which a frontier is seen")
    sharing: SharingConfig = SharingConfig()


@dataclass(frozen=True, slots=True, eq=False)
class FrontierTarget:
    """The frontier that is driven to, and the place (m) of its border."""

    frontier: Frontier
    x: float
    y: float


class Exploration:
    """State of one exploration task.  sharing: with other robots, or None."""

    def __init__(self, config: ExplorationConfig, sharing: SharedExploration | None = None) -> None:
        self.config, self.sharing = config, sharing
        self.target: FrontierTarget | None = None
        self.looking: float | None = None  # s at the target; None on the way
        self._near = 0.0  # s close to the target
        self._n_better = 0  # successive searches with a better frontier than the target
        self.without = 0.0  # s without a frontier
        self.moved = 0.0  # maximum m from the start
        self._start: Pose2 | None = None
        self._given_up: set[Cell] = set()
        self._failed: set[Cell] = set()
        self._visits: dict[Cell, int] = {}
        self._seen_by_others: list[tuple[float, float]] = []
        self._seen = sharing.seen if sharing is not None else []  # targets that vanished when the robot was near
        self._last_try = False
        self._n_missed = 0  # frontiers that failed in the last try, too
        self._last_cause: Reason = reasons.NO_PROGRESS  # why the last one failed

    @property
    def missed_text(self) -> str:
        """How many frontiers could not be reached, and why the last one; empty where all could."""
        if not self._n_missed:
            return ""
        frontiers = "1 frontier" if self._n_missed == 1 else f"{self._n_missed} frontiers"
        return f"{frontiers} could not be reached; the last cause: {self._last_cause.text}"

    @property
    def dropped(self) -> Int64s:
        """(n, 2) int64 rows and columns of `map` that are no frontier any more."""
        return np.array(sorted(self._given_up | self._failed), np.int64).reshape(-1, 2)

    def snapshot(self, grid: OccupancyGrid, cells: Int8s, pose: Pose2, robot_radius: float, now: int) -> Snapshot:
        """Input of a search on the cells (h, w) of a grid.  robot_radius: m, inscribed."""
        dropped = self.dropped
        if self.sharing is not None:
            looked_at = _cells_around(self.sharing.begin_search(now), grid.resolution)
            dropped = np.concatenate((dropped, looked_at))
        return Snapshot(
            cells=cells,
            first_row=grid.first_row * TILE_CELLS,
            first_column=grid.first_column * TILE_CELLS,
            resolution=grid.resolution,
            x=pose.x,
            y=pose.y,
            robot_radius=robot_radius,
            dropped=dropped,
        )

    def known_map(self, grid: OccupancyGrid) -> OccupancyGrid:
        """The own map, with that of the robots that it explores with where the own one is not sure."""
        return grid if self.sharing is None else joined(grid, self.sharing.map.grid)

    def own_part(self, found: Frontiers, now: int) -> Frontiers:
        """The frontiers that are left to this robot; all, where it explores alone."""
        if self.sharing is None:
            return found
        self._seen_by_others = self.sharing.seen_by_others(now)
        target = (self.target.frontier.x, self.target.frontier.y) if self.target is not None else None
        return self.sharing.own_frontiers(found, target, now)

    def choose_target(self, result: Frontiers, pose: Pose2, resolution: float) -> FrontierTarget | None:
        """The target among the found frontiers: the same object, or another where it vanished or is worse."""
        costs = self._costs(result, pose)
        ranked = sorted(result.frontiers, key=lambda f: costs[id(f)])
        if self.target is not None:
            same = _same_frontier(result, self.target, resolution)
            if same is None:
                if self.looking is None and _is_unreachable(result, self.target, resolution):
                    return self.target  # planner and local control decide whether it can be reached
                if self._has_seen(self.target, result, pose, resolution):
                    self._seen.append((self.target.x, self.target.y))
            elif self.looking is None:
                gain = costs[id(same)] - costs[id(ranked[0])]
                self._n_better = self._n_better + 1 if gain > self.config.switch_gain else 0
                if self._n_better < self.config.switch_after:
                    return self.target
            elif self.looking < self.config.look_time:
                return self.target
            else:
                self._close(same, self.target, resolution)
                ranked.remove(same)
        self._forget()
        for frontier in ranked:
            target = _target_of(frontier, resolution)
            if self._visits.get(_visit_cell(target), 0) < self.config.max_visits and not self._was_seen(target):
                self.target = target
                break
            self._close(frontier, target, resolution)
        return self.target

    def _has_seen(self, target: FrontierTarget, result: Frontiers, pose: Pose2, resolution: float) -> bool:
        """Whether a target has vanished before the robot: it was not left to another one, nor did it move on."""
        found = self.sharing.found if self.sharing is not None and self.sharing.found is not None else result
        is_near = pose.distance(Pose2(target.x, target.y)) <= _SEEN_FROM_M
        left = (float(_distances_to(frontier.cells, target, resolution).min()) for frontier in found.frontiers)
        return is_near and all(distance > _GIVE_UP_RADIUS_M for distance in left)

    def _was_seen(self, target: FrontierTarget) -> bool:
        """Whether a small frontier was seen before and vanished then: cells at the edge of a view change between known
        and uncertain.
        """
        is_small = target.frontier.size < _SMALL_SIZES * self.config.frontier.min_size
        seen = (*self._seen, *self._seen_by_others)
        return is_small and any(hypot(x - target.x, y - target.y) <= _GIVE_UP_RADIUS_M for x, y in seen)

    def _close(self, frontier: Frontier, target: FrontierTarget, resolution: float) -> None:
        """Gives up what cannot be seen better, nor by another robot."""
        closed: set[Cell] = set()
        self._give_up(frontier, target, resolution, closed)
        self._given_up |= closed
        if self.sharing is not None:
            self.sharing.close(np.array(sorted(closed), np.int64), resolution)

    def passed(self, seconds: float, pose: Pose2) -> None:
        """Advances the clocks by `seconds` with the robot at a pose."""
        self._start = self._start or pose
        self.moved = max(self.moved, pose.distance(self._start))
        if self.looking is not None:
            self.looking += seconds
        if self.target is not None and pose.distance(Pose2(self.target.x, self.target.y)) <= _GIVE_UP_RADIUS_M:
            self._near += seconds

    def arrived(self) -> None:
        """Begins the look at the target. Time spent close to it counts for up to half of the look."""
        self.looking = min(self._near, self.config.look_time / 2)

    def failed(self, resolution: float, reason: Reason) -> None:
        """Drops the target as unreachable for a reason. It is tried once more when no other frontier is left."""
        if self.target is not None:
            self._n_missed, self._last_cause = self._n_missed + self._last_try, reason
            into = self._given_up if self._last_try else self._failed
            self._give_up(self.target.frontier, self.target, resolution, into)
        self._forget()

    def retry_failed(self) -> bool:
        """Makes failed frontiers valid again, once. Returns whether there were any."""
        if self._last_try or not self._failed:
            return False
        self._failed.clear()
        self._last_try = True
        return True

    def _costs(self, result: Frontiers, pose: Pose2) -> dict[int, float]:
        """Cost (m, weighted) by id of a tour through all frontiers that begins with this one.

        A small corner that is left behind costs the way back, so it is seen while the robot is near.
        """
        first = np.array([self._cost(f, pose) for f in result.frontiers])
        k = len(result.between)
        lengths = np.concatenate((tours(first[:k], result.between), first[k:] + _BEYOND_TOUR_COST_M))
        return {id(f): float(length) for f, length in zip(result.frontiers, lengths)}

    def _cost(self, frontier: Frontier, pose: Pose2) -> float:
        turn = abs(wrapped(pose.bearing(Pose2(frontier.x, frontier.y)) - pose.yaw))
        size = min(frontier.size, self.config.frontier.max_size)
        return frontier.distance + self.config.turn_weight * turn - self.config.size_weight * size

    def _forget(self) -> None:
        if self.target is not None:
            spot = _visit_cell(self.target)
            self._visits[spot] = self._visits.get(spot, 0) + 1
        self.target, self.looking, self._near, self._n_better = None, None, 0.0, 0

    def _give_up(self, frontier: Frontier, target: FrontierTarget, resolution: float, into: set[Cell]) -> None:
        """Drops the frontier's cells around the target, and at least the nearest one."""
        away = _distances_to(frontier.cells, target, resolution)
        near = frontier.cells[away <= max(_GIVE_UP_RADIUS_M, float(away.min()))]
        into.update((int(row), int(column)) for row, column in near)


def missing_input(grid: OccupancyGrid, pose: Pose2 | None) -> Reason | None:
    """Why no search for frontiers is possible at a pose in `map`; None where one is."""
    if grid.empty:
        return reasons.NO_MAP
    if pose is None:
        return reasons.POSE_OLD
    return None if grid.holds(*grid.cell(pose.x, pose.y)) else reasons.START_OUTSIDE


def _visit_cell(target: FrontierTarget) -> Cell:
    return round(target.x / _VISIT_CELL_M), round(target.y / _VISIT_CELL_M)


def _same_frontier(result: Frontiers, target: FrontierTarget, resolution: float) -> Frontier | None:
    """The found frontier at the target's place, or None."""
    near = [(float(_distances_to(f.cells, target, resolution).min()), i) for i, f in enumerate(result.frontiers)]
    distance, nearest = min(near, default=(_SAME_TARGET_M + 1, 0))
    return result.frontiers[nearest] if distance <= _SAME_TARGET_M else None


def _is_unreachable(result: Frontiers, target: FrontierTarget, resolution: float) -> bool:
    """Whether the target is still a frontier, but without a path."""
    return any(_distances_to(cells, target, resolution).min() <= _SAME_TARGET_M for cells in result.unreachable)


def _target_of(frontier: Frontier, resolution: float) -> FrontierTarget:
    xs, ys = _centres(frontier.cells, resolution)
    middle = int(np.argmin(np.hypot(xs - xs.mean(), ys - ys.mean())))
    return FrontierTarget(frontier, float(xs[middle]), float(ys[middle]))


def _cells_around(points: Float64s, resolution: float) -> Int64s:
    """(n, 2) int64 rows and columns of `map` within _CLOSED_AROUND_M of points (k, 2) m."""
    reach = int(_CLOSED_AROUND_M / resolution)
    steps = np.arange(-reach, reach + 1)
    rows, columns = (part.ravel() for part in np.meshgrid(steps, steps, indexing="ij"))
    disc = np.column_stack((rows, columns))[rows**2 + columns**2 <= reach**2]
    middles = np.floor(points[:, ::-1] / resolution).astype(np.int64)
    return np.asarray(middles[:, None, :] + disc[None, :, :]).reshape(-1, 2)


def _distances_to(cells: Int64s, target: FrontierTarget, resolution: float) -> Float64s:
    """(n,) m from the target's place."""
    xs, ys = _centres(cells, resolution)
    return np.asarray(np.hypot(xs - target.x, ys - target.y))


def _centres(cells: Int64s, resolution: float) -> tuple[Float64s, Float64s]:
    rows, columns = cells.astype(np.float64).T
    return (columns + 0.5) * resolution, (rows + 0.5) * resolution


def warm_up_search(config: FrontierConfig) -> None:
    """Compiles the search on a small map."""
    cells = np.full((TILE_CELLS, TILE_CELLS), -1, np.int8)
    cells[10:40, 10:40] = 0
    cells[10:40, 40] = 100
    snapshot = Snapshot(
        cells=cells,
        first_row=0,
        first_column=0,
        resolution=0.05,
        x=1.0,
        y=1.0,
        robot_radius=0.2,
        dropped=np.zeros((1, 2), np.int64),
    )
    result = find_frontiers(snapshot, config)
    tours(np.array([f.distance for f in result.frontiers]), result.between)
