# SPDX-License-Identifier: Apache-2.0
"""Traffic: publishes where this robot will be, hears the others, and decides how far this one may drive."""

from dataclasses import replace

import numpy as np

from services.traffic.common_frame import CommonFrame, common_frame, moved_intent
from services.traffic.config import TrafficConfig
from services.traffic.conflicts import Clearances, order_of
from services.traffic.floor import Floor
from services.traffic.give_way import GivingWay
from services.traffic.measured_speed import MeasuredSpeed
from services.traffic.neighbours import Neighbours
from services.traffic.outgoing import intent, no_other_robot, other_robots, right_of_way
from services.traffic.passages import passage_widths, points_from_end
from services.traffic.reservation import Reservation
from shared import topics
from shared.config import Robot
from shared.geometry import Pose2
from shared.messages import (
    ExplorationShare,
    Goal,
    MapState,
    MapUpdate,
    Path,
    PoseEstimate,
    Recovery,
    RobotIntent,
    Zones,
)
from shared.orders import Order, is_newer
from shared.pose_tracker import PoseTracker
from shared.service import Out, Service, every, on
from shared.types import NS_PER_S

ALONE_EVERY = 5  # ticks between two messages while no other robot is heard
ALONE_FROM = 12  # ticks after the start, longer than a lease, at which the robot is said to be alone
SAME_GOAL_M = 0.1  # between two goals of one task
TASK_GAP_NS = 15 * NS_PER_S
"""ns without a goal after which a goal at the same place is a new task: recoveries and pauses are shorter."""


class TrafficService(Service):
    """One robot's part of the traffic. Without another robot on its map it says so to its own services, and no more.

    It says so once after its start, too: what a process before it said of other robots would hold for ever.
    """

    config_type = TrafficConfig
    config: TrafficConfig

    def __init__(self, config: TrafficConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self.clearances = Clearances(config.beside, config.passing)
        self.reservation = Reservation(robot.name, robot.circumscribed_radius, self.clearances, config.reach)
        self.giving_way, self.neighbours = GivingWay(), Neighbours()
        self.floor, self.map_name = Floor(robot.circumscribed_radius), ""
        self.share: ExplorationShare | None = None
        self.frame = CommonFrame()
        self.pose_tracker, self.speed = PoseTracker(), MeasuredSpeed()
        self.order: Order | None = None
        self.plan: Path | None = None
        self._taken: tuple[Path | None, int] = None, 0  # the plan that the reservation has, and the floor of its widths
        self.target: tuple[Pose2, int, int] | None = None  # of the task: goal, its begin, when it was last active, ns
        self.is_active = False
        self.n_ticks = 0

    def state(self) -> str:
        n = len(self.neighbours.alive(self.frame.name, self.now))
        if self.giving_way.refuge is not None:
            return f"makes way, {n} others"
        waits = ", ".join(self.reservation.waits_for)
        return f"{n} others" + (f", waits for {waits}" if waits else "")

    @on(topics.MAP)
    def map(self, update: MapUpdate) -> Out:
        self.floor.apply(update)
        return ()

    @on(topics.OTHERS_MAP)
    def others_map(self, update: MapUpdate) -> Out:
        self.floor.apply_others(update)
        return ()

    @on(topics.ZONES)
    def zones(self, zones: Zones) -> Out:
        self.floor.set_zones(zones)
        return ()

    @on(topics.MAP_STATE)
    def map_state(self, state: MapState) -> Out:
        self.map_name = state.name
        self._update_frame()
        return ()

    @on(topics.SHARE)
    def explores(self, share: ExplorationShare) -> Out:
        self.share = share
        self._update_frame()
        return ()

    @on(topics.POSE)
    def pose(self, estimate: PoseEstimate) -> Out:
        before = self.pose_tracker.map_from_base
        jumped = self.pose_tracker.add_estimate(estimate)
        self.speed.add(None if jumped else before, estimate.map_from_base, estimate.stamp)
        return ()

    @on(topics.GOAL)
    def goal(self, goal: Goal) -> Out:
        """Takes a newer goal; a goal at another place is another task, behind all that wait already."""
        if not is_newer(goal, self.order, self.now):
            return ()
        self.order = goal
        if not goal.active:
            self._no_path()
            return ()
        known, self.target = self.target, (goal.map_from_goal, goal.stamp, self.now)
        if known is not None and self.now - known[2] < TASK_GAP_NS:
            if known[0].distance(goal.map_from_goal) <= SAME_GOAL_M:
                self.target = (goal.map_from_goal, known[1], self.now)
            else:
                self.giving_way.end()
        return ()

    @on(topics.RECOVERY)
    def recovery(self, recovery: Recovery) -> Out:
        if is_newer(recovery, self.order, self.now):
            self.order = recovery
            self._no_path()
        return ()

    @on(topics.PLAN)
    def new_plan(self, plan: Path) -> Out:
        """Takes a plan. With other robots there, the right of way on another path, and its intent, follow at once."""
        goal = self.order
        if not isinstance(goal, Goal) or not goal.active or plan.goal_id != goal.id:
            return
        self.plan = None if plan.reason or not len(plan.xs) else plan
        if self.is_active and self._take_plan():
            yield from self._decide()
            yield from self._intent()

    @on(topics.HEARD)
    def heard(self, intent: RobotIntent) -> Out:
        """Hears another robot. If the right of way waits for its answer, that follows at once."""
        if intent.map == self.frame.name:
            intent = moved_intent(intent, self.frame.common_from_map.inverse())
        self.neighbours.hear(intent, self.now)
        if self.reservation.is_answered_by(intent.robot, dict(intent.heard)):
            yield from self._decide()

    @every(hz=5)
    def tick(self) -> Out:
        """Publishes this robot's intent, and with other robots there its right of way and their places.

        A lost robot says where it believes to be, and others that are lost use it. Robots that start side by side hide
        the walls from each other. They find themselves once they leave each other out of their scans.
        """
        self.n_ticks += 1
        self._update_frame()
        self.neighbours.forget(self.now)
        there = self.neighbours.alive(self.frame.name, self.now)
        active = bool(there or self.neighbours.silent(self.frame.name, self.now))
        if self.target is not None and isinstance(self.order, Goal) and self.order.active:
            self.target = (*self.target[:2], self.now)
        if active:
            self.is_active = True
            self._take_plan()
            yield from self._decide()
        elif self.is_active or self.n_ticks == ALONE_FROM:
            self.is_active = False
            self.giving_way.end()
            yield topics.RIGHT_OF_WAY(no_other_robot(self.now))
        is_lost = self.pose_tracker.is_lost
        lost = self.neighbours.lost(self.frame.name, self.now) if is_lost else []
        if active or lost:
            yield topics.OTHER_ROBOTS(other_robots(there, lost, self.now))
        if active or self.n_ticks % ALONE_EVERY == 0:
            yield from self._intent()

    def _intent(self) -> Out:
        here = self.pose_tracker.map_from_base
        if here is not None:
            told = intent(
                me=self.reservation.told(here.x, here.y, self._order()),
                giving_way=self.giving_way,
                there=self.neighbours.alive(self.frame.name, self.now),
                map_name=self.frame.name,
                map_from_base=here,
                velocity=self.speed.at(self.now),
                lost=self.pose_tracker.is_lost,
                now=self.now,
            )
            yield topics.INTENT(moved_intent(told, self.frame.common_from_map))

    def _update_frame(self) -> None:
        """Takes the present frame. What was heard in another one is forgotten."""
        frame = common_frame(self.robot.name, self.map_name, self.share, self.now)
        if frame.common_from_map != self.frame.common_from_map:
            self.neighbours = Neighbours()
        self.frame = frame

    def _no_path(self) -> None:
        self.plan, self._taken = None, (None, 0)
        here = self.pose_tracker.map_from_base or Pose2()
        self.reservation.set_path(np.zeros((0, 2)), np.zeros(0), here.x, here.y, self.now)

    def _take_plan(self) -> bool:
        """Gives the reservation the present plan. Returns whether it is another path."""
        here = self.pose_tracker.map_from_base
        if here is None or self.plan is None:
            return False
        grid, (plan, version) = self.floor.grid(here), self._taken
        if self.plan is plan and self.floor.version == version:
            return False
        self._taken = self.plan, self.floor.version
        points = points_from_end(np.column_stack((self.plan.xs, self.plan.ys)))
        return self.reservation.set_path(points, passage_widths(points, grid), here.x, here.y, self.now)

    def _decide(self) -> Out:
        here = self.pose_tracker.map_from_base
        if here is None:
            return
        others = [neighbour.robot for neighbour in self.neighbours.alive(self.frame.name, self.now)]
        order = self._order()
        self.reservation.move(here.x, here.y)
        self.reservation.update(here.x, here.y, order, others, self.now)
        me = replace(self.reservation.told(here.x, here.y, order), stuck=self.giving_way.stuck)
        self.giving_way.update(me, others, self.floor.grid(here), self.clearances, self.now)
        silent = [neighbour.robot for neighbour in self.neighbours.silent(self.frame.name, self.now)]
        unheard = [*silent, *(robot for robot in others if robot.name in self.reservation.deaf)]
        standing = self.neighbours.standing(self.frame.name, self.now)
        told = right_of_way(
            me=me,
            reservation=self.reservation,
            giving_way=self.giving_way,
            standing=standing,
            unheard=unheard,
            now=self.now,
        )
        yield topics.RIGHT_OF_WAY(told)

    def _order(self) -> tuple[int, int, int, str]:
        since = self.target[1] if self.target is not None else self.now
        return order_of(self.robot.name, self.config.priority, since, self.giving_way.refuge is not None)
