# SPDX-License-Identifier: Apache-2.0
"""The C library's heap (glibc): how soon a process gives freed memory back to the system."""

import ctypes
import gc
import mmap

from shared.runners.heap_trim import trim_heap

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_ARENA_MAX = -1, -3, -8  # malloc.h
MAX_HEAP_BLOCK = 2**19  # bytes: a larger block goes back to the system when it is freed
FILLED_BLOCKS = *(2**n for n in range(18, 9, -1)), *range(512, 8, -16)
"""Sizes of the blocks that fill holes, bytes; from 512 on each size that the library has."""


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
    trim_heap()


def fill_holes() -> None:
    """Takes what is free in the middle of the heap, untouched and for good, so that new blocks lie at its end.

    Processes that are forked from here would put their blocks into the holes, between pages that they share. Each would
    have a copy of 12 MB of them. Call it after `release_free_memory`, with one thread.
    """
    library = ctypes.CDLL(None)
    if getattr(library, "malloc_trim", None) is None:
        return
    library.malloc.restype = library.sbrk.restype = ctypes.c_void_p
    library.malloc.argtypes, library.free.argtypes = (ctypes.c_size_t,), (ctypes.c_void_p,)
    library.sbrk.argtypes = (ctypes.c_ssize_t,)
    end = library.sbrk(0) - 2 * mmap.PAGESIZE  # the last block stays free
    for size in FILLED_BLOCKS:
        while (block := library.malloc(size)) is not None and block < end:
            pass
        library.free(block)
