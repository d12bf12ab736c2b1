# SPDX-License-Identifier: Apache-2.0
"""A navigator with a clock, and others that answer it: a planner that draws straight lines, a robot that slides."""

from itertools import pairwise
from math import atan2, hypot

import numpy as np

from services.navigator.config import NavigatorConfig
from services.navigator.service import NavigatorService
from shared import topics
from shared.config import load_robot
from shared.geometry import Pose2
from shared.grid import OccupancyGrid
from shared.messages import (
    ExplorationShare,
    FollowState,
    FollowStatus,
    Goal,
    GuardState,
    GuardStatus,
    Localization,
    NavStatus,
    NavTask,
    Odometry,
    Path,
    PoseEstimate,
    Recovery,
)
from shared.requests import Cancel, Explore, Navigate, Pause, Reply
from shared.service import Job
from tests.strategies import faults

S = 1_000_000_000
STEP = 0.05  # s
X80 = load_robot("x80sv").robot
COVARIANCE = np.zeros(9)


class NavigatorBench:
    """Steps of 50 ms. What the planner, local control and the guard say can be set between them."""

    def __init__(self, config=None, speed=0.5, name="x80sv"):
        self.navigator = NavigatorService(config or NavigatorConfig(), X80.model_copy(update={"name": name}))
        self.now = 1000 * S
        self.pose, self.speed, self.moved = Pose2(), speed, 0.0
        self.orders: list[Goal | Recovery] = []
        self.statuses: list[NavStatus] = []
        self.tasks: list[NavTask] = []
        self.shares: list[ExplorationShare] = []
        self.others_map = OccupancyGrid()  # as planner and traffic have it
        self.jobs: list[tuple[int, Job]] = []
        self.refusal = ""  # the planner's
        self.follow_state: FollowState | None = None  # instead of what it would be
        self.follow_reason = ""
        self.guard: GuardStatus | None = None
        self.localization = Localization.GOOD
        self.map_from_odom = Pose2()
        self.silent: set[str] = set()
        self.n_steps = 0

    @property
    def goal(self):
        """The last goal; None while the robot recovers."""
        return self.orders[-1] if self.orders and isinstance(self.orders[-1], Goal) else None

    @property
    def goals(self):
        return [order for order in self.orders if isinstance(order, Goal)]

    @property
    def recoveries(self):
        return [order for order in self.orders if isinstance(order, Recovery)]

    @property
    def status(self):
        return self.statuses[-1]

    def take(self, effects):
        for effect in effects:
            if isinstance(effect, Job):
                self.jobs.append((self.now + round(effect.takes * S), effect))
                continue
            assert list(faults(effect.message)) == []
            if effect.topic in (topics.GOAL, topics.RECOVERY):
                assert not self.orders or effect.message.id > self.orders[-1].id
                self.orders.append(effect.message)
            elif effect.topic is topics.TASK:
                self.tasks.append(effect.message)
            elif effect.topic is topics.SHARE:
                self.shares.append(effect.message)
            elif effect.topic is topics.OTHERS_MAP:
                self.others_map.apply(effect.message)
            else:
                self.statuses.append(effect.message)

    def call(self, method, *arguments):
        self.navigator.now = self.now
        self.take(getattr(self.navigator, method)(*arguments))

    def ask(self, method, request) -> Reply:
        self.navigator.now = self.now
        answer = getattr(self.navigator, method)(request)
        while True:
            try:
                self.take([next(answer)])
            except StopIteration as stop:
                return stop.value

    def go(self, *poses, dwell=0.0, loops=1, any_heading=False):
        return self.ask("navigate", Navigate(self.now, poses, dwell, loops, any_heading))

    def explore(self, *others, common_from_map=None):
        return self.ask("explore", Explore(self.now, others, common_from_map or Pose2()))

    def cancel(self):
        return self.ask("cancel", Cancel(self.now))

    def pause(self, paused=True):
        return self.ask("pause", Pause(self.now, paused))

    def guarded(self, state, reason="", source="nav"):
        self.guard = GuardStatus(self.now, state, source, reason, "", 0.5)

    def path(self) -> Path:
        """The planner's answer to the present goal: a straight line."""
        goal = self.goal.map_from_goal
        n = max(int(self.pose.distance(goal) / 0.05), 1)
        xs, ys = np.linspace(self.pose.x, goal.x, n + 1), np.linspace(self.pose.y, goal.y, n + 1)
        if self.refusal:
            xs = ys = np.empty(0)
        length = self.pose.distance(goal) if not self.refusal else 0.0
        return Path(self.now, self.goal.id, 1, self.refusal, xs, ys, np.zeros(len(xs)), length, length)

    def drive(self, path: Path) -> tuple[FollowState, float]:
        """Moves the robot along the path; what local control says, and m left."""
        if not len(path.xs):
            return FollowState.BLOCKED, 0.0
        near = int(np.argmin(np.hypot(path.xs - self.pose.x, path.ys - self.pose.y)))
        points = list(zip(path.xs[near:], path.ys[near:]))
        left = sum(hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(points))
        if hypot(path.xs[-1] - self.pose.x, path.ys[-1] - self.pose.y) <= self.goal.tolerance:
            return FollowState.ARRIVED, left
        x, y = map(float, points[min(2, len(points) - 1)])
        away = hypot(x - self.pose.x, y - self.pose.y)
        step = min(self.speed * STEP, away)
        if away > 0:
            share = step / away
            yaw = atan2(y - self.pose.y, x - self.pose.x)
            self.pose = Pose2(self.pose.x + share * (x - self.pose.x), self.pose.y + share * (y - self.pose.y), yaw)
            self.moved += step
        return FollowState.FOLLOWING, left

    def act(self) -> FollowState:
        """Local control without an active goal: a recovery is done after a second."""
        if self.goal is not None:
            return FollowState.IDLE
        return FollowState.ARRIVED if self.now - self.orders[-1].stamp >= S else FollowState.FOLLOWING

    def jump(self, correction: Pose2):
        """The mapper finds out that the robot is elsewhere."""
        self.map_from_odom = correction @ self.map_from_odom
        self.pose = correction @ self.pose

    def step(self):
        self.now += round(STEP * S)
        self.n_steps += 1
        for due, job in [j for j in self.jobs if j[0] <= self.now]:
            self.jobs.remove((due, job))
            self.call(job.done, job.function(*job.arguments))
        if "odom" not in self.silent:
            odom_from_base = self.map_from_odom.inverse() @ self.pose
            self.call("odometry", Odometry(self.now, odom_from_base, self.speed, 0.0, COVARIANCE))
        if self.n_steps % 2 == 0 and "pose" not in self.silent:
            pose = PoseEstimate(self.now, self.pose, self.map_from_odom, COVARIANCE, 1.0, self.localization)
            self.call("pose", pose)
        if self.guard is not None:
            self.call("guard", self.guard)
        if self.orders:
            state, left = self.act(), 0.0
            if self.goal is not None and self.goal.active:
                path = self.path()
                if "plan" not in self.silent:
                    self.call("plan", path)
                if self.follow_state is None:
                    state, left = self.drive(path)
                else:
                    state, left = self.follow_state, path.length
            if "follow" not in self.silent:
                self.call("follow", FollowStatus(self.now, self.orders[-1].id, state, self.follow_reason, left))
        if self.n_steps % 4 == 0:
            self.call("tick")

    def run(self, seconds, until=None):
        """Steps for so long, or until the status has one of these states; returns the s that it took."""
        begun = self.now
        while self.now - begun < seconds * S:
            self.step()
            if until and self.statuses and self.status.state in until:
                break
        return (self.now - begun) / S


def stopped(bench):
    """Whether the navigator wants the robot to stand."""
    return bench.goal is not None and not bench.goal.active


OK = GuardState.ACTIVE
