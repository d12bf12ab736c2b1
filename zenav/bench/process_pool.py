# SPDX-License-Identifier: Apache-2.0
"""Calls a function once for each item, in several processes. An interrupt leaves no process behind."""

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import TypeVar

from zenav.stack.process_guard import die_with_parent

A = TypeVar("A")
T = TypeVar("T")


def pool_results(work: Callable[[A], T], items: Sequence[A], jobs: int) -> Iterator[T]:
    """The results as they come; `work` and they go from process to process where there is more than one job."""
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
