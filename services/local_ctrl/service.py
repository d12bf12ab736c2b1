# SPDX-License-Identifier: Apache-2.0
"""Local control: where to drive in the next 50 ms, so that the plan is followed and nothing is touched."""

from collections import deque
from collections.abc import Callable
from copy import deepcopy
from typing import Literal

import numpy as np
from pydantic import Field

from services.local_ctrl import rehearsal
from services.local_ctrl.controller import Controller
from services.local_ctrl.distance_to_go import DistanceToGoConfig
from services.local_ctrl.dwa import Dwa, DwaConfig
from services.local_ctrl.follow import FollowConfig, Follower
from services.local_ctrl.footprint import footprint_of
from services.local_ctrl.inputs import AgesConfig, Inputs, S, scan_end
from services.local_ctrl.local_costmap import CostmapConfig, LocalCostmap
from services.local_ctrl.local_plan import LocalPlan
from services.local_ctrl.manoeuvres import Manoeuvre, ManoeuvreConfig, Outcome, braking
from services.local_ctrl.mppi import Mppi, MppiConfig
from services.local_ctrl.pursuit import Pursuit, PursuitConfig
from services.local_ctrl.rollout import DT, Command, Limits, Motion, limits_of, predicted
from services.local_ctrl.view import View
from services.local_ctrl.zones import LocalZones
from shared import reasons, requests, topics
from shared.config import Robot, Section
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import (
    FollowState,
    FollowStatus,
    Goal,
    GoalKind,
    LaserScan,
    MapUpdate,
    Odometry,
    Path,
    PoseEstimate,
    RangeReadings,
    Velocity,
    Zones,
)
from shared.requests import Reply, Watch
from shared.scan_faults import mismatch
from shared.service import Answer, Out, Service, answer, every, on
from shared.stamps import precedes

MAX_AGE = 1.0  # s; what is older when it comes is of another time
RIM = 1.0  # m of the costmap beyond where the robot's middle may be when the longest rollout ends, at least
BESIDE = 0.5  # m of it beyond the robot's outline there, at least


class LocalCtrlConfig(Section):
    """Local control."""

    controller: Literal["mppi", "dwa", "pursuit"] = Field(
        "mppi", description="what follows the plan; docs/local_control.md says when to pick which"
    )
    max_speed: float = Field(10.0, gt=0, le=10, description="m/s forward, where the drive allows more")
    max_reverse_speed: float = Field(
        0.15, ge=0, le=10, description="m/s backward, where the drive allows more; 0: never"
    )
    latency: float = Field(0.06, ge=0, le=0.5, description="s from a command's sending until the base acts on it")
    speed_settling: float = Field(0.06, ge=0, le=1, description="s over which measured speed replaces commanded speed")
    padding: float = Field(0.03, ge=0, le=0.5, description="m around the footprint that count as robot")
    ages: AgesConfig = AgesConfig()
    costmap: CostmapConfig = CostmapConfig()
    distance_to_go: DistanceToGoConfig = DistanceToGoConfig()
    follow: FollowConfig = FollowConfig()
    manoeuvres: ManoeuvreConfig = ManoeuvreConfig()
    mppi: MppiConfig = MppiConfig()
    dwa: DwaConfig = DwaConfig()
    pursuit: PursuitConfig = PursuitConfig()


CONTROLLERS: dict[str, Callable[[LocalCtrlConfig, Limits], Controller]] = {
    "mppi": lambda config, limits: Mppi(config.mppi, limits),
    "dwa": lambda config, limits: Dwa(config.dwa, limits),
    "pursuit": lambda config, limits: Pursuit(config.pursuit, limits),
}


class LocalCtrlService(Service):
    """Follows the plan to the goal, or does the navigator's recovery, on what was sensed lately; else it stands."""

    config_type = LocalCtrlConfig

    def __init__(self, config: LocalCtrlConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self.config = config
        self.limits = limits_of(robot.drive, config.max_speed, config.max_reverse_speed)
        self.footprint = footprint_of(robot, config.padding)
        horizon = max(config.mppi.steps * DT, config.dwa.sim_time if config.controller == "dwa" else 0.0)
        travelled = self.limits.v_max * max(horizon, 0.5 * self.limits.v_max / self.limits.braking)
        reach = travelled + max(RIM, self.footprint.circumscribed + BESIDE)
        self.costmap = LocalCostmap(config.costmap, reach, config.latency)
        self.inputs = Inputs(config.ages)
        controller = CONTROLLERS[config.controller](config, self.limits)
        self.zones = LocalZones(robot.circumscribed_radius)
        self.follower = Follower(
            config.follow, config.distance_to_go, controller, self.limits, self.footprint, self.zones
        )
        self.grid = OccupancyGrid()
        self.goal: Goal | None = None
        self.goal_since = 0  # ns
        self.manoeuvre: Manoeuvre | None = None
        self.path: Path | None = None
        self.plan: LocalPlan | None = None
        self.motion = self.acting = Motion(Pose2(), 0.0, 0.0)
        self.commands: deque[Command] = deque(maxlen=64)
        self.last_tick = 0  # ns
        self.view = View()
        kinds = {"ultrasonic": config.costmap.ultrasonic, "infrared": config.costmap.infrared}
        self.ranges_wanted = np.array([kinds[sensor.kind] for sensor in robot.ranges], bool)
        self.ranges_limits = np.array([(s.range_min, s.range_max) for s in robot.ranges], float).reshape(-1, 2)

    @on(topics.ODOM)
    def odometry(self, odometry: Odometry) -> Out:
        known = self.inputs.history[-1].stamp if self.inputs.history else None
        if not self.rejections.judge(topics.ODOM.key, odometry.stamp, known, self.now, MAX_AGE):
            return ()
        before = odometry.stamp if known is None else known
        if self.inputs.add_odometry(odometry, self.robot.drive.max_speed):
            self.costmap.forget()
            self.follower.reset()
            self.manoeuvre = None
        last = self.inputs.history[-1]
        elapsed = (last.stamp - before) / S
        if elapsed < 0.0 or elapsed > 0.5 or len(self.inputs.history) == 1:
            self.motion = Motion(last.odom_from_base, last.v, last.w)
        elif elapsed > 0.0:
            # wheel speeds come in whole counts: between them, what was commanded tells more
            guess = predicted(
                self.motion, self.limits, list(self.commands), before, last.stamp, int(self.config.latency * S)
            )
            share = elapsed / (elapsed + self.config.speed_settling)
            v, w = guess.v + share * (last.v - guess.v), guess.w + share * (last.w - guess.w)
            self.motion = Motion(last.odom_from_base, v, w)
        return ()

    @on(topics.SCAN)
    def scan(self, scan: LaserScan) -> Out:
        last, unlike = self.inputs.scan, mismatch(scan, self.robot.laser)
        last_end = scan_end(last) if last is not None else None
        if not self.rejections.judge(topics.SCAN.key, scan_end(scan), last_end, self.now, MAX_AGE, unfit=unlike):
            return ()
        odom_from_base = self.inputs.add_scan(scan)
        if odom_from_base is not None:
            self.costmap.recentre(*odom_from_base[-1, :2])
            self.costmap.see(scan, odom_from_base, self.robot.laser.mount)
        return ()

    @on(topics.RANGES)
    def ranges(self, readings: RangeReadings) -> Out:
        if len(readings.ranges) == len(self.ranges_wanted) and self.inputs.history:
            here = self.inputs.history[-1].odom_from_base
            self.costmap.recentre(here.x, here.y)
            self.costmap.hear(readings, here, self.ranges_wanted, self.ranges_limits)
        return ()

    @on(topics.POSE)
    def pose(self, pose: PoseEstimate) -> Out:
        self.inputs.add_pose(pose)
        return ()

    @on(topics.MAP)
    def map(self, update: MapUpdate) -> Out:
        self.grid.apply(update)
        return ()

    @on(topics.ZONES)
    def new_zones(self, zones: Zones) -> Out:
        self.zones.take(zones)
        return ()

    @on(topics.GOAL)
    def new_goal(self, goal: Goal) -> Out:
        if self.goal is not None and (goal.id, goal.kind, goal.amount) == (
            self.goal.id,
            self.goal.kind,
            self.goal.amount,
        ):
            return ()
        if self.goal is not None and goal.id < self.goal.id and precedes(goal.stamp, self.goal.stamp, self.now):
            return ()
        driving = self.goal is not None and self.goal.kind is goal.kind is GoalKind.DRIVE
        self.goal, self.goal_since, self.manoeuvre = goal, self.now, None
        if goal.clear_costmap:
            self.costmap.forget()
        if driving and not self.follower.missed:
            self.follower.at_end = False
        else:
            self.follower.reset()
            self.plan = None
        return self._take_plan()

    @on(topics.PLAN)
    def new_plan(self, path: Path) -> Out:
        self.path = path
        return self._take_plan()

    def _take_plan(self) -> Out:
        path = self.path
        if path is not None and self.goal is not None and path.goal_id == self.goal.id and len(path.xs):
            plan = LocalPlan(path.xs, path.ys, float(path.yaws[-1]))
            if self.plan is None or not plan.same_as(self.plan):
                self.plan = plan
        return ()

    @every(hz=20, after=topics.SCAN)
    def tick(self) -> Out:
        n_elapsed = round((self.now - self.last_tick) / (DT * S)) if self.last_tick else 0
        self.last_tick = self.now
        outcome = self._outcome(n_elapsed)
        outcome = outcome._replace(w=self.robot.drive.bent(outcome.v, outcome.w))
        self.commands.append(Command(self.now, outcome.v, outcome.w))
        yield topics.CMD_NAV(Velocity(self.now, outcome.v, outcome.w, outcome.reason))
        goal_id = self.goal.id if self.goal is not None else 0
        yield topics.FOLLOW(FollowStatus(self.now, goal_id, outcome.state, outcome.reason, outcome.left))
        if self.view.due(self.now) and self.inputs.history:
            seen = deepcopy(self.costmap)  # looking at it changes it, and being watched must not change the drive
            self._look_around(seen)
            yield topics.COSTMAP(self.view.costmap(self.now, seen, self.footprint))
            rollouts = self.view.rollouts(self.now, self.follower.controller, self.acting)
            if rollouts is not None:
                yield topics.ROLLOUTS(rollouts)

    @answer(requests.WATCH)
    def watch(self, request: Watch) -> Answer[Reply]:
        self.view.watch(self.now, request.seconds)
        yield from ()
        return Reply(self.now, True, "", "")

    def _outcome(self, n_elapsed: int) -> Outcome:
        goal = self.goal
        if goal is None or goal.kind is GoalKind.NONE:
            return Outcome(0.0, 0.0, FollowState.IDLE)
        stop = self.inputs.missing(self.now, self.rejections)
        if stop is None and goal.kind is GoalKind.DRIVE:
            stop = self.inputs.lost(self.now)
        if stop is not None:
            self.follower.reset()
            return Outcome(0.0, 0.0, FollowState.BLOCKED, stop.code)
        motion = self.acting = self._motion_when_acting()
        self._look_around(self.costmap)
        if goal.kind is not GoalKind.DRIVE:
            if self.manoeuvre is None:
                self.manoeuvre = Manoeuvre(goal, motion.pose, self.now, self.config.manoeuvres)
            limits = self.limits
            if self.inputs.pose is not None:
                limits = self.zones.limited(limits, np.empty((0, 2)), motion, self.inputs.odom_from_map)
            return self.manoeuvre.step(self.costmap, motion, limits, self.footprint, self.now)
        if (reason := self._no_plan(goal)) is not None or self.plan is None:
            self.follower.reset()
            code = reason or reasons.NO_PLAN.code
            return braking(motion, self.limits, FollowState.BLOCKED, code)
        outcome = self.follower.follow(self.plan, goal, self.costmap, motion, self.inputs.odom_from_map, n_elapsed)
        if outcome.state in (FollowState.ARRIVED, FollowState.FAILED) and not self._is_for(goal):
            self.follower.missed = False
            outcome = outcome._replace(state=FollowState.FOLLOWING, reason="")  # that is the goal before
        return outcome

    def _is_for(self, goal: Goal) -> bool:
        """Whether the last plan that came is this goal's: else that of the goal before leads on for a moment."""
        return self.path is not None and self.path.goal_id == goal.id

    def _no_plan(self, goal: Goal) -> str | None:
        """Why there is no plan to follow, as a code of reasons.py, or None."""
        reason = self._unfit(self.path)
        if self._is_for(goal):
            return reason
        waits = self.plan is not None and self.now - self.goal_since < self.config.ages.plan_for_new_goal * S
        return None if waits and reason is None else reasons.NO_PLAN.code

    def _unfit(self, path: Path | None) -> str | None:
        """Why the plan, whosever it is, is none to follow, as a code of reasons.py, or None."""
        if path is None:
            return reasons.NO_PLAN.code
        if abs(self.now - path.stamp) > self.config.ages.plan * S:
            return reasons.PLAN_OLD.code
        if path.stamp < self.inputs.jumped_at:
            return reasons.POSE_JUMPED.code
        return path.reason or (None if len(path.xs) else reasons.NO_PLAN.code)

    def _motion_when_acting(self) -> Motion:
        """Odometry carried on to the time at which a command sent now will act."""
        latency = int(self.config.latency * S)
        since = self.inputs.history[-1].stamp
        return predicted(self.motion, self.limits, list(self.commands), since, self.now + latency, latency)

    def _look_around(self, costmap: LocalCostmap) -> None:
        here = self.inputs.history[-1].odom_from_base
        costmap.recentre(here.x, here.y)
        if self.inputs.pose is not None:
            costmap.lay(self.grid, self.inputs.odom_from_map)
            window = costmap.x0, costmap.y0, costmap.resolution, len(costmap.field)
            costmap.forbidden = self.zones.forbidden(self.inputs.odom_from_map, here, window)
        else:
            costmap.lay(OccupancyGrid(), Pose2())
            costmap.forbidden = None
        costmap.refresh(self.now, here, self.footprint)

    def warm(self) -> None:
        """Drives others through everything once, with every controller: the kernels are compiled for all."""
        for controller in CONTROLLERS:
            self._rehearse(LocalCtrlService(self.config.model_copy(update={"controller": controller}), self.robot))

    def _rehearse(self, other: "LocalCtrlService") -> None:
        other.now = rehearsal.NOW
        list(other.odometry(rehearsal.odometry(rehearsal.NOW - S // 10)))
        list(other.odometry(rehearsal.odometry(rehearsal.NOW)))
        list(other.scan(rehearsal.scan(self.robot.laser)))
        list(other.ranges(rehearsal.readings(len(self.robot.ranges))))
        list(other.pose(rehearsal.pose()))
        list(other.map(rehearsal.map_update()))
        list(other.new_zones(rehearsal.zones()))
        for goal_id, x in enumerate((1.0, -1.0)):  # ahead: follow; behind: turn on the spot
            list(other.new_goal(rehearsal.goal(goal_id, GoalKind.DRIVE)))
            list(other.new_plan(rehearsal.path(goal_id, x)))
            list(other.tick())
        for kind in (GoalKind.BACK_UP, GoalKind.TURN):
            list(other.new_goal(rehearsal.goal(2, kind, amount=0.3)))
            list(other.tick())

    def state(self) -> str:
        return "idle" if self.goal is None else str(self.goal.kind)
