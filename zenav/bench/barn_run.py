# SPDX-License-Identifier: Apache-2.0
"""One drive through a BARN world, or a crowd, by the challenge's rule: the whole stack in lockstep, without a map."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from math import hypot, inf
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from services.sim.crowd import RADIUS, crowd_world
from services.sim.world_loader import CylinderFile, CylinderWorld
from shared import messages as m
from shared import requests, topics
from shared.config import Robot, RobotFile, configured
from shared.geometry import Pose2
from shared.messages import FollowStatus, GuardStatus, Message, NavState, NavStatus, Truth
from shared.polygon import signed_distances
from shared.recording import CONFIG, Writer, about, sink
from shared.runners.host import Sent
from shared.runners.lockstep import START, Lockstep
from shared.service import Service
from shared.types import Float64s
from zenav.metrics.barn import BarnCourse, BarnResult
from zenav.scenario.lockstep_run import RECORDER
from zenav.stack.config_report import read_sections
from zenav.stack.hardware import Hardware, services_for, settings_for
from zenav.stack.service_loader import build_service

POLL = 0.1  # s of simulated time between two looks at the true position
LEFT_START = 0.1  # m off the start at which the clock starts
FREE_TIME = 30.0  # s that a robot may stand at the start
GOAL_RADIUS, TIME_LIMIT = 1.0, 100.0  # m, s: of a crowd, as in the file of worlds
STANDS = 0.05  # m/s and rad/s: a slower robot counts as standing at a contact
BEFORE = 10  # truths, 0.2 s, before a touch in which it is looked whether the robot stood
READY = 1.0  # s until the goal is sent; and again where the stack is not ready yet
FINE = 4  # parts of a truth's 20 ms in which the clearance is looked at


class BarnWorld(CylinderWorld):
    """One world, with the length of its reference path."""

    optimal_length_m: float = Field(gt=0)


class BarnFile(CylinderFile):
    """The BARN data set as it is kept here."""

    goal_radius_m: float = Field(gt=0)
    time_limit_s: float = Field(gt=0)
    worlds: dict[str, BarnWorld]  # type: ignore[assignment]  # narrower: read only


@dataclass(frozen=True, slots=True)
class BarnTrial:
    """What is run. settings: as for `--set`; delay: s that every command to the motors comes later."""

    course: BarnCourse
    seed: int
    robot: str
    settings: tuple[str, ...] = ()
    delay: float = 0.0


def course_of(path: Path, file: BarnFile, world: str) -> BarnCourse:
    """A world of the file that was read from `path`."""
    places = np.array(file.worlds[world].cylinders, float).reshape(-1, 2)
    return BarnCourse(
        world=world,
        place=f"barn:{world}",
        file=str(path),
        cylinders=np.column_stack((places, np.full(len(places), file.cylinder_radius_m))),
        start=Pose2(*file.start),
        goal=file.goal,
        goal_radius=file.goal_radius_m,
        time_limit=file.time_limit_s,
        optimal_length=file.worlds[world].optimal_length_m,
    )


def crowd_course(number: str) -> BarnCourse:
    """A made-up crowd: across a square of 20 m, by the same rule."""
    world = crowd_world(int(number))
    goal = world.goals["goal"]
    length = world.start.distance(goal)
    return BarnCourse(
        world=number,
        place=f"crowd:{number}",
        file="",
        cylinders=world.circles,
        start=world.start,
        goal=(goal.x, goal.y),
        goal_radius=GOAL_RADIUS,
        time_limit=TIME_LIMIT,
        optimal_length=length,
        walkers=RADIUS,
    )


def barn_robot_file(trial: BarnTrial) -> RobotFile:
    """The robot in its world. Raises UserError where a setting is wrong."""
    settings = [f"sim.world={trial.course.place}", f"sim.barn_file={json.dumps(trial.course.file)}"]
    settings += [f"sim.seed={trial.seed}", "sim.people_react=false", *trial.settings]
    file = configured(trial.robot, settings)
    file = configured(trial.robot, settings + settings_for(Hardware.MESSAGES, file, None))
    read_sections(file)
    return file


def run_barn(trial: BarnTrial, record: Path | None = None) -> BarnResult:
    """Drives to the goal, or until the rule ends it; `record`: the MCAP file that replays it."""
    file = barn_robot_file(trial)
    names = [name for name in services_for(Hardware.MESSAGES, file) if name != RECORDER]
    services: dict[str, Service] = {name: build_service(name, file, file.robot) for name in names}
    if record is None:
        return Referee(trial.course, file.robot, Lockstep(services), trial.delay).result()
    with Writer(record, about(file.robot.name), {CONFIG: file.text.encode()}) as writer:
        return Referee(trial.course, file.robot, Lockstep(services, sink(writer)), trial.delay).result()


class Referee:
    """Sends the goal, polls the true position, ends the run. delay: s between a motor command and its arrival."""

    def __init__(self, course: BarnCourse, robot: Robot, lockstep: Lockstep, delay: float = 0.0) -> None:
        self.course, self.robot, self.lockstep = course, robot, lockstep
        self.rows: list[tuple[float, ...]] = []
        self.walkers: list[Float64s] = []  # (p, 2) m, one a row
        self.newest: dict[type[Message], Any] = {}
        self.goal_accepted = False
        if delay:
            lockstep.filters.append(_wire_delays(delay))
        lockstep.watch(topics.TRUTH.key, self._moved)
        for topic in (topics.PLAN, topics.NAV_STATUS, topics.FOLLOW, topics.GUARD):
            lockstep.watch(topic.key, self._heard)

    def _heard(self, message: Message) -> None:
        self.newest[type(message)] = message

    def _moved(self, truth: Truth) -> None:
        self._heard(truth)
        at = truth.world_from_base
        self.rows.append(((truth.stamp - START) / 1e9, at.x, at.y, at.yaw, truth.v, truth.w))
        self.walkers.append(np.column_stack((truth.people_x, truth.people_y)).astype(float))

    def result(self) -> BarnResult:
        """The whole run."""
        course, lockstep = self.course, self.lockstep
        lockstep.run(READY)
        self._tell()
        begun, clock, status, time = len(self.rows) - 1, 0, "", 0.0
        deadline = lockstep.now + round(FREE_TIME * 1e9)
        while not status:
            lockstep.run(POLL, self._touched)
            at = self.truth.world_from_base
            if not clock and at.distance(course.start) >= LEFT_START:
                clock = lockstep.now
            time = (lockstep.now - clock) / 1e9 if clock else 0.0
            if self._touched():
                status = "collision"
            elif hypot(at.x - course.goal[0], at.y - course.goal[1]) <= course.goal_radius:
                status = "success"
            elif time >= course.time_limit or (not clock and lockstep.now >= deadline):
                status, time = "timeout", course.time_limit
            elif not self.goal_accepted:
                self._tell()
        lockstep.flush()
        rows, walkers = np.array(self.rows[begun:]), np.array(self.walkers[begun:])
        rows[:, 0] -= rows[0, 0]
        corners = self.robot.corners
        clearance = smallest_clearance(rows[:, 1:4], course.cylinders, corners)
        clearance = min(clearance, smallest_gap(rows[:, 1:4], walkers, corners) - course.walkers)
        nav = self.newest.get(NavStatus)
        # the touch stops the robot: how it drove is to be seen a moment earlier
        stood = status == "collision" and bool((np.abs(rows[-BEFORE:, 4:]) < STANDS).all())
        return BarnResult(
            course=course,
            robot=self.robot,
            status=status,
            time=round(time, 3),
            clearance=0.0 if status == "collision" else clearance,
            rows=rows,
            plan=self._plan(),
            n_recoveries=nav.n_recoveries if nav else 0,
            why=self._why(),
            stood=stood,
            walkers=walkers[-1],
        )

    @property
    def truth(self) -> Truth:
        truth: Truth = self.newest[Truth]
        return truth

    def _touched(self) -> bool:
        return self.truth.n_contacts > 0

    def _tell(self) -> None:
        """The goal, in the frame whose origin is the start."""
        goal = self.course.start.inverse() @ Pose2(*self.course.goal, self.course.start.yaw)
        request = requests.Navigate(self.lockstep.now, (Pose2(goal.x, goal.y),), 0.0, 1, True)
        self.goal_accepted = self.lockstep.ask(requests.NAVIGATE, request).accepted

    def _plan(self) -> Float64s:
        plan = self.newest.get(m.Path)
        return self.course.start @ np.column_stack((plan.xs, plan.ys)) if plan is not None else np.empty((0, 2))

    def _why(self) -> str:
        """What navigator, local control and guard said last."""
        nav, follow, guard = (self.newest.get(kind) for kind in (NavStatus, FollowStatus, GuardStatus))
        states = [
            f"{name} {message.state} {message.reason}".strip()
            for name, message in (("navigator", nav), ("local_ctrl", follow), ("guard", guard))
            if message is not None
        ]
        if nav is not None and nav.state is NavState.FAILED and nav.detail:
            states.append(nav.detail)
        return ", ".join(states)


def _wire_delays(delay: float) -> Callable[[Sent, str], float]:
    """The delays of a wire, s: motor commands arrive `delay` later, all else at once."""
    return lambda sent, _: delay if sent.topic is topics.MOTORS else 0.0


def smallest_clearance(poses: Float64s, cylinders: Float64s, corners: Float64s) -> float:
    """m between the outline and the nearest cylinder on the way through poses (n, 3), by exact geometry.

    cylinders: (k, 3) x, y, radius.  corners: (c, 2) m in `base`.
    """
    steps = np.arange(FINE) / FINE
    turn = (np.diff(poses[:, 2]) + np.pi) % (2 * np.pi) - np.pi
    x, y = ((a[:-1, None] + np.diff(a)[:, None] * steps).ravel() for a in (poses[:, 0], poses[:, 1]))
    yaw = (poses[:-1, 2][:, None] + turn[:, None] * steps).ravel()
    x, y, yaw = np.append(x, poses[-1, 0]), np.append(y, poses[-1, 1]), np.append(yaw, poses[-1, 2])
    reach = float(np.hypot(*corners.T).max())
    c, s = np.cos(yaw), np.sin(yaw)
    clearance = inf
    for cx, cy, radius in cylinders:
        dx, dy = cx - x, cy - y
        near = np.hypot(dx, dy) - radius - reach < clearance
        if near.any():
            points = np.column_stack((c * dx + s * dy, c * dy - s * dx))[near]
            clearance = min(clearance, max(float(signed_distances(corners, points).min()), 0.0) - radius)
    return clearance


def smallest_gap(poses: Float64s, walkers: Float64s, corners: Float64s) -> float:
    """m between the outline and the nearest of walkers (n, p, 2) at poses (n, 3); inf without walkers."""
    if not walkers.size:
        return inf
    away = walkers - poses[:, None, :2]
    c, s = np.cos(poses[:, 2])[:, None], np.sin(poses[:, 2])[:, None]
    x, y = c * away[..., 0] + s * away[..., 1], c * away[..., 1] - s * away[..., 0]
    return max(float(signed_distances(corners, np.column_stack((x.ravel(), y.ravel()))).min()), 0.0)
