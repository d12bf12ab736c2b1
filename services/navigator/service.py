# SPDX-License-Identifier: Apache-2.0
"""The navigator: poses, routes and exploration, with recoveries; the status gives the reason of each failure."""

from dataclasses import replace

from services.navigator.config import NavigatorConfig
from services.navigator.exploration import Exploration, warm_up_search
from services.navigator.frontiers import Frontiers
from services.navigator.goal_check import refused_pose
from services.navigator.motion import SingleMotion, refusal, straight, turn
from services.navigator.navigation import Navigation, Task
from services.navigator.others_map import warm_up_laying
from services.navigator.resumption import Resumption
from services.navigator.route import route_of
from services.navigator.share_publisher import SharePublisher
from services.navigator.shared_exploration import SharedExploration
from services.navigator.status_message import Speedometer, status
from services.navigator.zones import ActiveZones
from shared import reasons, requests, topics
from shared.config import Robot
from shared.messages import (
    MAX_ZONES,
    ExplorationShare,
    FollowStatus,
    GoalLimits,
    GuardState,
    GuardStatus,
    MapMode,
    MapUpdate,
    NavState,
    NavTask,
    Odometry,
    Path,
    PoseEstimate,
    RightOfWay,
    Zones,
)
from shared.requests import Cancel, DriveStraight, Explore, Navigate, Pause, Reply, SetZones, Spin
from shared.service import Answer, Log, Out, Service, answer, every, on
from shared.settings import Configuration
from shared.topics import Publication

_MAX_TICK_S = 1.0  # a longer step is a jump of the clock
_FIRST_TICK_S = 0.2  # s


class NavigatorService(Service):
    """Runs one task at a time; a new one replaces the old."""

    config_type = NavigatorConfig
    config: NavigatorConfig

    def __init__(self, config: NavigatorConfig, robot: Robot) -> None:
        super().__init__(config, robot)
        self.navigation = Navigation(config, robot)
        self.resumption, self.shares = Resumption(self.navigation), SharePublisher(self.navigation)
        self.zones = ActiveZones(config.zones)
        self.speedometer = Speedometer(robot.drive.max_speed / 2)
        self.limits: GoalLimits | None = None
        self.maps = True  # the map grows
        self.velocity = 0.0  # m/s
        self.ticked: int | None = None

    def warm_up(self) -> None:
        warm_up_search(self.config.exploration.frontier)
        warm_up_laying()

    def state(self) -> str:
        return str(self.navigation.state)

    def settings_changed(self, old: Configuration, new: Configuration) -> Out:
        """The present task takes them too, but for the tolerances of a route, which it began with."""
        self.navigation.configure(new.config)
        return ()

    @on(topics.MAP)
    def map(self, update: MapUpdate) -> Out:
        another = self.navigation.grid.map_id not in (0, update.map_id)
        self.navigation.grid.apply(update)
        if another and self.navigation.task:  # its poses belong to the former map
            yield from self.navigation.end(self.now, NavState.CANCELED, reasons.OTHER_MAP)
            yield from self.resumption.tell(self.now)

    @on(topics.ODOM, waits=True)
    def odometry(self, odometry: Odometry) -> Out:
        self.navigation.pose_tracker.add_odometry(odometry)
        self.velocity = odometry.v
        return ()

    @on(topics.POSE)
    def pose(self, estimate: PoseEstimate) -> Out:
        self.maps = estimate.mode is not MapMode.LOCALISE
        if self.navigation.pose_tracker.add_estimate(estimate):
            yield from self.navigation.on_pose_jump(self.now)

    @on(topics.PLAN)
    def plan(self, plan: Path) -> Out:
        self.navigation.statuses.add_plan(plan, self.now)
        return ()

    @on(topics.LIMITS)
    def goal_limits(self, limits: GoalLimits) -> Out:
        self.limits = limits
        return ()

    @on(topics.FOLLOW)
    def follow(self, follow: FollowStatus) -> Out:
        self.navigation.statuses.add_follow(follow, self.now)
        yield from self.navigation.on_follow_status(follow, self.now)
        yield from self.resumption.tell(self.now)

    @on(topics.GUARD)
    def guard(self, guard: GuardStatus) -> Out:
        self.navigation.statuses.add_guard(guard, self.now)
        stopped = self.navigation.statuses.stop_reason(self.now)
        if stopped and self.navigation.task:  # releasing the e-stop must not move the robot, so the task ends
            state = NavState.CANCELED if guard.state is GuardState.STOPPED else NavState.FAILED
            yield from self.navigation.end(self.now, state, stopped)
            yield from self.resumption.tell(self.now)

    @on(topics.RIGHT_OF_WAY)
    def right_of_way(self, told: RightOfWay) -> Out:
        self.navigation.statuses.add_right_of_way(told, self.now)
        return ()

    @on(topics.OTHERS_SHARE)
    def other_explorer(self, share: ExplorationShare) -> Out:
        self.shares.take(share, self.now)
        return ()

    @on(topics.TASK)
    def task_before_the_restart(self, task: NavTask) -> Out:
        self.resumption.remember(task, self.now)
        return ()

    @on(topics.SHARE)
    def share_before_the_restart(self, share: ExplorationShare) -> Out:
        self.resumption.share, self.shares.is_shown = share, True
        return ()

    @on(topics.ZONES)
    def zones_before_the_restart(self, zones: Zones) -> Out:
        if dropped := self.zones.remember(zones):
            detail = f"with the configuration's they are more than {MAX_ZONES}: {', '.join(dropped)} hold no more"
            yield Log("WARNING", f"zones: {detail}")

    @every(hz=5)
    def tick(self) -> Out:
        if not self.zones.is_published:
            yield self._zones()
        since = _FIRST_TICK_S if self.ticked is None else (self.now - self.ticked) * 1e-9
        seconds = min(max(since, 0.0), _MAX_TICK_S)
        self.ticked = self.now
        yield from self.resumption.take_up(self.now)
        if not self.resumption.pending:  # else its goal stays until its resumption is decided
            yield from self.navigation.passed(seconds, self.now)
        self.speedometer.passed(seconds, self.velocity)
        yield from self.shares.publish(self.now)
        yield from self._publish_status()

    def frontiers_found(self, result: tuple[int, int, Frontiers]) -> Out:
        yield from self.navigation.frontiers_found(*result, self.now)
        yield from self.resumption.tell(self.now)

    @answer(requests.NAVIGATE)
    def navigate(self, request: Navigate) -> Answer[Reply]:
        navigation, tolerance = self.navigation, request.tolerance or self.config.tolerance
        refused = refused_pose(
            poses=request.poses,
            grid=navigation.grid,
            limits=self.limits,
            inscribed_radius=self.robot.inscribed_radius,
            tolerance=tolerance,
            zones=self.zones.zones,
            map_grows=self.maps,
        )
        if refused is not None:
            return replace(self._reply(refused[0]), detail=refused[1])
        return (yield from self._begin(route_of(request, self.config)))

    @answer(requests.SET_ZONES)
    def set_zones(self, request: SetZones) -> Answer[Reply]:
        if not self.zones.set(request):
            detail = f"with those of the configuration they are more than {MAX_ZONES}"
            return replace(self._reply(reasons.BAD_REQUEST), detail=detail)
        yield self._zones()
        return self._reply(None)

    @answer(requests.EXPLORE)
    def explore(self, request: Explore) -> Answer[Reply]:
        exploration = self.config.exploration
        sharing = SharedExploration(exploration.sharing, self.robot.name, request.others, request.common_from_map)
        return (yield from self._begin(Exploration(exploration, sharing if request.others else None)))

    @answer(requests.SPIN)
    def spin(self, request: Spin) -> Answer[Reply]:
        return (yield from self._begin(turn(request.angle, request.seconds)))

    @answer(requests.DRIVE_STRAIGHT)
    def drive_straight(self, request: DriveStraight) -> Answer[Reply]:
        return (yield from self._begin(straight(request.distance, request.seconds)))

    @answer(requests.CANCEL)
    def cancel(self, request: Cancel) -> Answer[Reply]:
        if self.navigation.task or self.resumption.before:
            self.resumption.forget()
            yield from self.navigation.end(self.now, NavState.CANCELED, reasons.CANCELED)
            yield from self._publish_status()
        return self._reply(None)

    @answer(requests.PAUSE)
    def pause(self, request: Pause) -> Answer[Reply]:
        if before := self.resumption.before:
            self.resumption.before = replace(before, paused=request.paused)
        elif self.navigation.task is None:
            return self._reply(reasons.NO_COMMAND)
        elif isinstance(self.navigation.task, SingleMotion):
            return replace(self._reply(reasons.BAD_REQUEST), detail="a turn or straight drive is not paused: cancel it")
        yield from self.navigation.pause(self.now, request.paused)
        yield from self._publish_status()
        return self._reply(None)

    def _begin(self, task: Task) -> Answer[Reply]:
        unfit = refusal(task, self.robot.drive) if isinstance(task, SingleMotion) else None
        if refused := self.navigation.statuses.stop_reason(self.now) or unfit:
            return self._reply(refused)
        self.resumption.forget()
        yield from self.navigation.begin(task, self.now)
        yield from self._publish_status()
        return self._reply(None)

    def _reply(self, refusal_reason: reasons.Reason | None) -> Reply:
        why = f"{refusal_reason.text}: {refusal_reason.hint}" if refusal_reason else ""
        return Reply(
            self.now,
            refusal_reason is None,
            refusal_reason.code if refusal_reason else "",
            why,
            self.navigation.task_id,
        )

    def _zones(self) -> Publication:
        message = Zones(self.now, self.zones.zones)
        self.zones.is_published = True
        self.navigation.keep_out.take(message)
        return topics.ZONES(message)

    def _publish_status(self) -> Out:
        yield from self.resumption.tell(self.now)
        yield topics.NAV_STATUS(status(self.navigation, self.speedometer, self.now))
