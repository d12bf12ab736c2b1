# SPDX-License-Identifier: Apache-2.0
"""The global planner: keeps a path from the robot to the goal on the present map, or says why there is none."""

from math import pi

import numpy as np
from numpy.typing import NDArray

from services.planner.outline import Outline
from services.planner.planning import Plan, PlanningConfig, Turning, no_plan, planned
from services.planner.traversal_cost import CostConfig, Terrain
from services.planner.upkeep import AHEAD, UpkeepConfig, length, remaining, standing, worth_switching, worth_waiting
from services.planner.zoning import Zoning
from shared import reasons, topics
from shared.config import Robot, Section
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import (
    TILE_CELLS,
    Goal,
    GoalKind,
    GoalLimits,
    Localization,
    MapUpdate,
    Odometry,
    Path,
    PoseEstimate,
    Zone,
    ZoneKind,
    Zones,
)
from shared.service import Out, Service, every, on
from shared.stamps import precedes
from shared.whereabouts import Whereabouts

PERIOD_NS = 500_000_000
"""A plan is confirmed twice a second; local control lets go of one that is older than 2 s."""

Bools = NDArray[np.bool_]


class PlannerConfig(Section):
    """The global planner."""

    cost: CostConfig = CostConfig()
    path: PlanningConfig = PlanningConfig()
    upkeep: UpkeepConfig = UpkeepConfig()


class PlannerService(Service):
    """Plans while the goal's kind is DRIVE; publishes at 2 Hz and at once where something changed."""

    config_type = PlannerConfig
    config: PlannerConfig

    def __init__(self, config: PlannerConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self.grid = OccupancyGrid()
        self.terrain: Terrain | None = None
        self.outline = Outline()
        self.zoning = Zoning(robot.circumscribed_radius)
        self.where = Whereabouts()
        radius = robot.drive.min_turning_radius
        travelled = 2e-9 * PERIOD_NS * robot.drive.max_speed  # m between two looks, and as much again
        self.within = min(AHEAD, max(2 * radius, travelled)) if radius else AHEAD  # m: not across a wide loop
        self.goal: Goal | None = None
        self.plan: Plan | None = None
        self.index = 0  # of the plan's pose that the robot is at
        self.cost_left = 0.0  # m, weighted, from there
        self.known: Bools | None = None  # which of the plan's poses lay in space seen free when it was last free
        self.blocked_since: int | None = None
        self.changed: Bools | None = None  # since the terrain's update; None: everything
        self.fresh = True  # the terrain holds the whole map
        self.told = False  # the limits of goals
        self.updated = -PERIOD_NS  # when the terrain was

    def warm(self) -> None:
        """Plans once on a small map, with another service of the same kind."""
        other = PlannerService(self.config, self.robot)
        cells = np.zeros((1, TILE_CELLS, TILE_CELLS), np.int8)
        cells[0, 20:, 32] = 100
        for version in (1, 2):
            cells[0, 10, 10 * version] = 100
            tile = cells.reshape(1, -1).copy()
            place = np.zeros(1, np.int32)
            list(other.map(MapUpdate(0, 1, version, 0.05, place, place, tile)))
            pose, covariance = Pose2(0.6, 1.6), np.zeros(9)
            list(other.pose(PoseEstimate(0, pose, Pose2(), covariance, 1.0, Localization.GOOD)))
            list(other.odometry(Odometry(0, pose, 0.0, 0.0, covariance)))
            for x in (1.625, 2.6):  # in the wall, behind it
                list(other.new_goal(Goal(0, round(10 * x), GoalKind.DRIVE, Pose2(x, 1.6), 0.1, 0.1, 0.0, False)))
                list(other.confirm())
            square = np.array([0.2, 0.4, 0.4, 0.2]), np.array([2.0, 2.0, 2.2, 2.2])
            list(other.zones(Zones(0, (Zone(0, "keep out", ZoneKind.KEEP_OUT, *square),))))

    def state(self) -> str:
        if self.goal is None:
            return "no goal"
        return self.plan.reason.code if self.plan and self.plan.reason else "planning"

    @on(topics.MAP)
    def map(self, update: MapUpdate) -> Out:
        shape, map_id, resolution = self.grid.cells.shape, self.grid.map_id, self.grid.resolution
        changed = self.grid.apply(update)
        if (self.grid.map_id, self.grid.resolution) != (map_id, resolution):
            self.terrain = self.plan = None
        same = self.terrain is not None and changed.shape == shape
        if self.fresh:
            self.changed = changed if same else None
        elif self.changed is not None:
            self.changed = self.changed | changed if same else None
        self.fresh = False
        if self.goal and self.now - self.updated >= 0.8 * PERIOD_NS:
            yield from self._keep(always=False)

    @on(topics.ZONES)
    def zones(self, zones: Zones) -> Out:
        """What was free to the last plan need not be now, and a robot under way has its new one at once."""
        self.zoning.take(zones)
        self.changed, self.fresh, self.plan = None, False, None
        yield from self._keep(always=True)

    @on(topics.POSE)
    def pose(self, estimate: PoseEstimate) -> Out:
        self.where.estimated(estimate)
        if self.goal and self.plan is not None and self._off_plan():
            yield from self._keep(always=False)

    @on(topics.ODOM)
    def odometry(self, odometry: Odometry) -> Out:
        self.where.moved(odometry)
        return ()

    @on(topics.GOAL)
    def new_goal(self, goal: Goal) -> Out:
        last = self.goal
        if last and (goal.id == last.id or (goal.id < last.id and precedes(goal.stamp, last.stamp, self.now))):
            return
        self.goal = goal if goal.kind is GoalKind.DRIVE else None
        self.plan, self.blocked_since = None, None
        yield from self._keep(always=True)

    @every(hz=2)
    def confirm(self) -> Out:
        if not self.told:
            self.told, cost = True, self.config.cost
            reach = self.config.path.goal_reach
            yield topics.LIMITS(GoalLimits(self.now, cost.margin, cost.least_margin, reach, cost.beyond))
        yield from self._keep(always=True)

    def _keep(self, always: bool) -> Out:
        """Publishes the plan: the old one where it still holds, else a new one. always: also where nothing changed."""
        if self.goal is None:
            return
        before = self.plan
        self.plan = self._present(self.goal)
        if always or self.plan is not before:
            yield topics.PLAN(self._message(self.goal, self.plan))

    def _present(self, goal: Goal) -> Plan:
        """The plan that holds now."""
        pose = self.where.map_from_base
        if self.grid.empty:
            return self._taken(no_plan(reasons.NO_MAP))
        if pose is None:
            return self._taken(no_plan(reasons.POSE_OLD))
        if self.zoning.forbids(goal.map_from_goal):
            return self._taken(no_plan(reasons.GOAL_KEEP_OUT))
        old = self.plan if self.plan is not None and self.plan.reason is None else None
        if old and self.where.lost:
            return old
        terrain = self._terrain(pose)
        if old is None:
            return self._taken(self._new(terrain, pose, goal))
        stands = standing(terrain, old, self.index, pose.x, pose.y, self.within)
        self.index = stands.index
        new = self._new(terrain, pose, goal)
        upkeep = self.config.upkeep
        if stands.off > upkeep.off_plan:
            return self._taken(new)
        if stands.blocked < 0:
            self.blocked_since, self.cost_left, self.known = None, stands.cost, terrain.known_free(old.points)
            return self._taken(new) if worth_switching(remaining(old, stands.index), stands.cost, new, upkeep) else old
        self.blocked_since = self.now if self.blocked_since is None else self.blocked_since
        # a wall just discovered stays; what came into space that was seen free may go again
        came = self.known is not None and bool(self.known[stands.blocked])
        waits = came and 0 <= self.now - self.blocked_since <= upkeep.patience * 1e9
        rest = remaining(old, stands.index)
        return old if waits and worth_waiting(rest, self.cost_left, stands.ahead, new, upkeep) else self._taken(new)

    def _new(self, terrain: Terrain, pose: Pose2, goal: Goal) -> Plan:
        drive = self.robot.drive
        arcs = Turning(drive.min_turning_radius, drive.turns_in_place, goal.yaw_tolerance > pi)
        turning = arcs if drive.min_turning_radius else None
        return planned(terrain, self.outline, pose, goal.map_from_goal, goal.tolerance, self.config.path, turning)

    def _taken(self, plan: Plan) -> Plan:
        self.index, self.blocked_since, self.cost_left = 0, None, plan.cost
        self.known = self.terrain.known_free(plan.points) if self.terrain else None
        return plan

    def _terrain(self, pose: Pose2) -> Terrain:
        """The costs of the present map to a robot at a pose."""
        if self.zoning.moved(pose):
            self.changed, self.fresh = None, False
        if self.terrain is None:
            self.terrain, self.changed, self.fresh = (
                Terrain(self.config.cost, self.robot, self.grid.resolution),
                None,
                False,
            )
        if not self.fresh:
            self.zoning.update(self.terrain, self.grid, self.changed)
            self.fresh, self.updated = True, self.now
        return self.terrain

    def _off_plan(self) -> bool:
        pose = self.where.map_from_base
        if pose is None or self.plan is None or self.plan.reason or self.where.lost:
            return False
        away = np.hypot(self.plan.points[:, 0] - pose.x, self.plan.points[:, 1] - pose.y)
        return bool(away.min() > self.config.upkeep.off_plan)

    def _message(self, goal: Goal, plan: Plan) -> Path:
        points, yaws = plan.points[self.index :], plan.yaws[self.index :]
        return Path(
            self.now,
            goal.id,
            self.grid.version,
            plan.reason.code if plan.reason else "",
            np.ascontiguousarray(points[:, 0]),
            np.ascontiguousarray(points[:, 1]),
            yaws,
            length(points),
            self.cost_left,
        )
