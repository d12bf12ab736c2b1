# SPDX-License-Identifier: Apache-2.0
"""A queue of integer keys in a ring of buckets (Dial 1969; Denardo & Fox 1979): what a search expands next.

An entry is a number: `nodes`, `keys` and `links` hold what is queued, its key, and the next entry of its bucket; -1
ends a bucket. Entries that were taken out are a chain too. Its first is `free`, -1 without one, and `n_used` says how
many were ever used; both stay with who searches, where they are quick to reach. The arrays are given one by one and all
is inlined: as a tuple they cost a third of a search.
"""

import numpy as np
from numba import njit
from numpy.typing import NDArray

Int32s = NDArray[np.int32]
Int64s = NDArray[np.int64]


@njit(cache=True, nogil=True)
def empty_ring(longest: int) -> Int32s:
    """The first entries of buckets, none yet: as many as keep apart what differs by up to `longest` of them; 2^k."""
    n = 8
    while n < longest + 4:
        n *= 2
    return np.full(n, -1, np.int32)


@njit(cache=True, nogil=True, inline="always")
def pop_entry(slot: int, free: int, heads: Int32s, links: Int32s) -> int:
    """Takes an entry out of a bucket that is not empty; it is the first free one then, as `free` has to say."""
    entry = heads[slot]
    heads[slot] = links[entry]
    links[entry] = free
    return int(entry)


@njit(cache=True, nogil=True, inline="always")
def push_entry(
    slot: int, node: int, key: int, free: int, n_used: int, heads: Int32s, nodes: Int32s, keys: Int64s, links: Int32s
) -> tuple[int, int]:
    """Puts a node into a bucket; `free` and `n_used` then. There must be room."""
    if free >= 0:
        entry = free
        free = links[free]
    else:
        entry = n_used
        n_used += 1
    nodes[entry], keys[entry], links[entry] = node, key, heads[slot]
    heads[slot] = entry
    return free, n_used
