# SPDX-License-Identifier: Apache-2.0
"""`zenav fleet dispatch`: gives the queue's tasks to robots, and to another one where a robot fails.

Robots do not need it: what they drive they finish without it. Started again, it goes on with what the queue says.
"""

from collections.abc import Callable, Iterable
from contextlib import ExitStack, suppress
from dataclasses import replace

from shared import requests, topics
from shared.config import UserError
from shared.messages import GuardState, NavStatus
from shared.requests import Cancel, Navigate
from shared.robot_view import SILENT_S, RobotView
from shared.runners.transport import stack_address
from shared.task_state import FINAL_STATES
from zenav.client import Client
from zenav.client.navigation_client import accepted, navigate, task_result
from zenav.fleet.assignment import FreeRobot, WayLength, assignments, refusal
from zenav.fleet.task_queue import FleetTask, TaskQueue, TaskState

UNCLEAR_S = 10.0  # after which a task that no reply confirmed counts as not taken
SAME_GOAL_M = 1e-3


class Dispatcher:
    """See the module. Each `step` looks at the robots once.

    lost_after: s for which a robot may be silent or stopped with a task.
    """

    def __init__(
        self,
        queue: TaskQueue,
        link: "RobotLink",
        length: WayLength,
        say: Callable[[str], None],
        min_battery: float = 0.0,
        lost_after: float = 60.0,
    ) -> None:
        self._queue, self._link, self._length, self._say = queue, link, length, say
        self._min_battery, self._lost_after = min_battery, lost_after
        self._in_trouble: dict[int, float] = {}  # since when a task's robot is silent or stopped; s, monotonic

    def step(self, views: Iterable[RobotView], at: float, now: float) -> None:
        """Follows what is driven, and gives out what waits. at: s, monotonic.  now: s, wall clock."""
        by_place = {(view.name, view.stack): view for view in views}
        for task in self._queue.tasks(TaskState.DRIVING, TaskState.CANCELING):
            self._follow(task, by_place.get((task.robot, task.stack)), at, now)
        busy = {(task.robot, task.stack) for task in self._queue.tasks(TaskState.DRIVING, TaskState.CANCELING)}
        free = [_free(view) for where, view in by_place.items() if where not in busy and self._can(view, at)]
        for task, robot in assignments(self._queue.tasks(TaskState.WAITING), free, self._length, now):
            self._send(task, robot, now)

    def _can(self, view: RobotView, at: float) -> bool:
        return not refusal(view, at, self._min_battery)

    def _send(self, task: FleetTask, robot: FreeRobot, now: float) -> None:
        if not self._queue.assign(task, robot.name, robot.stack, robot.former_id, now):
            return  # it was canceled just now
        task = replace(task, robot=robot.name, stack=robot.stack, state=TaskState.DRIVING)
        self._say(f"task {task.id}, {task.text}: {robot.name} drives it")
        try:
            number = self._link.send(robot.name, robot.stack, navigate(list(task.targets), 0.0, 1))
        except NoLinkError as error:
            self._queue.unassign(task, error.what, now)
            self._say(f"task {task.id}, {task.text}: it waits again: {error.what}")
            return
        except UserError as error:
            self._give_up(task, error.what, now)
            return
        if number is not None:
            self._queue.accepted(task, number, now)

    def _follow(self, task: FleetTask, view: RobotView | None, at: float, now: float) -> None:
        nav = None if view is None or at - view.heard > SILENT_S else view.latest(topics.NAV_STATUS)
        guard = view.latest(topics.GUARD) if view is not None else None
        if nav is None or (guard is not None and guard.state is GuardState.STOPPED):
            since = self._in_trouble.setdefault(task.id, at)
            if at - since > self._lost_after:
                self._drop(task, "it is silent" if nav is None else "STOP is pressed", now)
            if nav is None:
                return
        else:
            self._in_trouble.pop(task.id, None)
        if task.navigator_id is None:
            self._adopt(task, nav, now)
            return
        if nav.task_id < task.navigator_id and now - task.changed <= UNCLEAR_S:
            return  # a status of before it was accepted
        end = task_result(nav, task.navigator_id)
        if end is not None and end.good:
            self._in_trouble.pop(task.id, None)
            self._queue.done(task, end.text, now)
            self._say(f"task {task.id}, {task.text}: done by {task.robot}")
        elif end is not None:
            self._give_up(task, end.text, now)
        elif task.state is TaskState.CANCELING:
            self._link.cancel(task.robot, task.stack)

    def _adopt(self, task: FleetTask, nav: NavStatus, now: float) -> None:
        """No reply came, or the dispatcher ended before it did: the robot's goal shows whether it drives the task."""
        is_ours = any(nav.goal.distance(pose) < SAME_GOAL_M for pose in navigate(list(task.targets), 0.0, 1).poses)
        if nav.task_id > task.former_id and nav.state not in FINAL_STATES and is_ours:
            self._queue.accepted(task, nav.task_id, now)
        elif now - task.changed > UNCLEAR_S:
            self._give_up(task, "it did not confirm the task", now)

    def _drop(self, task: FleetTask, why: str, now: float) -> None:
        """Gives the task to another robot, and takes it from this one if that still hears us."""
        self._link.cancel(task.robot, task.stack)
        self._give_up(task, f"{why} for {self._lost_after:.0f} s", now)

    def _give_up(self, task: FleetTask, why: str, now: float) -> None:
        self._in_trouble.pop(task.id, None)
        self._queue.gave_up(task, why, now)
        self._say(f"task {task.id}, {task.text}: {task.robot} did not do it: {why}")


class NoLinkError(UserError):
    """The robot's stack or its navigator cannot be reached, so it never got the request."""


class RobotLink:
    """Requests to robots by name and stack."""

    def send(self, name: str, stack: str, request: Navigate) -> int | None:
        """The navigator's number of the accepted task; None where no reply came.

        Raises UserError where it refuses, and NoLinkError where it was not asked.
        """
        with ExitStack() as session:
            try:
                client = session.enter_context(Client(name, stack_address(stack)))
            except UserError as error:
                raise NoLinkError(error.what, error.hint) from None
            if not client.answers(requests.NAVIGATE, 1.0):
                raise NoLinkError("its navigator is not there", "is it running? zenav fleet list shows its state")
            try:
                reply = client.ask(requests.NAVIGATE, replace(request, stamp=client.now()))
            except UserError:
                return None
            return accepted(reply).task_id

    def cancel(self, name: str, stack: str) -> None:
        """Asks the robot to drop its task; without a link or a reply nothing happens."""
        with suppress(UserError), Client(name, stack_address(stack)) as client:
            client.ask(requests.CANCEL, Cancel(client.now()))


def _free(view: RobotView) -> FreeRobot:
    nav, pose = view.latest(topics.NAV_STATUS), view.latest(topics.POSE)
    assert nav is not None  # as `refusal` says
    assert pose is not None
    return FreeRobot(view.name, view.stack, nav.task_id, pose.map_from_base.x, pose.map_from_base.y)
