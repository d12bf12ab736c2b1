# SPDX-License-Identifier: Apache-2.0
"""Levenberg-Marquardt on a pose graph, compiled; it releases the GIL, so scans are placed meanwhile."""

from math import cos, pi, sin

import numpy as np
from numba import njit

from services.mapper.back_end.solver.sparse_cholesky import elimination_order, factorize, solve

INITIAL_DAMPING = 1e-5  # as gtsam's
MAX_DAMPING = 1e9


@njit(cache=True, nogil=True)
def levenberg_marquardt(poses, fixed, i, j, relative, information, robust, gate, iterations, tolerance):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    """Returns poses (n, 3) that minimise the sum of chi2 over m edges, or of its Geman-McClure cost; and the steps.

    fixed: (n,) bool, which do not move.  i, j: (m,) int64.  relative: (m, 3) i_from_j.  information: (m, 3, 3).
    robust: (m,) bool, edges with the kernel of squared width `gate`.  iterations: maximum of steps.
    tolerance: relative gain of the cost to stop at.
    Increments are (x, y, yaw) in each node's own frame. Marquardt 1963; the kernel's weights: Yang et al., RA-L 2020.
    """
    n = len(poses)
    variable = np.full(n, -1, np.int64)
    for k in range(len(i)):
        for v in (i[k], j[k]):
            if not fixed[v]:
                variable[v] = 0
    n_free = np.int64(0)  # a literal would compile what it is given to once more
    for v in range(n):
        if variable[v] == 0:
            variable[v] = n_free
            n_free += 1
    both = np.zeros(len(i), np.bool_)
    for k in range(len(i)):
        both[k] = variable[i[k]] >= 0 and variable[j[k]] >= 0
    place, first, rows = elimination_order(n_free, variable[i[both]], variable[j[both]])
    turn = np.full(n, -1, np.int64)
    for v in range(n):
        if variable[v] >= 0:
            turn[v] = place[variable[v]]
    diagonal, below = np.zeros((n_free, 3, 3)), np.zeros((len(rows), 3, 3))
    gradient, step = np.zeros((n_free, 3)), np.zeros((n_free, 3))
    poses, moved = poses.copy(), poses.copy()
    cost, damping = _cost(poses, i, j, relative, information, robust, gate), INITIAL_DAMPING
    n_steps = 0
    while n_steps < iterations:
        _linearize(poses, turn, i, j, relative, information, robust, gate, first, rows, diagonal, below, gradient)
        better = False
        while not better and damping < MAX_DAMPING:
            inverse, lower, definite = factorize(first, rows, diagonal, below, damping)
            if definite:
                step[:] = gradient
                solve(first, rows, inverse, lower, step)
                for v in range(n):
                    if turn[v] >= 0:
                        c, s, (x, y, w) = cos(poses[v, 2]), sin(poses[v, 2]), step[turn[v]]
                        moved[v, 0] = poses[v, 0] - c * x + s * y
                        moved[v, 1] = poses[v, 1] - s * x - c * y
                        moved[v, 2] = (poses[v, 2] - w + pi) % (2 * pi) - pi
                reached = _cost(moved, i, j, relative, information, robust, gate)
                better = reached < cost
            damping *= 0.1 if better else 10.0
        if not better:
            break
        n_steps += 1
        poses[:] = moved
        gain, cost = cost - reached, reached
        if gain < tolerance * cost:
            break
    return poses, n_steps


@njit(cache=True, nogil=True)
def _residual(poses, a, b, measured, out):  # type: ignore[no-untyped-def]  # compiled; out (3,): of measured^-1 @ a_from_b
    c, s = cos(poses[a, 2]), sin(poses[a, 2])
    dx, dy = poses[b, 0] - poses[a, 0], poses[b, 1] - poses[a, 1]
    x, y = c * dx + s * dy - measured[0], c * dy - s * dx - measured[1]
    c, s = cos(measured[2]), sin(measured[2])
    out[0], out[1] = c * x + s * y, c * y - s * x
    out[2] = (poses[b, 2] - poses[a, 2] - measured[2] + pi) % (2 * pi) - pi


@njit(cache=True, nogil=True)
def _cost(poses, i, j, relative, information, robust, gate):  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    total, r = 0.0, np.empty(3)
    for k in range(len(i)):
        _residual(poses, i[k], j[k], relative[k], r)
        chi2 = 0.0
        for a in range(3):
            for b in range(3):
                chi2 += r[a] * information[k, a, b] * r[b]
        total += gate * chi2 / (gate + chi2) if robust[k] else chi2
    return total


@njit(cache=True, nogil=True)
def _linearize(  # type: ignore[no-untyped-def]  # compiled: numba finds the types
    poses, turn, i, j, relative, information, robust, gate, first, rows, diagonal, below, gradient
):
    """Sums J'wJ and J'wr into the blocks of the pattern of `elimination_order`."""
    diagonal[:], below[:], gradient[:] = 0.0, 0.0, 0.0
    r, of_i, of_j = np.empty(3), np.zeros((3, 3)), np.zeros((3, 3))
    weighted, weighted_i, weighted_j = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    for k in range(len(i)):
        a, b = i[k], j[k]
        _residual(poses, a, b, relative[k], r)
        chi2 = 0.0
        for u in range(3):
            for v in range(3):
                chi2 += r[u] * information[k, u, v] * r[v]
        w = (gate / (gate + chi2)) ** 2 if robust[k] else 1.0
        c, s = cos(poses[a, 2]), sin(poses[a, 2])
        dx, dy = poses[b, 0] - poses[a, 0], poses[b, 1] - poses[a, 1]
        x, y = c * dx + s * dy, c * dy - s * dx  # of b, in a's frame
        c, s = cos(relative[k, 2]), sin(relative[k, 2])
        of_i[0, 0], of_i[0, 1], of_i[0, 2] = -c, -s, c * y - s * x
        of_i[1, 0], of_i[1, 1], of_i[1, 2] = s, -c, -s * y - c * x
        of_i[2, 2] = -1.0
        c, s = cos(r[2]), sin(r[2])
        of_j[0, 0], of_j[0, 1], of_j[1, 0], of_j[1, 1], of_j[2, 2] = c, -s, s, c, 1.0
        for u in range(3):
            for v in range(3):
                weighted[u, v] = w * information[k, u, v]
        _multiply(weighted, of_i, weighted_i)
        _multiply(weighted, of_j, weighted_j)
        p, q = turn[a], turn[b]
        if p >= 0:
            _add_product(of_i, weighted_i, diagonal[p])
            _add_gradient(weighted_i, r, gradient[p])
        if q >= 0:
            _add_product(of_j, weighted_j, diagonal[q])
            _add_gradient(weighted_j, r, gradient[q])
        if p >= 0 and q >= 0:
            at = first[min(p, q)] + np.searchsorted(rows[first[min(p, q)] : first[min(p, q) + 1]], max(p, q))
            if p < q:
                _add_product(of_j, weighted_i, below[at])
            else:
                _add_product(of_i, weighted_j, below[at])


@njit(cache=True, nogil=True)
def _multiply(a, b, out):  # type: ignore[no-untyped-def]  # compiled; out = a b, (3, 3)
    for u in range(3):
        for v in range(3):
            out[u, v] = a[u, 0] * b[0, v] + a[u, 1] * b[1, v] + a[u, 2] * b[2, v]


@njit(cache=True, nogil=True)
def _add_product(a, b, out):  # type: ignore[no-untyped-def]  # compiled; out += a' b, (3, 3)
    for u in range(3):
        for v in range(3):
            out[u, v] += a[0, u] * b[0, v] + a[1, u] * b[1, v] + a[2, u] * b[2, v]


@njit(cache=True, nogil=True)
def _add_gradient(a, r, out):  # type: ignore[no-untyped-def]  # compiled; out += a' r
    for u in range(3):
        out[u] += a[0, u] * r[0] + a[1, u] * r[1] + a[2, u] * r[2]
