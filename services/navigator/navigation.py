# SPDX-License-Identifier: Apache-2.0
"""The state machine of the navigator: one task at a time. A clock ends each state but a pause and a wait for robots."""

from math import inf

from services.navigator.config import NavigatorConfig
from services.navigator.exploration import Exploration, missing_input
from services.navigator.frontiers import FrontierConfig, Frontiers, Snapshot, find_frontiers
from services.navigator.goal_attempt import AttemptAction, GoalAttempt
from services.navigator.motion import SingleMotion
from services.navigator.recovery import RecoverySequence
from services.navigator.route import Route
from services.navigator.status_cache import StatusCache
from shared import reasons, topics
from shared.config import Robot
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import FollowState, FollowStatus, Goal, NavState, Recovery, RecoveryKind
from shared.orders import Order
from shared.pose_tracker import PoseTracker
from shared.reasons import Reason
from shared.service import Job, Out
from shared.zones import KeepOut, laid

_ANY_HEADING_RAD = 10.0  # rad of tolerance
_FINAL_REASONS = reasons.UNREACHABLE, reasons.START_BLOCKED, reasons.NO_ROOM_TO_TURN
_CANNOT = reasons.NO_REVERSE.code, reasons.NO_TURN_IN_PLACE.code  # of a recovery that local control's limits forbid
_JUMP_SHOWN_S = 2.0  # s
_SEARCH_PERIOD_S = 0.5  # s
_SEARCH_TIMEOUT_S = 10.0  # s after which the answer of a search is not waited for any more


Task = Route | Exploration | SingleMotion


class Navigation:
    """The state of the task. Its methods yield publications and jobs."""

    def __init__(self, config: NavigatorConfig, robot: Robot) -> None:
        self.config, self.robot = config, robot
        self.grid, self.pose_tracker, self.statuses = OccupancyGrid(), PoseTracker(), StatusCache()
        self.keep_out = KeepOut(robot.circumscribed_radius)
        self.task: Task | None = None
        self.task_id = 0
        self.state = NavState.IDLE
        self.reason: Reason | None = None  # how the last task ended
        self.detail = ""
        self.order: Order | None = None  # the last one published
        self.attempt: GoalAttempt | None = None
        self.recoveries = self._new_recoveries()
        self.attempt_config = config.leg  # of the present task
        self.recovery = ""  # the name of the one that runs or was just made
        self.action = 0.0  # s left for it
        self.dwell = 0.0  # s left at the pose
        self.age = 0.0  # s of the task
        self.paused = False
        self.suspended = False  # stopped because the pose is lost
        self.lost = 0.0  # s
        self.jumped = 0.0  # s that it is still shown
        self.searching = inf  # s since a search for frontiers was asked for; inf: none is
        self.searched = inf  # s since the last one

    def configure(self, config: NavigatorConfig) -> None:
        """Takes settings, for the present task too."""
        self.config, self.attempt_config = config, config.leg
        self.recoveries.configure(config.recovery, self.robot.drive)
        if isinstance(self.task, Exploration):
            self.task.config = config.exploration
            self.attempt_config = config.leg.with_time_share(config.exploration.patience)

    # tasks

    def begin(self, task: Task, now: int) -> Out:
        """Begins a task in place of the present one. A moving robot continues to the new goal without a stop."""
        self.task_id += 1
        self._take(task)
        if isinstance(task, Route):
            yield from self._to_waypoint(task, now)
        elif isinstance(task, SingleMotion):
            yield self._recovery(now, task.kind, task.amount)
        else:
            yield self._standstill(now)

    def resume(self, task: Route | Exploration, dwell: float | None, paused: bool, now: int) -> Out:
        """Continues the task of a navigator before this one, under its number; recoveries start again.

        dwell: s left at the present pose of a route; None on the way to it.
        """
        self._take(task)
        self.paused = paused
        if isinstance(task, Route) and dwell is None:
            self.attempt = GoalAttempt(task.target, task.heading_free)
        self.dwell = dwell or 0.0
        if self.attempt and not paused:
            yield from self._drive(now, self.attempt)
        else:
            yield self._standstill(now)

    def _take(self, task: Task) -> None:
        explores = isinstance(task, Exploration)
        self.task, self.attempt, self.age = task, None, 0.0
        self.reason, self.detail = None, ""
        self.recoveries = self._new_recoveries()
        self.recovery, self.action, self.paused, self.suspended = "", 0.0, False, False
        self.configure(self.config)
        self.state, self.searched = NavState.EXPLORING if explores else NavState.NAVIGATING, inf

    def end(self, now: int, state: NavState, reason: Reason | None, detail: str = "") -> Out:
        """Ends the task and stops the robot."""
        self.task = self.attempt = None
        self.state, self.reason, self.detail = state, reason, detail
        self.recovery, self.action, self.paused, self.suspended = "", 0.0, False, False
        yield self._standstill(now)

    def pause(self, now: int, paused: bool) -> Out:
        """Stops and keeps the task, or continues it."""
        if self.task is None or paused == self.paused:
            return
        self.paused, self.action, self.recovery = paused, 0.0, ""
        if paused:
            yield self._standstill(now)
        elif self.attempt and not self.suspended:
            self.attempt.reset_clocks()
            yield from self._drive(now, self.attempt)

    # events

    def on_follow_status(self, follow: FollowStatus, now: int) -> Out:
        """Takes local control's status: an arrival, or the end of a recovery."""
        if self.order is None or follow.goal_id != self.order.id or self.paused or self.attempt is None:
            return
        if self.action and follow.state is FollowState.FAILED and follow.reason in _CANNOT:
            yield from self._recover(self.attempt, self.recoveries.last, now)
        elif self.action and follow.state in (FollowState.ARRIVED, FollowState.FAILED):
            yield from self._drive(now, self.attempt)
        elif not self.action and (follow.state is FollowState.ARRIVED or self._passes(follow, self.attempt, now)):
            yield from self._arrived(now)

    def _passes(self, follow: FollowStatus, attempt: GoalAttempt, now: int) -> bool:
        """Whether the robot passes a pose of its route at which it need not stop."""
        pose, to_refuge = self.pose_tracker.map_from_base, follow.reason == reasons.GIVING_WAY.code
        under_way = follow.state is FollowState.FOLLOWING and not (self.suspended or to_refuge)
        if pose is None or self.order is None or not under_way or not isinstance(self.task, Route):
            return False
        if not self.task.passes:
            return False
        near = self.config.pass_within if self.task.pass_through else 0.0
        # for a moment local control follows the plan of the goal before, whose end may lie beside this pose
        left = max(follow.distance_left, self.statuses.left_by_plan(self.order, self.robot.drive.max_speed, now))
        return pose.distance(attempt.target) <= self.task.tolerance or left <= near

    def on_pose_jump(self, now: int) -> Out:
        """Sends the goal again after a jump of the pose, so that planning starts from the new pose."""
        self.jumped = _JUMP_SHOWN_S
        if self.attempt and not (self.action or self.paused or self.suspended):
            yield from self._drive(now, self.attempt, clear_costmap=True)

    def passed(self, seconds: float, now: int) -> Out:
        """Advances the clocks by `seconds` and the task with them."""
        if self.order is None:  # a goal of a navigator before this one is not supervised any more
            yield self._standstill(now)
        self.jumped = max(self.jumped - seconds, 0.0)
        self.lost = self.lost + seconds if self.pose_tracker.is_lost else 0.0
        self.searching += seconds
        self.searched += seconds
        self.age += seconds
        if self.task is None or self.paused:
            return
        if isinstance(self.task, SingleMotion):
            ending = self.task.ending(seconds, self.order, self.statuses, now)
            if ending is not None:
                yield from self.end(now, *ending)
            return
        yield from self._watch_pose(now)
        if isinstance(self.task, Exploration):
            yield from self._explore(self.task, seconds, now)
        if self.attempt and self.action:
            self.action = max(self.action - seconds, 0.0)
            if not self.action:
                yield from self._drive(now, self.attempt)
        elif self.attempt:
            yield from self._watch_attempt(self.attempt, seconds, now)
        elif isinstance(self.task, Route) and not self.suspended:
            self.dwell -= seconds
            if self.dwell <= 0:
                yield from self._next_waypoint(self.task, now)

    def frontiers_found(self, task_id: int, map_id: int, result: Frontiers, now: int) -> Out:
        """Takes the result of a search."""
        self.searching, self.searched = inf, 0.0
        exploration, pose = self.task, self.pose_tracker.map_from_base
        if not isinstance(exploration, Exploration) or (task_id, map_id) != (self.task_id, self.grid.map_id):
            return
        if pose is None or self.paused or self.suspended or self.action:
            return
        own, before = exploration.own_part(result, now), exploration.target
        target = exploration.choose_target(own, pose, self.grid.resolution)
        if target is None:
            if self.attempt:
                self.attempt = None
                yield self._standstill(now)
            yield from self._without_frontier(exploration, own, now)
        elif target is not before:
            exploration.without = 0.0
            frontier = target.frontier
            self.attempt = GoalAttempt(Pose2(frontier.x, frontier.y, frontier.yaw), any_heading=True)
            yield from self._drive(now, self.attempt)

    # driving

    def left(self, attempt: GoalAttempt, now: int) -> float:
        """Remaining m to the attempt's target: by local control, else by the planner, else straight."""
        if (goal := self.goal) is not None:
            follow, plan = self.statuses.follow_for(goal, now), self.statuses.plan_for(goal, now)
            if follow is not None and follow.state is FollowState.FOLLOWING:
                return max(follow.distance_left, 0.0)
            if plan is not None and not plan.reason:
                return plan.length
        pose = self.pose_tracker.map_from_base
        return pose.distance(attempt.target) if pose else 0.0

    def _watch_pose(self, now: int) -> Out:
        if self.lost > self.config.lost_time and not self.suspended:
            self.suspended, self.action = True, 0.0
            yield self._standstill(now)
        elif self.suspended and not self.pose_tracker.is_lost:
            self.suspended = False
            if self.attempt:
                yield from self._drive(now, self.attempt, clear_costmap=True)
        elif (
            self.suspended and self.attempt is None and self.lost > self.config.leg.hold_time
        ):  # with an attempt its own clock counts
            yield from self.end(now, NavState.FAILED, reasons.POSE_LOST)

    def _watch_attempt(self, attempt: GoalAttempt, seconds: float, now: int) -> Out:
        assert self.order is not None  # an attempt has published one
        plan, follow = self.statuses.plan_for(self.order, now), self.statuses.follow_for(self.order, now)
        hold_reason = reasons.POSE_LOST if self.suspended else self.statuses.hold_reason(now)
        if hold_reason:
            attempt.add_hold_time(seconds, hold_reason)
        else:
            attempt.update(seconds, self.left(attempt, now), plan, follow, self.attempt_config.progress)
            if attempt.has_progressed:
                self.recovery = ""
            if pose := self.pose_tracker.map_from_base:
                self.recoveries.progressed(pose, attempt.gained)
        contact = self.statuses.contact_reason(self.order, now)
        next_action = attempt.next_action(plan, follow, self.attempt_config)
        verdict, reason = (AttemptAction.RECOVER, contact) if contact else next_action
        if verdict is AttemptAction.RECOVER:
            yield from self._recover(attempt, reason, now)
        elif verdict is AttemptAction.FAIL:
            yield from self._give_up(reason, now, whole=hold_reason is not None)

    def _recover(self, attempt: GoalAttempt, reason: Reason, now: int) -> Out:
        explores = isinstance(self.task, Exploration)
        hopeless = reason in (reasons.UNREACHABLE, reasons.NO_WAY_THROUGH)
        if explores and (hopeless or attempt.n_recoveries >= self.config.exploration.max_recoveries):
            yield from self._give_up(reason, now, whole=False)
            return
        step = self.recoveries.next(reason, self.pose_tracker.map_from_base)
        if step is None and explores:
            yield from self._give_up(reason, now, whole=False)
            return
        if step is None:
            named = reason if reason in _FINAL_REASONS else reasons.RECOVERIES_USED
            yield from self.end(now, NavState.FAILED, named, f"{named.text}; the last cause: {reason.text}")
            return
        attempt.n_recoveries += 1
        attempt.reset_clocks()
        self.recovery = step.name
        if step.kind is not None:
            self.action = step.takes
            yield self._recovery(now, step.kind, step.amount)
        else:
            yield from self._drive(now, attempt, step.clear_costmap)

    def _give_up(self, reason: Reason, now: int, whole: bool) -> Out:
        """Ends the attempt as hopeless. whole: the task as well, although it explores and other frontiers may exist."""
        if isinstance(self.task, Exploration) and not whole:
            self.task.failed(self.grid.resolution, reason)
            self.task.without = 0.0
            self.attempt, self.recovery = None, ""
            yield self._standstill(now)
        else:
            yield from self.end(now, NavState.FAILED, reason)

    def _arrived(self, now: int) -> Out:
        self.attempt, self.recovery = None, ""
        if isinstance(self.task, Exploration):
            self.task.arrived()
            self.searched = inf
        elif isinstance(self.task, Route) and self.task.dwell > 0:
            self.dwell = self.task.dwell
            yield self._standstill(now)
        elif isinstance(self.task, Route):
            yield from self._next_waypoint(self.task, now)

    def _next_waypoint(self, route: Route, now: int) -> Out:
        if route.advance():
            yield from self._to_waypoint(route, now)
        else:
            yield from self.end(now, NavState.REACHED, None)

    def _to_waypoint(self, route: Route, now: int) -> Out:
        self.attempt = GoalAttempt(route.target, route.heading_free)
        yield from self._drive(now, self.attempt)

    def _drive(self, now: int, attempt: GoalAttempt, clear_costmap: bool = False) -> Out:
        self.action = 0.0
        yield self._publication(now, attempt.target, clear_costmap)

    @property
    def goal(self) -> Goal | None:
        """The goal that the robot drives to; None while it stands or recovers."""
        return self.order if isinstance(self.order, Goal) and self.order.active else None

    def _standstill(self, now: int) -> topics.Publication:
        return self._publication(now, None)

    def _publication(self, now: int, target: Pose2 | None, clear_costmap: bool = False) -> topics.Publication:
        """A new goal; without a target the robot stands."""
        tolerance, yaw_tolerance = self._tolerances()
        goal = self.order = Goal(
            stamp=now,
            id=self._next_id(now),
            active=target is not None,
            map_from_goal=target or Pose2(),
            tolerance=tolerance,
            yaw_tolerance=yaw_tolerance,
            clear_costmap=clear_costmap,
        )
        return topics.GOAL(goal)

    def _recovery(self, now: int, kind: RecoveryKind, amount: float) -> topics.Publication:
        recovery = self.order = Recovery(stamp=now, id=self._next_id(now), kind=kind, amount=amount)
        return topics.RECOVERY(recovery)

    def _next_id(self, now: int) -> int:
        """Of goals and recoveries. Numbers from the clock are larger than those of a navigator before a restart."""
        return max(self.order.id + 1 if self.order else 1, now // 1_000_000)

    def _tolerances(self) -> tuple[float, float]:
        """m and rad to a pose of the task at which it is reached."""
        if isinstance(self.task, Route):
            aligned = self.attempt is not None and not self.attempt.any_heading
            return self.task.tolerance, self.task.yaw_tolerance if aligned else _ANY_HEADING_RAD
        return self.config.exploration.tolerance if self.task else self.config.tolerance, _ANY_HEADING_RAD

    def _new_recoveries(self) -> RecoverySequence:
        return RecoverySequence(self.config.recovery, self.robot.drive)

    # exploring

    def _explore(self, exploration: Exploration, seconds: float, now: int) -> Out:
        pose, grid = self.pose_tracker.map_from_base, self.grid
        if pose is not None:
            exploration.passed(seconds, pose)
        if self.attempt is None:
            exploration.without += seconds
        missing = missing_input(grid, pose)
        if pose is None or missing is not None:
            if exploration.without > self.config.leg.start_time:
                yield from self.end(now, NavState.FAILED, missing)
            return
        due = self.searched >= _SEARCH_PERIOD_S and self.searching >= _SEARCH_TIMEOUT_S
        if due and not (self.action or self.suspended):
            self.keep_out.moved(pose)
            known = exploration.known_map(grid)
            cells = laid(known, self.keep_out.holding)  # keep-out zones are not explored
            snapshot = exploration.snapshot(known, cells, pose, self.robot.inscribed_radius, now)
            self.searching = 0.0
            arguments = self.task_id, grid.map_id, snapshot, self.config.exploration.frontier
            yield Job(search, arguments, done="frontiers_found", takes=0.05)

    def _without_frontier(self, exploration: Exploration, result: Frontiers, now: int) -> Out:
        config = self.config.exploration
        uncertain = result.enclosed or bool(result.unreachable)
        settled = exploration.without >= (config.blocked_time if uncertain else config.settle_time)
        if exploration.sharing is not None and exploration.sharing.waits(settled, now):
            return
        if not settled:
            return
        if exploration.retry_failed():
            exploration.without = 0.0
        elif result.enclosed:
            yield from self.end(now, NavState.FAILED, reasons.START_BLOCKED)
        elif self.recoveries.used_up and exploration.moved < self.config.recovery.earned_by:
            cause = f"{reasons.RECOVERIES_USED.text}; the last cause: {self.recoveries.last.text}"
            yield from self.end(now, NavState.FAILED, reasons.RECOVERIES_USED, cause)
        else:
            yield from self.end(now, NavState.REACHED, reasons.NO_FRONTIER, exploration.missed_text)


def search(task_id: int, map_id: int, snapshot: Snapshot, config: FrontierConfig) -> tuple[int, int, Frontiers]:
    """Job: the frontiers, with the task and the map that they were searched for."""
    return task_id, map_id, find_frontiers(snapshot, config)
