# SPDX-License-Identifier: Apache-2.0
"""Local control: the velocity for the next 50 ms, along the plan and free of collisions."""

from copy import deepcopy

import numpy as np

from services.local_ctrl import warm_up
from services.local_ctrl.config import CONTROLLERS, LocalCtrlConfig
from services.local_ctrl.costmap_update import clear_costmap, update_costmap
from services.local_ctrl.debug_topics import DebugTopics
from services.local_ctrl.footprint import footprint_of
from services.local_ctrl.inputs import ControlInputs, sensors_in_use
from services.local_ctrl.local_costmap import LocalCostmap
from services.local_ctrl.manoeuvres import ControlOutcome, Manoeuvre, braking
from services.local_ctrl.path_following import PathFollower
from services.local_ctrl.received_plan import ReceivedPlan, on_plan_before
from services.local_ctrl.reconfiguration import costmap_reach, reconfigure
from services.local_ctrl.rollout import DT, Motion, limits_of
from services.local_ctrl.state_estimate import StateEstimate
from services.local_ctrl.zones import LocalZones
from shared import reasons, requests, topics
from shared.config import Robot
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import (
    Contacts,
    FollowState,
    FollowStatus,
    Goal,
    LaserScan,
    MapState,
    MapUpdate,
    Odometry,
    OtherRobots,
    Path,
    PoseEstimate,
    RangeReadings,
    Recovery,
    RightOfWay,
    Velocity,
    Zones,
)
from shared.orders import Order, is_newer
from shared.requests import ClearCostmaps, Reply, Watch
from shared.service import Answer, Out, Service, answer, every, on
from shared.settings import Configuration
from shared.types import NS_PER_S

MAX_AGE_S = 1.0  # of an input at its arrival


class LocalCtrlService(Service):
    """Follows the plan to the goal, or runs a recovery of the navigator. It stands where an input is missing."""

    config_type = LocalCtrlConfig

    def __init__(self, config: LocalCtrlConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self.limits = limits_of(robot.drive, config.max_speed, config.max_reverse_speed)
        self.footprint = footprint_of(robot, config.padding)
        reach = costmap_reach(config, self.limits, self.footprint)
        self.costmap = LocalCostmap(config.tracked_costmap, reach, config.latency)
        self.inputs = ControlInputs(config.ages, robot)
        self.zones = LocalZones(robot)
        self.path_follower = PathFollower(
            config=config.path_following,
            cost_to_go=config.cost_to_go,
            controller=CONTROLLERS[config.controller](config, self.limits),
            limits=self.limits,
            footprint=self.footprint,
            zones=self.zones,
        )
        self.grid, self.debug_topics = OccupancyGrid(), DebugTopics()
        self.order: Order | None = None  # the one with the highest id
        self.manoeuvre: Manoeuvre | None = None
        self.plan = ReceivedPlan(config.ages)
        self.estimate = StateEstimate(self.limits, config.latency, config.speed_settling)
        self.start, self.last_tick = Motion(Pose2(), 0.0, 0.0), 0  # of the last rollouts; ns
        self.ranges_wanted, self.ranges_limits = sensors_in_use(robot, config.costmap)

    def settings_changed(self, old: Configuration, new: Configuration) -> Out:
        """Takes limits, costs and critics. The content of the costmap and the last solution stay."""
        reconfigure(self)
        return ()

    @on(topics.ODOM, waits=True)
    def odometry(self, odometry: Odometry) -> Out:
        """Takes odometry. A restart of odometry clears the costmap and the state of path following."""
        known = last.stamp if (last := self.inputs.odometry.latest) is not None else None
        if not self.rejections.judge(topics.ODOM.key, odometry.stamp, known, self.now, MAX_AGE_S):
            return ()
        if not (continues := self.inputs.add_odometry(odometry)):
            self.costmap.clear()
            self.path_follower.reset()
            self.manoeuvre = None
        self.estimate.add_odometry(odometry, last if continues else None)
        return ()

    @on(topics.SCAN)
    def scan(self, scan: LaserScan) -> Out:
        return self._take_scan(topics.SCAN.key, scan)

    @on(topics.SCAN_2)
    def scan_2(self, scan: LaserScan) -> Out:
        return self._take_scan(topics.SCAN_2.key, scan)

    def _take_scan(self, key: str, scan: LaserScan) -> Out:
        if (odom_from_base := self.inputs.add_scan(key, scan, self.rejections, self.now)) is not None:
            self.costmap.recentre(*odom_from_base[-1, :2])
            self.costmap.add_scan(scan, odom_from_base, self.inputs.lasers[key].mount, key)
        return ()

    @on(topics.RANGES, waits=True)
    def ranges(self, readings: RangeReadings) -> Out:
        is_of_robot = len(readings.ranges) == len(self.ranges_wanted)
        if is_of_robot and (here := self.inputs.add_ranges(readings, self.rejections, self.now)) is not None:
            self.costmap.recentre(here.x, here.y)
            self.costmap.add_ranges(readings, here, self.ranges_wanted, self.ranges_limits)
        return ()

    @on(topics.POSE)
    def pose(self, pose: PoseEstimate) -> Out:
        self.inputs.add_pose(pose)
        return ()

    @on(topics.MAP)
    def map(self, update: MapUpdate) -> Out:
        self.grid.apply(update)
        return ()

    @on(topics.MAP_STATE)
    def map_state(self, state: MapState) -> Out:
        self.zones.set_walls(state)
        return ()

    @on(topics.CONTACTS)
    def contacts(self, contacts: Contacts) -> Out:
        if (pose := self.inputs.pose) is not None:
            self.zones.add_contacts(contacts, self.inputs.map_from_base(pose), self.now, self.grid.map_id)
        return ()

    @on(topics.ZONES)
    def new_zones(self, zones: Zones) -> Out:
        self.zones.set_zones(zones)
        return ()

    @on(topics.RIGHT_OF_WAY)
    def right_of_way(self, told: RightOfWay) -> Out:
        self.path_follower.traffic.right_of_way = told
        return ()

    @on(topics.OTHER_ROBOTS)
    def other_robots(self, others: OtherRobots) -> Out:
        self.path_follower.traffic.others = others
        return ()

    @on(topics.GOAL)
    def new_goal(self, goal: Goal) -> Out:
        """Begins a newer goal. Between two active goals the robot keeps driving."""
        if not is_newer(goal, self.order, self.now):
            return ()
        driving = isinstance(self.order, Goal) and self.order.active and goal.active
        self.order, self.manoeuvre = goal, None
        if goal.clear_costmap:
            self.costmap.clear()
        if keeps_plan := driving and not self.path_follower.missed:
            self.path_follower.at_end = False
        else:
            self.path_follower.reset()
        self.plan.set_goal(goal, self.now, keeps_plan)
        return ()

    @on(topics.RECOVERY)
    def new_recovery(self, recovery: Recovery) -> Out:
        if is_newer(recovery, self.order, self.now):
            self.order, self.manoeuvre = recovery, None
            self.path_follower.reset()
            self.plan.clear_goal()
        return ()

    @on(topics.PLAN)
    def new_plan(self, path: Path) -> Out:
        self.plan.set_message(path)
        return ()

    @every(hz=20, after=topics.SCAN)
    def tick(self) -> Out:
        """Publishes the next command, the status of the goal, and the debug topics while a client watches."""
        n_elapsed = round((self.now - self.last_tick) / (DT * NS_PER_S)) if self.last_tick else 0
        self.last_tick = self.now
        outcome = self._control_outcome(n_elapsed)
        outcome = outcome._replace(w=self.robot.drive.bent(outcome.v, outcome.w))
        self.estimate.add_command(self.now, outcome.v, outcome.w)
        yield topics.CMD_NAV(Velocity(self.now, outcome.v, outcome.w, outcome.reason))
        order = 0 if self.order is None else self.order.id
        yield topics.FOLLOW(FollowStatus(self.now, order, outcome.state, outcome.reason, outcome.left))
        if self.debug_topics.is_due(self.now) and self.inputs.odometry.latest is not None:
            costmap = deepcopy(self.costmap)  # the update changes it, and a spectator must not change the drive
            update_costmap(costmap, self.inputs, self.grid, self.zones, self.footprint, self.now)
            yield from self.debug_topics.publications(self.now, costmap, self.path_follower, self.start)

    @answer(requests.WATCH)
    def watch(self, request: Watch) -> Answer[Reply]:
        return self.debug_topics.watch(request, self.now)

    @answer(requests.CLEAR_COSTMAPS)
    def clear_costmaps(self, request: ClearCostmaps) -> Answer[Reply]:
        is_cleared = clear_costmap(self.costmap, self.inputs, request.side, request.outside)
        yield from ()
        return Reply(self.now, is_cleared, "" if is_cleared else reasons.ODOM_OLD.code, "")

    def _control_outcome(self, n_elapsed: int) -> ControlOutcome:
        """The command and the state of the goal. n_elapsed: steps of DT since the last tick."""
        if (order := self.order) is None or (isinstance(order, Goal) and not order.active):
            return ControlOutcome(0.0, 0.0, FollowState.IDLE)
        lost = self.inputs.localization_fault(self.now) if isinstance(order, Goal) else None
        stop = self.inputs.stale_input(self.now, self.rejections) or lost or self.path_follower.traffic.fault(self.now)
        if stop is not None:
            self.path_follower.reset()
            return ControlOutcome(0.0, 0.0, FollowState.BLOCKED, stop.code)
        motion = self.start = self.estimate.at_command_time(self.now)
        update_costmap(self.costmap, self.inputs, self.grid, self.zones, self.footprint, self.now)
        if isinstance(order, Recovery):
            if self.manoeuvre is None:
                self.manoeuvre = Manoeuvre(order, motion.pose, self.now, self.config.manoeuvres)
            limits = self.limits
            if self.inputs.pose is not None:
                limits = self.zones.limits_in_zones(limits, np.empty((0, 2)), motion, self.inputs.odom_from_map)
            return self.manoeuvre.step(self.costmap, motion, limits, self.footprint, self.now)
        reason, plan = self.plan.fault(order, self.inputs.jumped_at, self.now), self.plan.local_plan
        if reason is not None or plan is None:
            self.path_follower.reset()
            return braking(motion, self.limits, FollowState.BLOCKED, reason or reasons.NO_PLAN.code)
        odom_from_map = self.inputs.odom_from_map
        outcome = self.path_follower.follow(plan, order, self.costmap, motion, odom_from_map, n_elapsed, self.now)
        if not self.plan.is_for(order):
            self.path_follower.missed = False
            outcome = on_plan_before(outcome, plan, order)
        return outcome

    def warm_up(self) -> None:
        """Compiles the kernels: a second service with each controller follows, turns and backs up once."""
        warm_up.drive_all(LocalCtrlService, self.config, self.robot)

    def state(self) -> str:
        if isinstance(self.order, Recovery):
            return str(self.order.kind)
        return "idle" if self.order is None else "drive" if self.order.active else "none"
