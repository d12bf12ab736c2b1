# SPDX-License-Identifier: Apache-2.0
"""`zenav goto`, `route`, `explore`, `cancel`, `estop`: a request to the navigator, and its progress for people."""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from math import radians

from shared import requests, topics
from shared.config import UserError, load_robot
from shared.geometry import Pose2, wrapped
from shared.messages import NavState, NavStatus
from shared.reasons import REASONS, reason_text
from shared.requests import Cancel, MapPart, Navigate, Pause, Reply
from shared.runners.stop_confirmation import confirm_stop
from shared.runners.transport import stack_address
from shared.task_state import FINAL_STATES, stop_reason
from zenav.client import Client
from zenav.console.shutdown import stop_on_signal

Target = tuple[float, float, float | None]
"""m, m, degrees or None for any heading."""

MAX_SILENCE_S = 10.0  # s without a status after which the navigator counts as gone
MAX_STACK_WAIT_S = 5.0  # s that a command waits for the service that it asks


@dataclass(frozen=True, slots=True)
class TaskResult:
    """How a task ended: `good` is reached."""

    good: bool
    text: str
    hint: str = ""


def poses_from(texts: list[str]) -> list[Target]:
    """Targets from `X,Y[,YAW]`. Raises UserError on the first that is none."""
    targets: list[Target] = []
    for text in texts:
        parts = text.strip().split(",")
        try:
            numbers = [float(part) for part in parts]
        except ValueError:
            numbers = []
        if len(numbers) not in (2, 3) or not all(abs(n) < 1e6 for n in numbers):
            raise UserError(f"{text.strip()!r} is no pose", "write X,Y or X,Y,YAW: m, m, degrees, like 4,-2,90")
        targets.append((numbers[0], numbers[1], numbers[2] if len(numbers) == 3 else None))
    return targets


@dataclass(frozen=True, slots=True)
class ArrivalTolerance:
    """When a target is reached: within m of it and degrees of its heading, 0 as configured; or at any heading.

    pass_through: only the last target of a route is stopped at, and only its heading counts.
    """

    tolerance: float = 0.0
    heading_tolerance: float = 0.0
    any_heading: bool = False
    pass_through: bool = False


AS_CONFIGURED = ArrivalTolerance()


def navigate(
    targets: list[Target],
    dwell: float,
    loops: int,
    stays: tuple[float, ...] = (),
    arrival: ArrivalTolerance = AS_CONFIGURED,
) -> Navigate:
    """The request for a route, not yet stamped; its headings count where every target has one. Raises UserError.

    dwell: s at each target; stays: s at each where they differ.
    """
    if arrival.pass_through:
        if dwell or any(stays):
            raise UserError("a pose that is passed has no stay", "leave out --pass-through, --dwell or @S")
        heading = targets[-1][2] if targets else None  # the only one that counts
        targets = [(x, y, heading) for x, y, _ in targets]
    if arrival.any_heading:
        if arrival.heading_tolerance:
            raise UserError("any heading has no tolerance", "leave out --any-heading or --heading-tolerance")
        targets = [(x, y, None) for x, y, _ in targets]
    if not targets:
        raise UserError("a route of no poses", "name some: zenav route 1,0 4,-2,90 kitchen")
    if any(abs(n) > 1e6 or n != n for x, y, yaw in targets for n in (x, y, yaw or 0.0)):
        raise UserError("a pose is farther out than any map", "give m, m, degrees")
    mixed = len({yaw is None for _, _, yaw in targets}) > 1
    if mixed:
        raise UserError("some poses have a heading and some have none", "give all of them one, or none")
    poses = tuple(Pose2(x, y, wrapped(radians(yaw or 0.0))) for x, y, yaw in targets)
    if arrival.heading_tolerance and targets[0][2] is None:
        raise UserError("a target without a heading has no tolerance of it", "give it one: X Y YAW")
    request = Navigate(
        stamp=0,
        poses=poses,
        dwell=dwell,
        loops=loops,
        any_heading=targets[0][2] is None,
        dwells=stays,
        tolerance=arrival.tolerance,
        yaw_tolerance=radians(arrival.heading_tolerance),
        pass_through=arrival.pass_through,
    )
    if problem := request.problem():
        raise UserError(problem, "tolerances are m from 0.01 on, and degrees from 0.6 on")
    return request


def drive_route(
    robot: str,
    stack: str,
    targets: list[Target],
    dwell: float = 0.0,
    loops: int = 1,
    stays: tuple[float, ...] = (),
    arrival: ArrivalTolerance = AS_CONFIGURED,
) -> int:
    """Drives through the targets; 0 when the last was reached."""
    request = navigate(targets, dwell, loops, stays, arrival)
    return run_task(
        robot, stack, lambda c: c.ask(requests.NAVIGATE, replace(request, stamp=c.now())), target_text(targets[-1])
    )


def target_text(target: Target) -> str:
    """A target for people."""
    x, y, yaw = target
    return f"({x:.2f}, {y:.2f})" if yaw is None else f"({x:.2f}, {y:.2f}, {yaw:.0f} degrees)"


def cancel(robot: str, stack: str) -> int:
    """Drops the present task."""
    with _connected(robot, stack) as client:
        accepted(client.ask(requests.CANCEL, Cancel(client.now())))
    sys.stdout.write("canceled\n")
    return 0


def request_pause(robot: str, stack: str, pause: bool) -> int:
    """Pauses the present task, or goes on with it."""
    with _connected(robot, stack) as client:
        accepted(client.ask(requests.PAUSE, Pause(client.now(), pause)))
    sys.stdout.write("paused\n" if pause else "going on\n")
    return 0


def estop(robot: str, stack: str, press: bool) -> int:
    """Presses or releases STOP. Raises UserError where the guard does not confirm."""
    with Client(load_robot(robot).robot.name, stack_address(stack)) as client:
        client.follow(topics.GUARD)
        confirm_stop(client, press, "zenav estop")
    sys.stdout.write("STOP is pressed\n" if press else "STOP is released; the robot waits for a new goal\n")
    return 0


def task_result(nav: NavStatus, task_id: int) -> TaskResult | None:
    """How the task ended, or None while it goes on."""
    if nav.task_id > task_id:
        return TaskResult(False, "another task took its place")
    if nav.task_id < task_id:
        return TaskResult(False, "the navigator was started again and forgot the task", "give it again")
    if nav.state is NavState.IDLE:
        return TaskResult(False, f"the task was dropped: {reason_text(nav.reason) or 'no reason given'}")
    if nav.state not in FINAL_STATES:
        return None
    reason = REASONS.get(nav.reason)
    text = reason.text if reason else nav.reason
    if nav.detail and not (reason and nav.detail.startswith(reason.text)):  # a detail that only repeats it
        text += f" ({nav.detail})"
    if nav.state is NavState.REACHED:
        return TaskResult(True, text or "reached")
    return TaskResult(False, text or str(nav.state), reason.hint if reason else "")


def _connected(robot: str, stack: str) -> Client:
    return Client(load_robot(robot).robot.name, stack_address(stack))


def accepted(reply: Reply) -> Reply:
    """The reply. Raises RequestRefusedError where it refuses."""
    if not reply.accepted:
        raise refusal_error(reply)
    return reply


class RequestRefusedError(UserError):
    """A service refused a request; `code` is the reason's."""

    def __init__(self, code: str, what: str, hint: str) -> None:
        super().__init__(what, hint)
        self.code = code


def refusal_error(reply: Reply | MapPart) -> RequestRefusedError:
    """The error of a refusing reply, with its hint."""
    reason = REASONS.get(reply.reason)
    if reason is None:
        return RequestRefusedError(reply.reason, reply.detail or reply.reason or "refused", "see nav/status")
    told_already = reply.detail.startswith(reason.text)
    what = reason.text + (f": {reply.detail}" if reply.detail and not told_already else "")
    return RequestRefusedError(reply.reason, what, reason.hint)


def run_task(robot: str, stack: str, start: Callable[[Client], Reply], where: str = "") -> int:
    """Starts a task, shows its progress and returns the exit status. where: the goal's words for the last line."""
    with stop_on_signal() as stop, _connected(robot, stack) as client:
        client.follow(topics.NAV_STATUS, topics.GUARD)
        client.answers(requests.NAVIGATE, MAX_STACK_WAIT_S)
        begun = time.monotonic()
        task_id = accepted(start(client)).task_id
        end: TaskResult | None = None
        with Progress() as progress:
            while end is None and not stop.is_set():
                nav = client.wait(topics.NAV_STATUS, lambda n: n.task_id != task_id or n.state in FINAL_STATES, 0.2)
                nav = nav or client.latest(topics.NAV_STATUS)
                fresh = client.age(topics.NAV_STATUS) < MAX_SILENCE_S
                if nav is not None and fresh and nav.task_id >= task_id:
                    end = task_result(nav, task_id)
                    progress.show(nav, stop_reason(nav, client.latest(topics.GUARD)))
                elif nav is not None and fresh and time.monotonic() - begun > 2.0:
                    end = task_result(nav, task_id)  # a status from before the reply has been replaced
                elif time.monotonic() - begun > MAX_SILENCE_S and not fresh:
                    end = TaskResult(False, "the navigator is silent", "is it running? zenav topic hz nav/status")
        if end is None:
            accepted(client.ask(requests.CANCEL, Cancel(client.now())))
            end = TaskResult(False, "canceled")
    if not end.good:
        sys.stderr.write(f"{end.text}\n" + (f"hint: {end.hint}\n" if end.hint else ""))
        return 130 if stop.is_set() else 1
    at = f" {where}" if where else ""
    sys.stdout.write(f"{end.text}{at} after {time.monotonic() - begun:.1f} s\n")
    return 0


class Progress:
    """A bar with distance and time left on a terminal; a line every 5 s elsewhere."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, TextColumn
        from rich.progress import Progress as Bar

        self._console = Console(stderr=True)
        self._bar = Bar(
            TextColumn("{task.fields[state]}"), BarColumn(), TextColumn("{task.fields[left]}"),
            TextColumn("[yellow]{task.fields[reason]}"), console=self._console, transient=True,
        )  # fmt: skip
        self._task = self._bar.add_task("", total=None, state="", left="", reason="")
        self._longest = 0.0
        self._told = 0.0

    def __enter__(self) -> "Progress":
        if self._console.is_terminal:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._console.is_terminal:
            self._bar.stop()

    def show(self, nav: NavStatus, reason: str) -> None:
        """Draws the status; `reason` says why the robot stands."""
        left = f"{nav.distance_left:.1f} m, {nav.time_left:.0f} s left"
        if nav.n_waypoints > 1:
            left += f", pose {min(nav.waypoint + 1, nav.n_waypoints)} of {nav.n_waypoints}"
        if not self._console.is_terminal:
            if time.monotonic() - self._told > 5.0:
                self._told = time.monotonic()
                sys.stderr.write(f"{nav.state}: {left}" + (f": {reason}" if reason else "") + "\n")
            return
        self._longest = max(self._longest, nav.distance_left)
        driven = self._longest - nav.distance_left
        total = self._longest or None
        self._bar.update(self._task, state=str(nav.state), left=left, reason=reason, total=total, completed=driven)
