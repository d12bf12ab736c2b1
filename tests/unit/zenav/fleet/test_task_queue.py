# SPDX-License-Identifier: Apache-2.0
"""The queue of tasks: it survives its processes, and of two that change a task one wins."""

import multiprocessing
import os
import signal
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared.config import UserError
from zenav.fleet.queue_lock import queue_lock
from zenav.fleet.task_queue import ENDED, MAX_TRIES, TaskQueue, TaskState

LAB = ((1.0, 2.0, 90.0), (3.0, 4.0, None))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "fleet.sqlite"


def test_a_task_is_there_for_the_next_process_as_it_was_given(path):
    with TaskQueue(path) as queue:
        number = queue.add("kitchen -> lab", LAB, "red", 5.0)
    with TaskQueue(path) as queue:
        (task,) = queue.tasks(TaskState.WAITING)
    assert (task.id, task.text, task.targets, task.only_robot, task.added) == (
        number,
        "kitchen -> lab",
        LAB,
        "red",
        5.0,
    )


def _add_until_killed(path: Path) -> None:
    with TaskQueue(path) as queue:
        for i in range(10**6):
            queue.add(str(i), LAB, "", float(i))
            if i == 20:
                os.kill(os.getpid(), signal.SIGKILL)


def test_what_was_added_before_a_kill_is_there_and_the_file_goes_on(path):
    child = multiprocessing.get_context("fork").Process(target=_add_until_killed, args=(path,))
    child.start()
    child.join()
    assert child.exitcode == -signal.SIGKILL
    with TaskQueue(path) as queue:
        assert [task.text for task in queue.tasks()] == [str(i) for i in range(21)]
        assert queue.add("next", LAB, "", 0.0) == 22


@pytest.mark.parametrize("after", ["PRAGMA user_version", "SELECT count(*) FROM sqlite_master"])
def test_two_processes_may_begin_a_queue_at_once(path, monkeypatch, after):
    read, others = TaskQueue._one, []

    def read_and_fall_behind(queue, query):
        answer = read(queue, query)
        if query == after and not others:
            others.append(path)
            with TaskQueue(path) as other:
                other.add("lab", LAB, "", 0.0)
        return answer

    monkeypatch.setattr(TaskQueue, "_one", read_and_fall_behind)
    with TaskQueue(path) as queue:
        assert queue.add("kitchen", LAB, "", 1.0) == 2
        assert [task.text for task in queue.tasks()] == ["lab", "kitchen"]


def test_of_two_that_assign_a_task_one_wins(path):
    with TaskQueue(path) as queue, TaskQueue(path) as other:
        queue.add("lab", LAB, "", 0.0)
        (task,) = queue.tasks()
        assert other.assign(task, "blue", "1", 4, 1.0)
        assert not queue.assign(task, "red", "0", 7, 1.0)
        (task,) = queue.tasks(TaskState.DRIVING)
        assert (task.robot, task.stack, task.former_id, task.navigator_id) == ("blue", "1", 4, None)


def test_a_task_fails_after_as_many_tries_and_names_the_last_cause(path):
    with TaskQueue(path) as queue:
        number = queue.add("lab", LAB, "", 0.0)
        for i in range(MAX_TRIES):
            assert queue.assign(queue.task(number), f"robot{i}", "0", i, 1.0)
            queue.gave_up(queue.task(number), "the way is blocked", 2.0)
        task = queue.task(number)
    assert (task.state, task.detail) == (TaskState.FAILED, f"robot{MAX_TRIES - 1}: the way is blocked")
    assert task.failed == tuple(f"robot{i}" for i in range(MAX_TRIES))


def test_a_canceled_task_that_is_driven_waits_for_its_robot_and_never_for_another(path):
    with TaskQueue(path) as queue:
        number = queue.add("lab", LAB, "", 0.0)
        queue.assign(queue.task(number), "red", "0", 1, 1.0)
        assert queue.cancel(number, 2.0) is TaskState.CANCELING
        queue.accepted(queue.task(number), 9, 3.0)
        assert queue.task(number).state is TaskState.CANCELING
        queue.gave_up(queue.task(number), "canceled", 4.0)
        assert queue.task(number).state is TaskState.CANCELED
        with pytest.raises(UserError, match=f"task {number} is canceled"):
            queue.cancel(number, 5.0)


STEPS = st.lists(st.sampled_from(["assign", "accepted", "done", "gave_up", "cancel"]), max_size=12)


@settings(max_examples=60, deadline=None)
@given(steps=STEPS)
def test_a_task_that_has_ended_stays_so_whatever_comes(steps):
    with TaskQueue(Path(":memory:")) as queue:
        number = queue.add("lab", LAB, "", 0.0)
        ended = None
        for i, step in enumerate(steps):
            task = queue.task(number)
            if step == "assign":
                queue.assign(task, "red", "0", i, float(i))
            elif step == "accepted":
                queue.accepted(task, i, float(i))
            elif step == "cancel" and task.state not in ENDED:
                queue.cancel(number, float(i))
            elif step != "cancel":
                getattr(queue, step)(task, "why", float(i))
            after = queue.task(number).state
            assert ended in (None, after)
            ended = after if after in ENDED else None


def test_a_file_that_is_no_queue_is_an_error_and_stays_as_it_was(path):
    path.write_text("not a queue\n" * 200)
    with pytest.raises(UserError, match="cannot use"):
        TaskQueue(path)
    assert path.read_text() == "not a queue\n" * 200


def test_one_dispatcher_for_a_queue(path):
    with queue_lock(path), pytest.raises(UserError, match="another process"), queue_lock(path):
        pass
    with queue_lock(path):
        pass
