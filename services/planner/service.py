# SPDX-License-Identifier: Apache-2.0
"""The global planner: the path from the robot to the goal on the present map, or the reason why there is none."""

from math import pi
from typing import ClassVar

import numpy as np

from services.planner.costmap import CostConfig, GlobalCostmap
from services.planner.costmap_topic import PERIOD_NS as COSTMAP_PERIOD_NS
from services.planner.costmap_topic import costmap_message
from services.planner.hierarchical_search import HierarchicalSearch
from services.planner.other_robots import PlannerTraffic
from services.planner.plan_message import plan_message
from services.planner.plan_monitor import PlanMonitor, PlanMonitorConfig, search_ahead
from services.planner.planning import GlobalPlan, PlanningConfig, no_plan, plan_path, turning_limits
from services.planner.present_costmap import PresentCostmap
from shared import reasons, requests, topics
from shared import sample_messages as sample
from shared.config import Robot, Section
from shared.contacts import ContactPlaces
from shared.geometry import Pose2
from shared.messages import (
    TILE_CELLS,
    Contacts,
    Goal,
    GoalLimits,
    MapState,
    MapUpdate,
    Odometry,
    PoseEstimate,
    Recovery,
    RightOfWay,
    Zones,
)
from shared.orders import Order, is_newer
from shared.pose_tracker import PoseTracker
from shared.requests import Reply, Watch
from shared.service import Answer, Out, Service, answer, every, on
from shared.settings import Configuration
from shared.watched_topic import WatchedTopic

PERIOD_NS = 500_000_000
"""Period of the plan messages. Local control does not follow a plan that is older than 2 s."""


class PlannerConfig(Section):
    """The global planner."""

    RENAMED: ClassVar[dict[str, str]] = {"upkeep": "replanning"}

    cost: CostConfig = CostConfig()
    path: PlanningConfig = PlanningConfig()
    replanning: PlanMonitorConfig = PlanMonitorConfig()


class PlannerService(Service):
    """Plans while there is an active goal. Publishes the plan at 2 Hz, and at once where it changed."""

    config_type = PlannerConfig
    config: PlannerConfig

    def __init__(self, config: PlannerConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self.present = PresentCostmap(config.cost, robot)
        self.search = HierarchicalSearch()
        self.pose_tracker = PoseTracker()
        self.contact_places, self.traffic = ContactPlaces(robot), PlannerTraffic()
        self.monitor = PlanMonitor(config.replanning, search_ahead(robot.drive, 1e-9 * PERIOD_NS))
        self.goal: Goal | None = None  # that is planned to
        self.order: Order | None = None  # the one with the highest id
        self.limits_published = False
        self.costmap_topic = WatchedTopic(COSTMAP_PERIOD_NS)

    def warm_up(self) -> None:
        """Compiles the kernels: a second service plans on a small map."""
        other = PlannerService(self.config, self.robot)
        start = Pose2(0.6, 1.6)
        cells = np.zeros((TILE_CELLS, TILE_CELLS), np.int8)
        cells[20:, 32] = 100
        for version in (1, 2):
            cells[10, 10 * version] = 100
            list(other.map(sample.map_update(0, cells, version)))
            list(other.pose(sample.pose_estimate(0, start)))
            list(other.odometry(sample.odometry(0, start)))
            for x in (1.625, 2.6):  # in the wall, behind it
                list(other.new_goal(sample.goal(0, round(10 * x), Pose2(x, 1.6))))
                list(other.confirm())
            list(other.zones(sample.zones(0, 0.2, 2.0)))

    def state(self) -> str:
        """State for the health message."""
        if self.goal is None:
            return "no goal"
        plan = self.monitor.plan
        return plan.reason.code if plan and plan.reason else "planning"

    def settings_changed(self, old: Configuration, new: Configuration) -> Out:
        """Computes the costs again where they changed, and plans again at once."""
        self.monitor.config = new.config.replanning
        if new.config.cost != old.config.cost:
            self.present.configure(new.config.cost)
            self.limits_published = False
        self.monitor.clear()
        yield from self._publish_plan(always=True)

    @on(topics.MAP)
    def map(self, update: MapUpdate) -> Out:
        """Takes tiles of the map. The plan follows at once, unless the costmap was just updated."""
        if self.present.apply(update):
            self.contact_places.clear()
            self.present.set_temporary(self.traffic.polygons)
            self.monitor.clear()
        yield from self._map_changed()

    @on(topics.OTHERS_MAP)
    def others_map(self, update: MapUpdate) -> Out:
        """Takes tiles of what the robots know that this one explores with."""
        self.present.apply_others(update)
        yield from self._map_changed()

    def _map_changed(self) -> Out:
        updated_at = self.present.updated_at
        if self.goal and (updated_at is None or self.now - updated_at >= 0.8 * PERIOD_NS):
            yield from self._publish_plan(always=False)

    @on(topics.MAP_STATE)
    def map_state(self, state: MapState) -> Out:
        """Plans again at once: a virtual wall on the present plan does not go away as a person does."""
        self.monitor.clear()
        yield from self._publish_plan(always=True)

    @on(topics.ZONES)
    def zones(self, zones: Zones) -> Out:
        self.present.set_zones(zones)
        yield from self._zones_changed()

    def _zones_changed(self) -> Out:
        self.monitor.clear()
        yield from self._publish_plan(always=True)

    @on(topics.CONTACTS)
    def contacts(self, contacts: Contacts) -> Out:
        """Takes the places of contacts as zones for a while, and plans around them at once."""
        pose = self.pose_tracker.map_from_base
        if pose is not None and self.contact_places.add(contacts, pose, self.now):
            self.present.set_temporary((*self.contact_places.polygons, *self.traffic.polygons))
            yield from self._zones_changed()

    @on(topics.RIGHT_OF_WAY)
    def right_of_way(self, told: RightOfWay) -> Out:
        """Plans around robots that stand, and to the refuge while the robot makes way."""
        if self.traffic.update(told):
            self.present.set_temporary((*self.contact_places.polygons, *self.traffic.polygons))
            yield from self._zones_changed()

    @on(topics.POSE)
    def pose(self, estimate: PoseEstimate) -> Out:
        self.pose_tracker.add_estimate(estimate)
        here = self.pose_tracker.map_from_base
        if self.goal and not self.pose_tracker.is_lost and here is not None and self.monitor.is_off_plan(here):
            yield from self._publish_plan(always=False)

    @on(topics.ODOM, waits=True)
    def odometry(self, odometry: Odometry) -> Out:
        self.pose_tracker.add_odometry(odometry)
        return ()

    @on(topics.GOAL)
    def new_goal(self, goal: Goal) -> Out:
        if is_newer(goal, self.order, self.now):
            self.order, self.goal = goal, goal if goal.active else None
            self.monitor.clear()
            yield from self._publish_plan(always=True)

    @on(topics.RECOVERY)
    def new_recovery(self, recovery: Recovery) -> Out:
        if is_newer(recovery, self.order, self.now):
            self.order, self.goal = recovery, None
            self.monitor.clear()
        return ()

    @every(hz=2)
    def confirm(self) -> Out:
        """Publishes the plan, and once the limits of goals."""
        if not self.limits_published:
            self.limits_published, cost = True, self.config.cost
            reach = self.config.path.goal_reach
            yield topics.LIMITS(GoalLimits(self.now, cost.margin, cost.min_margin, reach, cost.beyond))
        yield from self._publish_plan(always=True)
        if not self.present.grid.empty and self.costmap_topic.is_due(self.now):
            yield topics.GLOBAL_COSTMAP(costmap_message(self.present.shown(), self.now))

    @answer(requests.WATCH_GLOBAL_COSTMAP)
    def watch_costmap(self, request: Watch) -> Answer[Reply]:
        return self.costmap_topic.watch(request, self.now)

    def _publish_plan(self, always: bool) -> Out:
        """Updates the plan and publishes it. always: also an unchanged one."""
        if self.goal is None:
            return
        before = self.monitor.plan
        self._update_plan(self.traffic.goal(self.goal))
        if self.monitor.plan is not None and (always or self.monitor.plan is not before):
            yield topics.PLAN(
                plan_message(self.monitor, self.monitor.plan, self.goal, self.present.grid.version, self.now)
            )

    def _update_plan(self, goal: Goal) -> None:
        """Lets the monitor keep or replace the plan."""
        pose = self.pose_tracker.map_from_base
        if self.present.grid.empty:
            self.monitor.replace(no_plan(reasons.NO_MAP))
        elif pose is None:
            self.monitor.replace(no_plan(reasons.POSE_OLD))
        elif self.present.is_forbidden(goal.map_from_goal):
            self.monitor.replace(no_plan(reasons.GOAL_KEEP_OUT))
        elif not (self.monitor.drivable_plan and self.pose_tracker.is_lost):
            costmap = self.present.at(pose, self.now)
            self.monitor.update(self._new_plan(costmap, pose, goal), costmap, pose, self.now)

    def _new_plan(self, costmap: GlobalCostmap, pose: Pose2, goal: Goal) -> GlobalPlan:
        arcs = turning_limits(self.robot.drive, goal.yaw_tolerance > pi)
        return plan_path(
            costmap=costmap,
            search=self.search,
            start=pose,
            goal=goal.map_from_goal,
            tolerance=goal.tolerance,
            config=self.config.path,
            turning=arcs,
        )
