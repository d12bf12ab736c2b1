# SPDX-License-Identifier: Apache-2.0
"""Calls a function once for each item, on this computer or on a cluster of Dask: docs/batch.md.

Here a few threads wait for child processes, which do the work (child_process.py). On a cluster the threads of Dask's
workers do the same (cluster.py).
"""

import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from itertools import count, islice
from queue import SimpleQueue
from typing import Any, NamedTuple, Protocol, TypeVar

from shared.config import UserError
from zenav.batch.child_process import ChildProcess, Outcome, TryLimits
from zenav.batch.code_hash import code_hash

A = TypeVar("A")

AHEAD = 3  # items for each thread that the queue knows: enough that no thread waits, and memory stays bounded
NO_LIMITS = TryLimits()
MAX_LOSSES = 3  # of a cluster in a row, without a result between them
SAME_VERSION = "install the same version of zenav on all computers of the cluster"

_of_thread = threading.local()
_children: set[ChildProcess] = set()  # of this process
_closing = threading.Event()  # this run ends: no further item begins


class OtherCodeError(Exception):
    """A worker whose zenav is not the one that asks: its results would stand under a wrong key."""


class ClusterLostError(Exception):
    """The scheduler has gone, with what it knew."""


class BatchTask(NamedTuple):
    """What is done with each item. code: the hash of this computer's code."""

    work: Callable[[Any], Any]
    limits: TryLimits
    code: str


class WorkQueue(Protocol):
    """Items in work."""

    def n_threads(self) -> int:
        """How many items at a time; on a cluster this changes. Raises ClusterLostError."""

    def submit(self, number: int, item: Any) -> None:
        """Adds a try of an item; number: by which its outcome comes back. Raises ClusterLostError."""

    def wait(self) -> tuple[int, Outcome]:
        """The next outcome. Raises ClusterLostError, or UserError where a worker does not fit."""


def results(
    work: Callable[[A], Any], items: Iterable[A], jobs: int, cluster: str = "", limits: TryLimits = NO_LIMITS
) -> Iterator[tuple[A, Outcome]]:
    """(item, outcome) as they come; each item comes once, after its last try. The items may be without end.

    work: of a module that the workers have, or a partial of one.   jobs: processes here, if there is no cluster.
    A cluster that is lost is waited for; what was in work there is done again. Raises UserError where it cannot be
    reached, stays lost, or has other code.
    """
    task, left, in_work, numbers = (
        BatchTask(work, limits, code_hash()),
        iter(items),
        dict[int, tuple[A, int]](),
        count(),
    )
    n_losses = 0
    while True:
        try:
            with _queue(task, jobs, cluster, n_losses) as queue:
                for number, (item, _) in in_work.items():
                    queue.submit(number, item)
                while True:
                    room = AHEAD * max(queue.n_threads(), 1) - len(in_work)
                    for item in islice(left, max(room, 0)):  # a cluster that is back may have fewer workers
                        number = next(numbers)
                        in_work[number] = item, 1
                        queue.submit(number, item)
                    if not in_work:
                        return
                    number, outcome = queue.wait()
                    n_losses = 0
                    item, n_tries = in_work[number]
                    if outcome.ending not in ("done", "raised") and n_tries < limits.tries:
                        in_work[number] = item, n_tries + 1
                        queue.submit(number, item)
                        continue
                    del in_work[number]
                    yield item, Outcome(outcome.ending, outcome.value, outcome.detail, n_tries)
        except ClusterLostError:
            n_losses += 1
            if n_losses > MAX_LOSSES:
                what = f"the cluster {cluster} was lost"
                raise UserError(what, "run the same command again: what is done stays done") from None
            sys.stderr.write(f"the cluster {cluster} was lost; what was in work is done again when it is back\n")


def run_in_child(task: BatchTask, item: Any) -> Outcome:
    """One try, in the child process of this thread. Raises OtherCodeError on a worker with other code."""
    if code_hash() != task.code:
        import socket

        raise OtherCodeError(f"the worker on {socket.gethostname()} has other code of zenav than this computer")
    if _closing.is_set():
        return Outcome("died", detail="interrupted")
    child: ChildProcess | None = getattr(_of_thread, "child", None)
    if child is None:
        child = _of_thread.child = ChildProcess()
        _children.add(child)
    return child.run(task.work, item, task.limits)


def _queue(task: BatchTask, jobs: int, cluster: str, n_losses: int) -> AbstractContextManager[WorkQueue]:
    if not cluster:
        return _local_queue(task, jobs)
    from zenav.batch.cluster import cluster_queue

    return cluster_queue(task, cluster, is_awaited=n_losses > 0)


class _LocalQueue:
    """Threads of this process, each with a child process."""

    def __init__(self, task: BatchTask, pool: ThreadPoolExecutor, jobs: int) -> None:
        self._task, self._pool, self._jobs = task, pool, jobs
        self._outcomes = SimpleQueue[tuple[int, Outcome]]()

    def n_threads(self) -> int:
        return self._jobs

    def submit(self, number: int, item: Any) -> None:
        self._pool.submit(self._run, number, item)

    def wait(self) -> tuple[int, Outcome]:
        return self._outcomes.get()

    def _run(self, number: int, item: Any) -> None:
        try:
            outcome = run_in_child(self._task, item)
        except Exception as error:  # no process could be started, an item that cannot be sent
            outcome = Outcome("raised", detail=f"{type(error).__name__}: {error}")
        self._outcomes.put((number, outcome))


@contextmanager
def _local_queue(task: BatchTask, jobs: int) -> Iterator[WorkQueue]:
    _closing.clear()
    pool = ThreadPoolExecutor(jobs, thread_name_prefix="batch")
    try:
        yield _LocalQueue(task, pool, jobs)
    finally:  # an interrupt does not wait for items, which take minutes
        _closing.set()
        for child in list(_children):
            child.close()
        _children.clear()
        pool.shutdown(cancel_futures=True)
