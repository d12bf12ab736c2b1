# SPDX-License-Identifier: Apache-2.0
"""Calls a function once for each item, in several processes or on a cluster. An interrupt leaves no process behind."""

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import TypeVar

from shared.config import UserError
from zenav.batch.engine import results
from zenav.stack.process_guard import die_with_parent

A = TypeVar("A")
T = TypeVar("T")


def pool_results(work: Callable[[A], T], items: Sequence[A], jobs: int, cluster: str = "") -> Iterator[T]:
    """The results as they come; `work` and they go from process to process where there is more than one job.

    cluster: address of a Dask scheduler, in place of processes here. Raises UserError where an item has no result.
    """
    if cluster:
        for item, outcome in results(work, items, jobs, cluster):
            if outcome.ending != "done":
                raise UserError(f"{item}: {outcome.detail}", "see the log of the cluster's workers")
            yield outcome.value
        return
    if jobs == 1:
        for item in items:
            yield work(item)
        return
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(jobs, len(items)), context, die_with_parent, (os.getpid(),))
    try:
        for future in as_completed([pool.submit(work, item) for item in items]):
            yield future.result()
    finally:  # an interrupt does not wait for items, which take minutes
        for process in multiprocessing.active_children():
            process.kill()
        pool.shutdown(cancel_futures=True)
