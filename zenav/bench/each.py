# SPDX-License-Identifier: Apache-2.0
"""A function once a seed, some at a time, each in a process of its own; who interrupts it leaves nothing running."""

import multiprocessing
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import TypeVar

from zenav.child import die_with_parent

T = TypeVar("T")


def results(one: Callable[[int], T], seeds: list[int], jobs: int) -> Iterator[T]:
    """The results as they come; `one` and they go from process to process where there is more than one job."""
    if jobs == 1:
        for seed in seeds:
            yield one(seed)
        return
    context = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(min(jobs, len(seeds)), context, die_with_parent, (os.getpid(),))
    try:
        for future in as_completed([pool.submit(one, seed) for seed in seeds]):
            yield future.result()
    finally:  # interrupted: a seed takes minutes, and nobody waits for it any more
        for process in multiprocessing.active_children():
            process.kill()
        pool.shutdown(cancel_futures=True)
