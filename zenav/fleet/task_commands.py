# SPDX-License-Identifier: Apache-2.0
"""`zenav fleet task add`, `list`, `cancel`, and `zenav fleet dispatch`."""

import json
import sys
import time
from dataclasses import asdict
from pathlib import Path

from shared.runners.fleet_listener import FleetListener
from zenav.client.navigation_client import navigate
from zenav.client.places import target_from
from zenav.console.shutdown import stop_on_signal
from zenav.console.table import show_table
from zenav.fleet.assignment import MapWays, straight
from zenav.fleet.dispatcher import Dispatcher, RobotLink
from zenav.fleet.queue_lock import queue_lock
from zenav.fleet.stacks import chosen_stacks
from zenav.fleet.task_queue import ENDED, FleetTask, TaskQueue, TaskState, wall_clock
from zenav.maps.map_files import find_map

LOOK_S = 0.5  # s between two looks at the robots


def add_task(queue: Path, text: str, only_robot: str, map_name: str) -> int:
    """Puts a task into the queue, made of places and poses as `kitchen -> lab` or `1,0 -> 4,-2`; 0."""
    targets = [target_from(part, map_name) for part in text.split("->")]
    navigate(targets, 0.0, 1)  # raises UserError where no robot would take it
    words = " -> ".join(part.strip() for part in text.split("->"))
    with TaskQueue(queue) as tasks:
        number = tasks.add(words, tuple(targets), only_robot, wall_clock())
    sys.stdout.write(f"task {number} waits; robots get it by zenav fleet dispatch\n")
    return 0


def list_tasks(queue: Path, every: bool, as_json: bool) -> int:
    """Shows the tasks that have not ended, or all; 0."""
    with TaskQueue(queue) as tasks:
        rows = [task for task in tasks.tasks() if every or task.state not in ENDED]
    if as_json:
        for task in rows:
            sys.stdout.write(json.dumps(asdict(task)) + "\n")
        return 0
    show_table("", ("task", "what", "state", "robot", "tries", "added", "last cause"), [_cells(task) for task in rows])
    if not rows:
        sys.stderr.write(f"no {'' if every else 'open '}task in {queue}; add one: zenav fleet task add kitchen\n")
    return 0


def cancel_task(queue: Path, number: int) -> int:
    """Cancels a task; the dispatcher takes it from its robot. 0."""
    with TaskQueue(queue) as tasks:
        state = tasks.cancel(number, wall_clock())
    sys.stdout.write(f"task {number} is {state}\n")
    return 0


def dispatch(queue: Path, stacks: list[str], map_name: str, min_battery: float, lost_after: float) -> int:
    """Gives out tasks until Ctrl-C; 0."""
    length = MapWays(find_map(map_name)) if map_name else straight

    def say(line: str) -> None:
        sys.stdout.write(line + "\n")
        sys.stdout.flush()

    with queue_lock(queue), TaskQueue(queue) as tasks, stop_on_signal() as stop:
        dispatcher = Dispatcher(tasks, RobotLink(), length, say, min_battery=min_battery, lost_after=lost_after)
        with FleetListener(chosen_stacks(stacks)) as fleet:
            say(f"gives out the tasks of {queue}: {len(tasks.tasks(TaskState.WAITING))} wait")
            while not stop.is_set():
                views = fleet.hear(LOOK_S)
                dispatcher.step(views, time.monotonic(), wall_clock())
    return 0


def _cells(task: FleetTask) -> tuple[str, ...]:
    added = time.strftime("%Y-%m-%d %H:%M", time.localtime(task.added))
    robot = task.robot or (f"only {task.only_robot}" if task.only_robot else "-")
    return str(task.id), task.text, task.state, robot, str(len(task.failed)), added, task.detail or "-"
