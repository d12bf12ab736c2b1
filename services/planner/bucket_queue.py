# SPDX-License-Identifier: Apache-2.0
"""A priority queue of integer keys in a ring of buckets (Dial 1969; Denardo and Fox 1979), for the searches.

An entry is an index of `nodes`, `keys` and `links`: node, key, and the next entry of its bucket; -1 ends a bucket.
Removed entries form a chain from `free`, -1 without one. `n_used` counts the entries that were ever used. The caller
holds both. The arrays are separate arguments and all is inlined: as a tuple they cost a third of a search.
"""

import numpy as np
from numba import njit

from shared.types import Int32s, Int64s


@njit(cache=True, nogil=True)
def empty_ring(longest: int) -> Int32s:
    """(2^k,) int32: the first entries of empty buckets, enough for keys that differ by up to `longest` buckets."""
    n = 8
    while n < longest + 4:
        n *= 2
    return np.full(n, -1, np.int32)


@njit(cache=True, nogil=True, inline="always")
def pop_entry(slot: int, free: int, heads: Int32s, links: Int32s) -> int:
    """Removes an entry from the bucket `slot`, which is not empty. The caller sets `free` to it: the first free one.

    heads: the ring of `empty_ring`.  links: (n,) int32, next entries.
    """
    entry = heads[slot]
    heads[slot] = links[entry]
    links[entry] = free
    return int(entry)


@njit(cache=True, nogil=True, inline="always")
def push_entry(
    slot: int, node: int, key: int, free: int, n_used: int, heads: Int32s, nodes: Int32s, keys: Int64s, links: Int32s
) -> tuple[int, int]:
    """Adds a node to the bucket `slot`. Returns the new `free` and `n_used`. There must be room.

    heads: the ring of `empty_ring`.  nodes, keys, links: (n,) int32, int64, int32, of the entries.
    """
    if free >= 0:
        entry = free
        free = links[free]
    else:
        entry = n_used
        n_used += 1
    nodes[entry], keys[entry], links[entry] = node, key, heads[slot]
    heads[slot] = entry
    return free, n_used
