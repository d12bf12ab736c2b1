# SPDX-License-Identifier: Apache-2.0
"""Covariances of keyframes relative to one of them: they bound the search for closures, and select the local map."""

from heapq import heappop, heappush
from math import cos, sin

import numpy as np
from numba import njit

from services.mapper.back_end.pose_graph import Graph
from shared.types import Float64s


def relative_covariances(graph: Graph, node: int) -> Float64s:
    """Returns covariances (n, 3, 3) of the nodes' (x, y, yaw) in the axes of `map`, relative to `node`.

    Each is composed to first order along the path of the smallest determinant (Dijkstra projection: Bosse et al.,
    Atlas, IJRR 2004; Olson 2008). It is an upper bound of the marginal covariance, without solving for it.
    The determinant is invariant to rigid motions (a trace would vary with the lever arm). No edge reduces it
    (Minkowski's inequality). The choice is greedy, so another path may, rarely, be better for a later node. Rejected
    closures are left out. The diagonal is infinite where no path leads. Raises KeyError for an unknown node.
    """
    i, j = graph.rows()
    start = int(np.searchsorted(graph.nodes, node))
    if start == len(graph.nodes) or graph.nodes[start] != node:
        raise KeyError(f"no node {node}")
    on = np.flatnonzero(graph.on)
    return np.asarray(_dijkstra_projection(graph.poses, i[on], j[on], graph.information, on, start))


@njit(cache=True, nogil=True)
def _dijkstra_projection(poses, i, j, information, edge, start):  # type: ignore[no-untyped-def]  # compiled; -> (n, 3, 3)
    n, m = len(poses), len(i)
    first = np.zeros(n + 1, np.int64)  # index into `at` of each node's edges
    for k in range(m):
        first[i[k] + 1] += 1
        first[j[k] + 1] += 1
    first = np.cumsum(first)
    at, filled = np.empty(2 * m, np.int64), first.copy()
    for k in range(m):
        at[filled[i[k]]] = k
        filled[i[k]] += 1
        at[filled[j[k]]] = k
        filled[j[k]] += 1
    out = np.zeros((n, 3, 3))
    best = np.full(n, np.inf)
    done = np.zeros(n, np.bool_)
    best[start] = 0.0
    heap = [(0.0, start)]
    step, longer = np.empty((3, 3)), np.empty((3, 3))
    while heap:
        _, a = heappop(heap)
        if done[a]:
            continue
        done[a] = True
        for q in range(first[a], first[a + 1]):
            k = at[q]
            b = j[k] if i[k] == a else i[k]
            if done[b]:
                continue
            _invert(information[edge[k]], step)
            # an edge's covariance is about its j; traversed from j to i, it applies before the transport
            longer[:] = out[a]
            if j[k] == a:
                longer += step
                step[:] = 0.0
            _transport(poses, a, b, longer)
            longer += step
            size = _determinant(longer)
            if size < best[b]:
                best[b] = size
                out[b] = longer
                heappush(heap, (size, b))
    for b in range(n):
        if done[b]:
            _rotate(poses[b, 2], out[b])
        else:
            out[b, 0, 0] = out[b, 1, 1] = out[b, 2, 2] = np.inf
    return out


@njit(cache=True, nogil=True)
def _transport(poses, a, b, covariance):  # type: ignore[no-untyped-def]  # compiled; (3, 3) in place, from a's frame to b's
    """Ad(b_from_a) C Ad(b_from_a)': a yaw error at a is a lateral error at b."""
    dx, dy = poses[b, 0] - poses[a, 0], poses[b, 1] - poses[a, 1]
    c, s = cos(poses[a, 2]), sin(poses[a, 2])
    x, y = c * dx + s * dy, c * dy - s * dx  # of b, in a's frame
    for r in range(3):
        covariance[r, 0] -= y * covariance[r, 2]
        covariance[r, 1] += x * covariance[r, 2]
    for r in range(3):
        covariance[0, r] -= y * covariance[2, r]
        covariance[1, r] += x * covariance[2, r]
    _rotate(poses[a, 2] - poses[b, 2], covariance)


@njit(cache=True, nogil=True)
def _rotate(yaw, covariance):  # type: ignore[no-untyped-def]  # compiled; (3, 3) in place, rotated by yaw
    c, s = cos(yaw), sin(yaw)
    xx, xy, yy = covariance[0, 0], covariance[0, 1], covariance[1, 1]
    xw, yw = covariance[0, 2], covariance[1, 2]
    covariance[0, 0] = c * c * xx - 2.0 * c * s * xy + s * s * yy
    covariance[1, 1] = s * s * xx + 2.0 * c * s * xy + c * c * yy
    covariance[0, 1] = covariance[1, 0] = c * s * (xx - yy) + (c * c - s * s) * xy
    covariance[0, 2] = covariance[2, 0] = c * xw - s * yw
    covariance[1, 2] = covariance[2, 1] = s * xw + c * yw


@njit(cache=True, nogil=True)
def _determinant(a):  # type: ignore[no-untyped-def]  # compiled; (3, 3) symmetric
    return (
        a[0, 0] * (a[1, 1] * a[2, 2] - a[1, 2] ** 2)
        - a[0, 1] * (a[0, 1] * a[2, 2] - a[1, 2] * a[0, 2])
        + a[0, 2] * (a[0, 1] * a[1, 2] - a[1, 1] * a[0, 2])
    )


@njit(cache=True, nogil=True)
def _invert(a, out):  # type: ignore[no-untyped-def]  # compiled; (3, 3) symmetric, by the adjugate
    det = _determinant(a)
    out[0, 0] = (a[1, 1] * a[2, 2] - a[1, 2] ** 2) / det
    out[1, 1] = (a[0, 0] * a[2, 2] - a[0, 2] ** 2) / det
    out[2, 2] = (a[0, 0] * a[1, 1] - a[0, 1] ** 2) / det
    out[0, 1] = out[1, 0] = (a[0, 2] * a[1, 2] - a[0, 1] * a[2, 2]) / det
    out[0, 2] = out[2, 0] = (a[0, 1] * a[1, 2] - a[0, 2] * a[1, 1]) / det
    out[1, 2] = out[2, 1] = (a[0, 2] * a[0, 1] - a[0, 0] * a[1, 2]) / det
