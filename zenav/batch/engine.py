# SPDX-License-Identifier: Apache-2.0
"""Calls a function once for each item, on this computer or on a cluster of Dask: docs/batch.md.

The threads of Dask's workers only watch; each has a child process that does the work (child_process.py).
"""

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import islice
from typing import TYPE_CHECKING, Any, TypeVar

from shared.config import UserError
from zenav.batch.child_process import ChildProcess, Outcome, TryLimits
from zenav.batch.cluster_extra import require_extra
from zenav.batch.code_hash import code_hash

if TYPE_CHECKING:
    from collections.abc import Iterable

    from distributed import Client, Future

A = TypeVar("A")

AHEAD = 3  # items for each thread that the scheduler knows: enough that no thread waits, and memory stays bounded
CONNECT_S = 10.0  # until a scheduler must have answered
NO_LIMITS = TryLimits()
LOOPBACK = "127.0.0.1:0"  # of the pages that a cluster in this process has: None is every network, and port 8787
SAME_VERSION = "install the same version of zenav on all computers of the cluster"

_of_thread = threading.local()
_children: set[ChildProcess] = set()  # of this process: a worker's, or those of the local cluster
_closing = threading.Event()  # the local cluster ends: no further item begins


class OtherCodeError(Exception):
    """A worker whose zenav is not the one that asks: its results would stand under a wrong key."""


def results(
    work: Callable[[A], Any], items: "Iterable[A]", jobs: int, cluster: str = "", limits: TryLimits = NO_LIMITS
) -> Iterator[tuple[A, Outcome]]:
    """(item, outcome) as they come; each item comes once, after its last try. The items may be without end.

    work: of a module that the workers have, or a partial of one.   jobs: processes here, if there is no cluster.
    Raises UserError where the cluster cannot be reached, is lost, or has other code.
    """
    require_extra()
    with _client(jobs, cluster) as client:
        yield from _results(client, work, iter(items), limits, cluster)


def _results(
    client: "Client", work: Callable[[A], Any], items: Iterator[A], limits: TryLimits, cluster: str
) -> Iterator[tuple[A, Outcome]]:
    from distributed import as_completed

    code, tries = code_hash(), dict["Future", tuple[A, int]]()
    finished = as_completed(loop=client.loop)

    def submit(item: A, n_tries: int) -> None:
        future = client.submit(run_in_child, work, item, limits, code, pure=False)
        tries[future] = item, n_tries
        finished.add(future)

    n_threads = sum(client.nthreads().values())
    for item in islice(items, AHEAD * max(n_threads, 1)):
        submit(item, 1)
    for future in finished:
        item, n_tries = tries.pop(future)
        outcome = _outcome_of(future, n_tries, cluster)
        future.release()
        if outcome.ending != "done" and outcome.ending != "raised" and n_tries < limits.tries:
            submit(item, n_tries + 1)
            continue
        for following in islice(items, 1):
            submit(following, 1)
        yield item, outcome


def _outcome_of(future: "Future", n_tries: int, cluster: str) -> Outcome:
    """The outcome of a try. A worker that died with its child is an outcome too."""
    from distributed.scheduler import KilledWorker

    if future.status == "finished":
        done: Outcome = future.result()
        return Outcome(done.ending, done.value, done.detail, n_tries)
    error = future.exception() if future.status == "error" else None
    if isinstance(error, KilledWorker):
        return Outcome("died", detail="the cluster's worker died", n_tries=n_tries)
    if isinstance(error, OtherCodeError):
        raise UserError(str(error), SAME_VERSION)
    if isinstance(error, RuntimeError) and "deserialization" in str(error):  # Dask's words
        raise UserError(f"the scheduler or a worker of {cluster} lacks packages of this computer", SAME_VERSION)
    if error is not None:
        raise error
    raise UserError(f"the cluster {cluster or 'here'} was lost", "run the same command again: what is done stays done")


def run_in_child(work: Callable[[Any], Any], item: Any, limits: TryLimits, code: str) -> Outcome:
    """One try, in the child process of this thread. Runs on a worker. Raises OtherCodeError."""
    if code_hash() != code:
        import socket

        raise OtherCodeError(f"the worker on {socket.gethostname()} has other code of zenav than this computer")
    if _closing.is_set():
        return Outcome("died", detail="interrupted")
    child: ChildProcess | None = getattr(_of_thread, "child", None)
    if child is None:
        child = _of_thread.child = ChildProcess()
        _children.add(child)
    return child.run(work, item, limits)


@contextmanager
def _client(jobs: int, cluster: str) -> "Iterator[Client]":
    """A client of the cluster at an address; or of one inside this process, which has a thread for each job."""
    from distributed import Client, LocalCluster

    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # each lost worker is reported in our words
    if cluster:
        try:
            client = Client(cluster, timeout=CONNECT_S, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            raise UserError(
                f"no scheduler of Dask answers at {cluster}: {type(error).__name__}",
                "start one: dask scheduler, and on each computer: dask worker ADDRESS",
            ) from None
        if not client.nthreads():
            client.close()
            raise UserError(f"the cluster {cluster} has no workers", f"on each computer: dask worker {cluster}")
        try:
            yield client
        finally:
            with suppress(Exception):
                client.close()
        return
    _closing.clear()
    local = LocalCluster(
        n_workers=1, threads_per_worker=jobs, processes=False, memory_limit=0,
        dashboard_address=LOOPBACK, worker_dashboard_address=LOOPBACK,
    )  # fmt: skip
    try:
        with Client(local, set_as_default=False) as client:
            try:
                yield client
            finally:  # an interrupt does not wait for items, which take minutes
                _closing.set()
                for child in list(_children):
                    child.close()
                _children.clear()
    finally:
        local.close()
