# SPDX-License-Identifier: Apache-2.0
"""The C library's heap (glibc): how soon a process gives freed memory back to the system."""

import ctypes
import gc

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8  # malloc.h
MAX_HEAP_BLOCK = 2**19  # bytes: a larger block goes back to the system when it is freed


def limit_heap() -> None:
    """Fixes the thresholds of this process and of those that it forks. Without effect on another C library.

    By default the thresholds grow with the largest block that was ever freed. Also each of Zenoh's threads has a heap
    of its own.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        for parameter, value in (
            (M_ARENA_MAX, 1),
            (M_MMAP_THRESHOLD, MAX_HEAP_BLOCK),
            (M_TRIM_THRESHOLD, MAX_HEAP_BLOCK),
        ):
            mallopt(parameter, value)


def release_free_memory() -> None:
    """Gives back what is free, after a phase that needed much more memory than the next one."""
    gc.collect()
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:
        trim(0)
