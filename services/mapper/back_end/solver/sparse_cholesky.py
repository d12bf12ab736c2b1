# SPDX-License-Identifier: Apache-2.0
"""Sparse Cholesky factorization of systems with 3 x 3 blocks, as in pose graphs: ordering, factorization, solution."""

from heapq import heapify, heappop, heappush
from math import sqrt

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def elimination_order(n, i, j):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    """Returns an elimination order with little fill-in, and the pattern of the factor.

    n: number of variables.  i, j: (m,) int64, pairs that share a block; duplicates are allowed.
    Returns (place, first, rows).  place: (n,) int64, position of each variable in the order.
    first, rows: int64, column c of the factor has the rows rows[first[c] : first[c + 1]] below the diagonal, ascending.
    Approximate minimum degree on the quotient graph: Amestoy, Davis and Duff, SIAM J. Matrix Anal. Appl. 1996.
    """
    begin, count, near = _adjacency(n, i, j)
    n_elements = np.zeros(n, np.int64)  # of a variable's list: elements come first, then variables
    degree = count.copy()
    heap = [(degree[k], k) for k in range(n)]
    heapify(heap)
    place = np.full(n, -1, np.int64)
    absorbed = np.zeros(n, np.bool_)
    mark = np.full(n, -1, np.int64)
    order, first = np.empty(n, np.int64), np.zeros(n + 1, np.int64)
    start = np.zeros(n, np.int64)  # index of an element's members in `members`
    members = np.empty(max(16, 8 * len(near)), np.int64)
    for turn in range(n):
        d, p = heappop(heap)
        while place[p] >= 0 or d != degree[p]:
            d, p = heappop(heap)
        place[p], order[turn], mark[p] = turn, p, turn
        begun = end = first[turn]
        for q in range(begin[p], begin[p] + count[p]):
            element = q < begin[p] + n_elements[p]
            if element and absorbed[near[q]]:
                continue
            low = start[near[q]] if element else q
            high = first[place[near[q]] + 1] if element else q + 1
            while end + high - low > len(members):
                members = np.concatenate((members, np.empty_like(members)))
            for at in range(low, high):
                v = members[at] if element else near[at]
                if place[v] < 0 and mark[v] != turn:
                    mark[v] = turn
                    members[end] = v
                    end += 1
            if element:
                absorbed[near[q]] = True
        start[p], first[turn + 1] = begun, end
        for at in range(begun, end):
            v = members[at]
            k, n_live, size = begin[v], 0, 0
            for q in range(begin[v], begin[v] + n_elements[v]):
                if not absorbed[near[q]]:
                    near[k] = near[q]
                    size += first[place[near[q]] + 1] - start[near[q]] - 1
                    k += 1
            n_live = k - begin[v]
            rest = begin[v] + n_elements[v]
            stop = begin[v] + count[v]
            # variables of this element are reached through it; the element takes p's own place
            end_kept = k
            for q in range(rest, stop):
                if mark[near[q]] != turn and place[near[q]] < 0:
                    near[end_kept] = near[q]
                    end_kept += 1
            for q in range(end_kept, k, -1):
                near[q] = near[q - 1]
            near[k] = p
            n_elements[v] = n_live + 1
            count[v] = end_kept + 1 - begin[v]
            degree[v] = min(n - turn - 2, size + end_kept - k + end - begun - 1)
            heappush(heap, (degree[v], v))
    rows = place[members[: first[n]]]
    for c in range(n):
        rows[first[c] : first[c + 1]].sort()
    return place, first, rows


@njit(cache=True, nogil=True)
def _adjacency(n, i, j):  # type: ignore[no-untyped-def]  # compiled; -> begin (n,), count (n,), near: lists without duplicates
    begin, count = np.zeros(n + 1, np.int64), np.zeros(n, np.int64)
    for k in range(len(i)):
        begin[i[k] + 1] += 1
        begin[j[k] + 1] += 1
    begin = np.cumsum(begin)
    near, filled = np.empty(2 * len(i), np.int64), begin.copy()
    for k in range(len(i)):
        near[filled[i[k]]] = j[k]
        filled[i[k]] += 1
        near[filled[j[k]]] = i[k]
        filled[j[k]] += 1
    mark = np.full(n, -1, np.int64)
    for v in range(n):
        for q in range(begin[v], begin[v + 1]):
            if mark[near[q]] != v:
                mark[near[q]] = v
                near[begin[v] + count[v]] = near[q]
                count[v] += 1
    return begin, count, near


@njit(cache=True, nogil=True)
def factorize(first, rows, diagonal, below, damping):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    """Returns the factor L of A + damping I: inverted diagonal blocks (n, 3, 3), blocks below, and whether it exists.

    diagonal: (n, 3, 3) of A.  below: (len(rows), 3, 3) of A in the pattern of `elimination_order`, 0 where A has none.
    first, rows: that pattern.
    Left-looking block Cholesky: a column of A less the updates of earlier columns (Davis, Direct Methods, 2006, 4.8).
    """
    n = len(diagonal)
    inverse, lower = np.zeros_like(diagonal), below.copy()
    head, after = np.full(n, -1, np.int64), np.full(n, -1, np.int64)  # columns whose next row is this one
    at = first[:-1].copy()
    where = np.empty(n, np.int64)
    block = np.empty((3, 3))
    for c in range(n):
        for q in range(first[c], first[c + 1]):
            where[rows[q]] = q
        block[:] = diagonal[c]
        for a in range(3):
            block[a, a] += damping
        k = head[c]
        while k >= 0:
            following = after[k]
            q0 = at[k]
            _subtract_product(block, lower[q0], lower[q0])
            b00, b01, b02 = lower[q0, 0, 0], lower[q0, 0, 1], lower[q0, 0, 2]
            b10, b11, b12 = lower[q0, 1, 0], lower[q0, 1, 1], lower[q0, 1, 2]
            b20, b21, b22 = lower[q0, 2, 0], lower[q0, 2, 1], lower[q0, 2, 2]
            for q in range(q0 + 1, first[k + 1]):  # nearly all the time is spent here
                w = where[rows[q]]
                for r in range(3):
                    x, y, z = lower[q, r, 0], lower[q, r, 1], lower[q, r, 2]
                    lower[w, r, 0] -= x * b00 + y * b01 + z * b02
                    lower[w, r, 1] -= x * b10 + y * b11 + z * b12
                    lower[w, r, 2] -= x * b20 + y * b21 + z * b22
            at[k] = q0 + 1
            if at[k] < first[k + 1]:
                after[k] = head[rows[at[k]]]
                head[rows[at[k]]] = k
            k = following
        if not _invert_cholesky(block, inverse[c]):
            return inverse, lower, False
        for q in range(first[c], first[c + 1]):
            _solve_block(lower[q], inverse[c])
        if first[c] < first[c + 1]:
            after[c] = head[rows[first[c]]]
            head[rows[first[c]]] = c
    return inverse, lower, True


@njit(cache=True, nogil=True)
def solve(first, rows, inverse, lower, x):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    """Replaces b by A^-1 b in x (n, 3), by forward and back substitution.

    first, rows: the pattern of `elimination_order`.  inverse, lower: the factor by `factorize`.
    """
    n = len(inverse)
    for c in range(n):
        y0 = inverse[c, 0, 0] * x[c, 0]
        y1 = inverse[c, 1, 0] * x[c, 0] + inverse[c, 1, 1] * x[c, 1]
        y2 = inverse[c, 2, 0] * x[c, 0] + inverse[c, 2, 1] * x[c, 1] + inverse[c, 2, 2] * x[c, 2]
        x[c, 0], x[c, 1], x[c, 2] = y0, y1, y2
        for q in range(first[c], first[c + 1]):
            for a in range(3):
                x[rows[q], a] -= lower[q, a, 0] * y0 + lower[q, a, 1] * y1 + lower[q, a, 2] * y2
    for c in range(n - 1, -1, -1):
        y0, y1, y2 = x[c, 0], x[c, 1], x[c, 2]
        for q in range(first[c], first[c + 1]):
            r = rows[q]
            y0 -= lower[q, 0, 0] * x[r, 0] + lower[q, 1, 0] * x[r, 1] + lower[q, 2, 0] * x[r, 2]
            y1 -= lower[q, 0, 1] * x[r, 0] + lower[q, 1, 1] * x[r, 1] + lower[q, 2, 1] * x[r, 2]
            y2 -= lower[q, 0, 2] * x[r, 0] + lower[q, 1, 2] * x[r, 1] + lower[q, 2, 2] * x[r, 2]
        x[c, 0] = inverse[c, 0, 0] * y0 + inverse[c, 1, 0] * y1 + inverse[c, 2, 0] * y2
        x[c, 1] = inverse[c, 1, 1] * y1 + inverse[c, 2, 1] * y2
        x[c, 2] = inverse[c, 2, 2] * y2


@njit(cache=True, nogil=True)
def _subtract_product(block, a, b):  # type: ignore[no-untyped-def]  # compiled; block -= a b'
    for r in range(3):
        for s in range(3):
            block[r, s] -= a[r, 0] * b[s, 0] + a[r, 1] * b[s, 1] + a[r, 2] * b[s, 2]


@njit(cache=True, nogil=True)
def _solve_block(block, inverse):  # type: ignore[no-untyped-def]  # compiled; block = block L^-T of the diagonal's L
    for r in range(3):
        x, y, z = block[r, 0], block[r, 1], block[r, 2]
        block[r, 0] = x * inverse[0, 0]
        block[r, 1] = x * inverse[1, 0] + y * inverse[1, 1]
        block[r, 2] = x * inverse[2, 0] + y * inverse[2, 1] + z * inverse[2, 2]


@njit(cache=True, nogil=True)
def _invert_cholesky(a, out):  # type: ignore[no-untyped-def]  # compiled; L^-1 of a = L L', False if a is not positive definite
    if not a[0, 0] > 0.0:
        return False
    l00 = sqrt(a[0, 0])
    l10, l20 = a[1, 0] / l00, a[2, 0] / l00
    d = a[1, 1] - l10 * l10
    if not d > 0.0:
        return False
    l11 = sqrt(d)
    l21 = (a[2, 1] - l20 * l10) / l11
    d = a[2, 2] - l20 * l20 - l21 * l21
    if not d > 0.0:
        return False
    l22 = sqrt(d)
    out[0, 0], out[1, 1], out[2, 2] = 1.0 / l00, 1.0 / l11, 1.0 / l22
    out[1, 0] = -l10 / (l00 * l11)
    out[2, 1] = -l21 / (l11 * l22)
    out[2, 0] = (l10 * l21 - l11 * l20) / (l00 * l11 * l22)
    return True
