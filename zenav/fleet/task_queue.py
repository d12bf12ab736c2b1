# SPDX-License-Identifier: Apache-2.0
"""The queue of a fleet's tasks: one SQLite file, which survives every process. Times are s of the wall clock.

A task is driven at least once. A dispatcher that ends between a request and its reply sends the task again, unless
the robot drives it (dispatcher.py).
"""

import json
import sqlite3
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from shared.config import UserError
from shared.types import NS_PER_S
from zenav.client.navigation_client import Target

QUEUE_FILE = Path("fleet.sqlite")
VERSION = 1
MAX_TRIES = 3  # robots that fail a task until it is given up
BUSY_S = 5.0  # s that one process waits for another one's writing
SCHEMA = """
CREATE TABLE IF NOT EXISTS task (
  id INTEGER PRIMARY KEY AUTOINCREMENT, text TEXT NOT NULL, targets TEXT NOT NULL, only_robot TEXT NOT NULL,
  state TEXT NOT NULL, robot TEXT NOT NULL, stack TEXT NOT NULL, former_id INTEGER NOT NULL, navigator_id INTEGER,
  failed TEXT NOT NULL, detail TEXT NOT NULL, added REAL NOT NULL, changed REAL NOT NULL
)
"""


class TaskState(StrEnum):
    """State of a task."""

    WAITING = "waiting"
    DRIVING = "driving"
    CANCELING = "canceling"  # its robot has not confirmed it yet
    DONE = "done"
    FAILED = "failed"
    CANCELED = "canceled"


ENDED = (TaskState.DONE, TaskState.FAILED, TaskState.CANCELED)


@dataclass(frozen=True, slots=True)
class FleetTask:
    """A task. text: as it was given.  targets: m, m, degrees or None.  only_robot: the one that must do it, or empty.

    robot, stack: which one drives it.  former_id, navigator_id: number of that robot's navigator task before it was
    sent, and of this one once it is known.  failed: robots that tried.  added, changed: s, wall clock.
    """

    id: int
    text: str
    targets: tuple[Target, ...]
    only_robot: str
    state: TaskState
    robot: str
    stack: str
    former_id: int
    navigator_id: int | None
    failed: tuple[str, ...]
    detail: str
    added: float
    changed: float


class TaskQueue:
    """The file. Several processes may have it open. Raises UserError where it is no queue of this version."""

    def __init__(self, path: Path) -> None:
        self._path = path
        with self._errors():
            self._file = sqlite3.connect(path, timeout=BUSY_S, isolation_level=None)
            # the tables first: another process may make the queue meanwhile
            tables, version = self._one("SELECT count(*) FROM sqlite_master")[0], self._one("PRAGMA user_version")[0]
            if not version and not tables:
                self._file.executescript(f"BEGIN IMMEDIATE; {SCHEMA}; PRAGMA user_version = {VERSION}; COMMIT")
            elif version != VERSION:
                raise UserError(f"{path} is no queue of this version", "name another file: --queue FILE")
            self._file.execute("PRAGMA synchronous = FULL")

    def close(self) -> None:
        """Nothing is lost without it."""
        self._file.close()

    def __enter__(self) -> "TaskQueue":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def add(self, text: str, targets: tuple[Target, ...], only_robot: str, now: float) -> int:
        """Puts a task at the end; its number."""
        with self._errors():
            row = (text, json.dumps(targets), only_robot, TaskState.WAITING, now, now)
            cursor = self._file.execute(
                "INSERT INTO task (text, targets, only_robot, state, robot, stack, former_id, failed, detail, added,"
                " changed) VALUES (?, ?, ?, ?, '', '', 0, '[]', '', ?, ?)",
                row,
            )
            return int(cursor.lastrowid or 0)

    def tasks(self, *states: TaskState) -> list[FleetTask]:
        """The tasks in these states, or all; the oldest first."""
        marks = ", ".join("?" * len(states))
        where = f"WHERE state IN ({marks})" if states else ""
        with self._errors():
            rows = self._file.execute(
                "SELECT id, text, targets, only_robot, state, robot, stack, former_id, navigator_id, failed, detail,"
                f" added, changed FROM task {where} ORDER BY id",
                states,
            ).fetchall()
        return [_task(row) for row in rows]

    def task(self, number: int) -> FleetTask:
        """One task. Raises UserError where there is none of this number."""
        found = [task for task in self.tasks() if task.id == number]
        if not found:
            raise UserError(f"no task {number}", "see them: zenav fleet task list --all")
        return found[0]

    def assign(self, task: FleetTask, robot: str, stack: str, former_id: int, now: float) -> bool:
        """Before a task is sent to a robot. False where it is not waiting any more."""
        return self._change(
            task.id, (TaskState.WAITING,), TaskState.DRIVING, now,
            robot=robot, stack=stack, former_id=former_id, navigator_id=None, detail="",
        )  # fmt: skip

    def accepted(self, task: FleetTask, navigator_id: int, now: float) -> None:
        """The robot accepted it as its task of this number."""
        for state in (TaskState.DRIVING, TaskState.CANCELING):
            self._change(task.id, (state,), state, now, navigator_id=navigator_id)

    def done(self, task: FleetTask, detail: str, now: float) -> None:
        """The robot reached its last target."""
        self._change(task.id, (TaskState.DRIVING, TaskState.CANCELING), TaskState.DONE, now, detail=detail)

    def gave_up(self, task: FleetTask, detail: str, now: float) -> None:
        """The robot did not do it: it waits for another one, or has failed after MAX_TRIES. A canceled task ends."""
        failed = (*task.failed, task.robot)
        state = TaskState.FAILED if len(failed) >= MAX_TRIES else TaskState.WAITING
        columns = {"failed": json.dumps(failed), "detail": f"{task.robot}: {detail}"}
        if not self._change(task.id, (TaskState.CANCELING,), TaskState.CANCELED, now):
            self._change(task.id, (TaskState.DRIVING,), state, now, **columns)

    def unassign(self, task: FleetTask, detail: str, now: float) -> None:
        """The robot never got it: it waits again, and no try is counted. A canceled task ends."""
        if not self._change(task.id, (TaskState.CANCELING,), TaskState.CANCELED, now):
            self._change(task.id, (TaskState.DRIVING,), TaskState.WAITING, now, detail=f"{task.robot}: {detail}")

    def cancel(self, number: int, now: float) -> TaskState:
        """The state after it: `canceling` where a robot drives the task. Raises UserError where it has ended."""
        task = self.task(number)
        if not self._change(number, (TaskState.WAITING,), TaskState.CANCELED, now) and not self._change(
            number, (TaskState.DRIVING, TaskState.CANCELING), TaskState.CANCELING, now
        ):
            raise UserError(f"task {number} is {task.state}", "only a task that waits or is driven can be canceled")
        return self.task(number).state

    def _change(
        self, number: int, before: tuple[TaskState, ...], after: TaskState, now: float, **columns: str | int | None
    ) -> bool:
        """Sets the state and columns where the task is in one of the states `before`: one transaction."""
        sets = ", ".join(f"{name} = ?" for name in ("state", "changed", *columns))
        marks = ", ".join("?" * len(before))
        with self._errors():
            cursor = self._file.execute(
                f"UPDATE task SET {sets} WHERE id = ? AND state IN ({marks})",
                (after, now, *columns.values(), number, *before),
            )
            return cursor.rowcount == 1

    def _one(self, query: str) -> tuple[int, ...]:
        row: tuple[int, ...] = self._file.execute(query).fetchone()
        return row

    @contextmanager
    def _errors(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            raise UserError(f"cannot use {self._path}: {error}", "name another file: --queue FILE") from None


def wall_clock() -> float:
    """s: the time of the queue's entries."""
    return time.time_ns() / NS_PER_S


def _task(row: tuple[object, ...]) -> FleetTask:
    number, text, targets, only_robot, state, robot, stack, former_id, navigator_id, failed, detail, added, changed = (
        row
    )
    return FleetTask(
        id=int(str(number)),
        text=str(text),
        targets=tuple((x, y, yaw) for x, y, yaw in json.loads(str(targets))),
        only_robot=str(only_robot),
        state=TaskState(str(state)),
        robot=str(robot),
        stack=str(stack),
        former_id=int(str(former_id)),
        navigator_id=None if navigator_id is None else int(str(navigator_id)),
        failed=tuple(json.loads(str(failed))),
        detail=str(detail),
        added=float(str(added)),
        changed=float(str(changed)),
    )
