# SPDX-License-Identifier: Apache-2.0
"""The Python API for programs of users: a robot that is driven by calls that return when they are done."""

import os
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import degrees
from types import TracebackType

import numpy as np

from shared import requests, topics
from shared.config import UserError, load_robot
from shared.grid import OccupancyGrid
from shared.messages import GuardState, NavStatus
from shared.reasons import ESTOP, NO_MAP, POSE_OLD, REASONS
from shared.requests import Cancel, Explore, Reply
from shared.robot_files import own_name_and_kind
from shared.runners.client import Client
from shared.runners.stop_confirmation import confirm_stop
from shared.runners.transport import stack_address
from shared.task_state import FINAL_STATES
from shared.types import Float64s, Int8s
from zenav.client.navigation_client import (
    MAX_SILENCE_S,
    RequestRefusedError,
    Target,
    TaskResult,
    accepted,
    navigate,
    task_result,
)

MAX_FREE = 30
"""Highest value of a cell that counts as free."""
START_S = 30.0  # s that `connect` waits for the stack


@dataclass(frozen=True, slots=True)
class RobotPose:
    """A pose in `map`: x, y (m), yaw (degrees). `state` is good, poor or lost. `stamp`: ns on the stack's clock."""

    x: float
    y: float
    yaw: float
    state: str
    stamp: int


@dataclass(frozen=True, slots=True)
class MapArray:
    """The occupancy grid. cells: (rows, columns) int8, -1 unknown, 0 free .. 100 occupied; row 0 has the lowest y.

    resolution: m a cell. x, y: m in `map`, of the lower left corner of cells[0, 0].
    """

    cells: Int8s
    resolution: float
    x: float
    y: float

    def free_points(self, clearance: float) -> Float64s:
        """(n, 2) x, y, m in `map`: middles of cells with free cells alone within `clearance` m. n may be 0."""
        from scipy.ndimage import distance_transform_edt

        padded = np.pad((self.cells >= 0) & (self.cells <= MAX_FREE), 1)
        distance = distance_transform_edt(padded)[1:-1, 1:-1] * self.resolution
        rows, columns = np.nonzero(distance > clearance + self.resolution / 2)
        return np.column_stack((self.x + (columns + 0.5) * self.resolution, self.y + (rows + 0.5) * self.resolution))


class RobotConnection:
    """A connected robot. Use it as a context: its end closes the session and moves nothing.

    Calls that start a task return when it has ended. All raise `UserError` with a hint where the stack does not answer
    or refuses. Lengths are m, angles degrees.
    """

    def __init__(self, client: Client) -> None:
        self.client = client
        """The session, for topics and requests of all kinds."""

    def __enter__(self) -> "RobotConnection":
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.client.__exit__(kind, error, at)

    def goto(self, x: float, y: float, yaw: float | None = None) -> TaskResult:
        """Drives to a pose in `map` and waits for the end. yaw: degrees; None is any heading."""
        return self.route([(x, y, yaw)])

    def route(self, targets: Sequence[Target], dwell: float = 0.0, loops: int = 1) -> TaskResult:
        """Drives through poses (x, y, yaw or None) and waits for the end.

        dwell: s at each pose.  loops: rounds; 0 is for ever.
        """
        request = navigate(list(targets), dwell, loops)
        return self._task(lambda: self.client.ask(requests.NAVIGATE, replace(request, stamp=self.client.now())))

    def explore(self) -> TaskResult:
        """Explores until no reachable frontier is left, and waits for the end."""
        return self._task(lambda: self.client.ask(requests.EXPLORE, Explore(self.client.now())))

    def cancel(self) -> None:
        """Drops the present task; the robot stands. Another thread may call it."""
        accepted(self.client.ask(requests.CANCEL, Cancel(self.client.now())))

    def estop(self, press: bool = True) -> None:
        """Presses STOP, or releases it, and waits until the guard confirms. A release moves nothing.

        While it is pressed, calls that start a task raise UserError.
        """
        confirm_stop(self.client, press, "zenav.client")

    def pose(self) -> RobotPose:
        """The newest pose on the map. Raises UserError where there is none."""
        estimate = self.client.wait(topics.POSE, lambda _: True, MAX_SILENCE_S)
        if estimate is None:
            raise UserError(POSE_OLD.text, POSE_OLD.hint)
        at = estimate.map_from_base
        return RobotPose(at.x, at.y, degrees(at.yaw), str(estimate.state), estimate.stamp)

    def map(self) -> MapArray:
        """The whole present map. Raises UserError where there is none."""
        update = self.client.latched_value(topics.MAP)
        if update is None:
            raise UserError(NO_MAP.text, NO_MAP.hint)
        grid = OccupancyGrid(update.resolution, update.map_id)
        grid.apply(update)
        return MapArray(grid.cells, grid.resolution, grid.x0, grid.y0)

    def status(self) -> NavStatus | None:
        """The newest status of the navigator, or None."""
        return self.client.latest(topics.NAV_STATUS)

    def on_status(self, callback: Callable[[NavStatus], None]) -> None:
        """Calls back with each status of the navigator, 5 times a second, on another thread."""
        self.client.listen(topics.NAV_STATUS, lambda status, _: callback(status))

    def _task(self, start: Callable[[], Reply]) -> TaskResult:
        guard = self.client.latest(topics.GUARD)
        if guard is not None and guard.state is GuardState.STOPPED:  # the navigator may not have its status yet
            reason = REASONS.get(guard.reason, ESTOP)
            raise RequestRefusedError(reason.code, reason.text, reason.hint)
        task_id = accepted(start()).task_id
        begun = time.monotonic()
        while True:
            nav = self.client.wait(topics.NAV_STATUS, lambda n: n.task_id > task_id or _is_final(n, task_id), 0.2)
            nav = nav or self.client.latest(topics.NAV_STATUS)
            is_fresh = self.client.age(topics.NAV_STATUS) < MAX_SILENCE_S
            is_of_now = nav is not None and (nav.task_id >= task_id or time.monotonic() - begun > 2.0)
            end = task_result(nav, task_id) if nav is not None and is_fresh and is_of_now else None
            if end is not None:
                return end
            if not is_fresh and time.monotonic() - begun > MAX_SILENCE_S:
                raise UserError("the navigator is silent", "is it running? zenav topic hz nav/status")


def _is_final(nav: NavStatus, task_id: int) -> bool:
    return nav.task_id == task_id and nav.state in FINAL_STATES


def connect(robot: str = "", stack: str = "") -> RobotConnection:
    """The robot of a running stack, once its navigator answers and has a map.

    robot: name or YAML file, as for --robot.  stack: number or router, as for --stack. Empty: those of the environment
    variables ZENAV_ROBOT, ZENAV_NAME and ZENAV_STACK, else x80sv and 0. One of several robots of a kind is
    `red@x80sv`. It waits 30 s for the navigator and 30 s for a map, then raises UserError.
    """
    if not robot:
        robot = os.environ.get("ZENAV_ROBOT", "x80sv")  # noqa: TID251  # as the command line does
        if name := os.environ.get("ZENAV_NAME", ""):  # noqa: TID251
            robot = f"{name}@{own_name_and_kind(robot)[1]}"
    stack = stack or os.environ.get("ZENAV_STACK", "0")  # noqa: TID251
    client = Client(load_robot(robot).robot.name, stack_address(stack)).__enter__()
    client.follow(topics.NAV_STATUS, topics.POSE, topics.MAP, topics.GUARD)
    has_navigator = client.answers(requests.NAVIGATE, START_S)
    if not has_navigator or client.wait(topics.MAP, lambda _: True, START_S) is None:
        client.__exit__(None, None, None)
        raise UserError(f"no robot {robot} in stack {stack}", "start it: zenav up; or choose another stack")
    return RobotConnection(client)
