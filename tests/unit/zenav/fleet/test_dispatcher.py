# SPDX-License-Identifier: Apache-2.0
"""The dispatcher with made-up robots: lost, stopped, refusing, taken over; and a dispatcher that was started again."""

from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pytest

from shared import sample_messages, topics
from shared.codec import Envelope
from shared.config import UserError
from shared.geometry import Pose2
from shared.messages import BaseStatus, GuardState, GuardStatus, Localization, NavState, NavStatus
from shared.robot_view import RobotView
from shared.runners import transport
from zenav.client.navigation_client import navigate
from zenav.fleet import dispatcher
from zenav.fleet.assignment import RETRY_S, straight
from zenav.fleet.dispatcher import UNCLEAR_S, Dispatcher, NoLinkError, RobotLink
from zenav.fleet.task_queue import TaskQueue, TaskState

LAB = (5.0, 0.0, None)
LOST_S = 60.0


class Robots:
    """Robots by name, their answers to a request, and what was sent to them."""

    def __init__(self, **places: float) -> None:
        self.views = {name: RobotView(name, "0") for name in places}
        self.n, self.at, self.sent, self.canceled = 0, 0.0, [], []
        self.answer = 7
        for name, x in places.items():
            pose = replace(sample_messages.pose_estimate(1), map_from_base=Pose2(x, 0, 0), state=Localization.GOOD)
            self.views[name].add(topics.POSE, pose, Envelope("mapper", "m", 0, 1), 0.0, 1)
            self.speak(name)

    def speak(self, name: str, state: NavState = NavState.IDLE, task: int = 3, goal: float = 0.0, reason: str = ""):
        self.n += 1
        status = NavStatus(self.n, task, state, "", reason, "", Pose2(goal, 0, 0), 1.0, 1.0, 0, 1, 0)
        self.views[name].add(topics.NAV_STATUS, status, Envelope("navigator", "n", self.n, self.n), self.at, self.n)

    def guard(self, name: str, state: GuardState) -> None:
        self.n += 1
        status = GuardStatus(self.n, state, "", "", "", 0.0)
        self.views[name].add(topics.GUARD, status, Envelope("guard", "g", self.n, self.n), self.at, self.n)

    def base(self, name: str, **fields) -> None:
        self.n += 1
        status = replace(BaseStatus(self.n, 12.0, 0.0, 0.0, True, "", ""), **fields)
        self.views[name].add(topics.BASE_STATUS, status, Envelope("base_driver", "b", self.n, self.n), self.at, self.n)

    def send(self, name, stack, request):
        self.sent.append((name, [pose.x for pose in request.poses]))
        if isinstance(self.answer, UserError):
            raise self.answer
        return self.answer

    def cancel(self, name, stack):
        self.canceled.append(name)


class Fleet:
    """A queue, robots and a dispatcher, whose clocks go on together."""

    def __init__(self, **places: float) -> None:
        self.queue, self.robots, self.said = TaskQueue(":memory:"), Robots(**places), []
        self.start()

    def start(self, **options) -> None:
        """Starts the dispatcher, or another one in its place."""
        self.dispatcher = Dispatcher(self.queue, self.robots, straight, self.said.append, lost_after=LOST_S, **options)

    def step(self, seconds: float = 0.0) -> None:
        self.robots.at += seconds
        self.dispatcher.step(self.robots.views.values(), self.robots.at, self.robots.at)

    def add(self) -> int:
        return self.queue.add("lab", (LAB,), "", self.robots.at)

    @property
    def task(self):
        return self.queue.tasks()[-1]


def test_the_nearest_robot_drives_the_task_and_it_is_done():
    fleet = Fleet(red=9.0, blue=4.0)
    fleet.add()
    fleet.step()
    assert fleet.robots.sent == [("blue", [5.0])]
    assert (fleet.task.state, fleet.task.robot, fleet.task.navigator_id) == (TaskState.DRIVING, "blue", 7)
    fleet.robots.speak("blue", NavState.NAVIGATING, 7, 5.0)
    fleet.step(1.0)
    assert fleet.task.state is TaskState.DRIVING
    fleet.robots.speak("blue", NavState.REACHED, 7, 5.0)
    fleet.step(1.0)
    assert fleet.task.state is TaskState.DONE
    assert len(fleet.robots.sent) == 1


@pytest.mark.parametrize(
    ("end", "task"), [(NavState.FAILED, 7), (NavState.CANCELED, 7), (NavState.NAVIGATING, 8), (NavState.IDLE, 7)]
)
def test_a_task_that_fails_or_is_taken_over_goes_to_another_robot(end, task):
    fleet = Fleet(red=9.0, blue=4.0)
    fleet.add()
    fleet.step()
    fleet.robots.speak("blue", end, task, 5.0, "blocked" if end is NavState.FAILED else "")
    fleet.robots.speak("red")
    fleet.step(1.0)
    assert [name for name, _ in fleet.robots.sent] == ["blue", "red"]
    assert fleet.task.failed == ("blue",)


@pytest.mark.parametrize("trouble", ["silent", "stopped", "fault", "busy", "battery", "lost"])
def test_a_robot_that_cannot_gets_no_task(trouble):
    fleet = Fleet(red=9.0, blue=4.0)
    fleet.start(min_battery=11.0)
    if trouble == "stopped":
        fleet.robots.guard("blue", GuardState.STOPPED)
    elif trouble == "fault":
        fleet.robots.base("blue", fault="wheel_stuck")
    elif trouble == "battery":
        fleet.robots.base("blue", battery=10.0)
    elif trouble == "busy":
        fleet.robots.speak("blue", NavState.EXPLORING)
    elif trouble == "lost":
        pose = replace(sample_messages.pose_estimate(2), state=Localization.LOST)
        fleet.robots.views["blue"].add(topics.POSE, pose, Envelope("mapper", "m", 9, 9), 0.0, 9)
    else:
        fleet.robots.at += 5.0
        fleet.robots.speak("red")
    fleet.add()
    fleet.step()
    assert [name for name, _ in fleet.robots.sent] == ["red"]


@pytest.mark.parametrize("is_silent", [True, False])
def test_a_robot_that_is_silent_or_stopped_for_long_loses_its_task(is_silent):
    fleet = Fleet(red=9.0, blue=4.0)
    fleet.add()
    fleet.step()
    for _ in range(int(LOST_S) - 2):
        if not is_silent:
            fleet.robots.speak("blue", NavState.NAVIGATING, 7, 5.0)
            fleet.robots.guard("blue", GuardState.STOPPED)
        fleet.robots.speak("red")
        fleet.step(1.0)
    assert fleet.task.robot == "blue"
    for _ in range(10):
        fleet.robots.speak("red")
        fleet.step(1.0)
    assert fleet.task.robot == "red"
    assert fleet.robots.canceled == ["blue"]


def test_a_refusal_costs_a_try_and_is_not_repeated_at_once():
    fleet = Fleet(blue=4.0)
    fleet.robots.answer = UserError("the goal is in a wall", "")
    fleet.add()
    for _ in range(5):
        fleet.robots.speak("blue")
        fleet.step(1.0)
    assert len(fleet.robots.sent) == 1
    assert fleet.task.detail == "blue: the goal is in a wall"
    for _ in range(round(3 * RETRY_S)):
        fleet.robots.speak("blue")
        fleet.step(1.0)
    assert fleet.task.state is TaskState.FAILED
    assert len(fleet.robots.sent) == 3


def test_a_robot_that_cannot_be_reached_has_failed_nothing():
    fleet = Fleet(blue=4.0)
    fleet.robots.answer = NoLinkError("no router answers", "")
    fleet.add()
    for _ in range(5):
        fleet.robots.speak("blue")
        fleet.step(1.0)
    assert (fleet.task.state, fleet.task.failed) == (TaskState.WAITING, ())
    assert fleet.task.detail == "blue: no router answers"
    fleet.robots.answer = 7
    fleet.robots.speak("blue")
    fleet.step(1.0)
    assert (fleet.task.state, fleet.task.navigator_id) == (TaskState.DRIVING, 7)


def test_a_task_that_is_canceled_while_its_robot_cannot_be_reached_has_ended():
    fleet = Fleet(blue=4.0)
    number = fleet.add()
    task = fleet.task
    fleet.queue.assign(task, "blue", "0", 3, 0.0)
    fleet.queue.cancel(number, 0.0)
    fleet.queue.unassign(task, "no router answers", 1.0)
    assert fleet.task.state is TaskState.CANCELED


def test_a_stack_that_cannot_be_reached_ends_no_dispatcher(monkeypatch):
    def away(*_):
        raise UserError("no router answers", "start it")

    monkeypatch.setattr(transport, "opened", away)
    with pytest.raises(NoLinkError, match="no router answers"):
        RobotLink().send("blue", "0", navigate([LAB], 0.0, 1))
    RobotLink().cancel("blue", "0")


def test_a_robot_whose_navigator_is_away_was_not_asked(monkeypatch):
    class Away:
        """A link to a router that the robot has just left."""

        def answers(self, request, timeout):
            return False

    monkeypatch.setattr(dispatcher, "Client", lambda *_: nullcontext(Away()))
    with pytest.raises(NoLinkError, match="its navigator is not there"):
        RobotLink().send("blue", "0", navigate([LAB], 0.0, 1))


def test_a_dispatcher_that_was_started_again_goes_on_with_the_task_that_the_robot_drives():
    fleet = Fleet(blue=4.0)
    fleet.robots.answer = None  # the reply never came
    fleet.add()
    fleet.step()
    fleet.start()
    fleet.robots.speak("blue", NavState.NAVIGATING, 4, 5.0)
    fleet.step(1.0)
    assert fleet.task.navigator_id == 4
    fleet.robots.speak("blue", NavState.REACHED, 4, 5.0)
    fleet.step(1.0)
    assert fleet.task.state is TaskState.DONE
    assert len(fleet.robots.sent) == 1


def test_a_task_without_a_reply_that_its_robot_does_not_drive_waits_again():
    fleet = Fleet(blue=4.0)
    fleet.robots.answer = None
    fleet.add()
    fleet.step()
    for _ in range(round(UNCLEAR_S) + 2):
        fleet.robots.speak("blue", NavState.NAVIGATING, 4, goal=-3.0)  # of somebody else
        fleet.step(1.0)
    assert fleet.task.state is TaskState.WAITING


def test_a_canceled_task_is_taken_from_its_robot_again_and_again_until_it_stands():
    fleet = Fleet(blue=4.0)
    number = fleet.add()
    fleet.step()
    fleet.queue.cancel(number, 0.0)
    for _ in range(2):
        fleet.robots.speak("blue", NavState.NAVIGATING, 7, 5.0)
        fleet.step(1.0)
    assert fleet.robots.canceled == ["blue", "blue"]
    fleet.robots.speak("blue", NavState.CANCELED, 7, 5.0)
    fleet.step(1.0)
    assert fleet.task.state is TaskState.CANCELED


def test_with_many_tasks_and_failing_robots_each_task_ends_once():
    draw, fleet = np.random.default_rng(3), Fleet(red=0.0, blue=4.0, green=8.0)
    for i in range(20):
        fleet.queue.add(str(i), ((float(draw.uniform(0, 8)), 0.0, None),), "", 0.0)
    driving: dict[str, int] = {}
    for i in range(4000):
        fleet.robots.answer = 10 + i
        before = len(fleet.robots.sent)
        fleet.step(1.0)
        for name, _ in fleet.robots.sent[before:]:
            assert name not in driving
            driving[name] = fleet.robots.answer
        for name in fleet.robots.views:
            if name not in driving:
                fleet.robots.speak(name, NavState.IDLE, 10 + i)
            elif draw.random() < 0.3:
                end = NavState.FAILED if draw.random() < 0.3 else NavState.REACHED
                fleet.robots.speak(name, end, driving.pop(name), 5.0, "blocked" if end is NavState.FAILED else "")
            else:
                fleet.robots.speak(name, NavState.NAVIGATING, driving[name], 5.0)
        if not fleet.queue.tasks(TaskState.WAITING, TaskState.DRIVING):
            break
    states = [task.state for task in fleet.queue.tasks()]
    assert set(states) <= {TaskState.DONE, TaskState.FAILED}
    assert states.count(TaskState.DONE) > 10
