# SPDX-License-Identifier: Apache-2.0
"""Hybrid A*: a forward path for a robot with a turning radius, with its headings at both ends.

Dolgov, Thrun, Montemerlo and Diebel 2010: expansion by arcs, a heuristic without headings, and analytic expansion by
Dubins words (`dubins`). In place of their gradient smoothing, Dubins words between poses of the path shorten it, as
gradients would bend it tighter. All lengths are in cells, as in `ray_cost`.
"""

import heapq
from math import ceil, hypot, inf, pi

import numpy as np
from numba import njit

from services.planner.dubins import N_WORDS, dubins_word, pose_after
from services.planner.ray_cost import BLOCKED, line_cost
from shared.types import Float64s, Int64s, UInt16s

HEURISTIC_CELLS = 4  # cells along a side of the heuristic's blocks
HEURISTIC_SLACK_RADII = 30.0  # detour beyond the start for which the heuristic is computed
N_HEADINGS = 72
MAX_CHORD_CELLS = 1.0  # length of the chords by which arcs are tested
MAX_NODES = 30_000  # then the search gives up
TABLE_SIZE = 1 << 17  # entries of the hash table; under a quarter is used
HASH_MULTIPLIER = (
    0x1E3779B97F4A7C15  # odd number near 2^64 over the golden ratio, without its first bits (Knuth 1998, 6.4)
)
MAX_EXTRA_EXPANSIONS = 2_000  # after the first path was found
SHORTCUT_STEP_CELLS = 2.0  # between the poses from which the path is shortened
HEURISTIC_WEIGHT = 1.1  # weighted A* (Pohl 1970): a value over 1 ends the search early
TURN_PENALTY = 0.03  # share of its cost that an arc of the least radius costs more than a line


def hybrid_astar_path(
    costs: UInt16s, start: Float64s, goal: Float64s, radius: float, any_heading: bool, min_cost: int, spacing: float
) -> Float64s:
    """(n, 3) x, y, yaw from start to goal (3,), at most `spacing` apart; n = 0 without a path. Lengths are in cells.

    costs: as for `GridSearch.cheapest_path`. radius: of the tightest arc. any_heading: the goal's heading does not
    count.
    """
    cost_to_go = _cost_to_go(costs, goal, start, HEURISTIC_SLACK_RADII * radius * min_cost)
    pieces = _search(costs, cost_to_go, start, goal, radius, any_heading, min_cost)
    if not len(pieces):
        return np.empty((0, 3))
    return _sample_poses(start, _shortcut(costs, start, pieces, radius, any_heading, min_cost), spacing)


@njit(cache=True, nogil=True)
def _cost_to_go(costs: UInt16s, goal: Float64s, start: Float64s, max_excess: float) -> Float64s:
    """Cost from each block of HEURISTIC_CELLS x HEURISTIC_CELLS cells to the goal, without headings: (h, w) float64.

    Dijkstra 1959 over the mean cost of a block's free cells; inf beyond `max_excess` more than the cost at the start.
    """
    h, w = -(-costs.shape[0] // HEURISTIC_CELLS), -(-costs.shape[1] // HEURISTIC_CELLS)
    mean = np.zeros((h, w))
    for i in range(h):
        for j in range(w):
            total, n = 0.0, 0
            for row in range(i * HEURISTIC_CELLS, min((i + 1) * HEURISTIC_CELLS, costs.shape[0])):
                for column in range(j * HEURISTIC_CELLS, min((j + 1) * HEURISTIC_CELLS, costs.shape[1])):
                    total += costs[row, column]
                    n += costs[row, column] > 0
            mean[i, j] = total / max(n, 1)
    cost_to_go = np.full((h, w), np.inf)
    first = int(goal[1]) // HEURISTIC_CELLS * w + int(goal[0]) // HEURISTIC_CELLS
    last = int(start[1]) // HEURISTIC_CELLS * w + int(start[0]) // HEURISTIC_CELLS
    cost_to_go[first // w, first % w] = 0.0
    queue = [(0.0, first)]
    max_cost = inf
    while len(queue):
        cost, cell = heapq.heappop(queue)
        if cost > max_cost:
            break
        row, column = cell // w, cell % w
        if cost > cost_to_go[row, column]:
            continue
        if cell == last:
            max_cost = cost + max_excess
        for dr in range(-1, 2):
            for dc in range(-1, 2):
                i, j = row + dr, column + dc
                if not (0 <= i < h and 0 <= j < w) or mean[i, j] == 0.0:
                    continue
                step = HEURISTIC_CELLS * hypot(dr, dc) * 0.5 * (mean[i, j] + mean[row, column])
                there = cost + step
                if there < cost_to_go[i, j]:
                    cost_to_go[i, j] = there
                    heapq.heappush(queue, (there, i * w + j))
    return cost_to_go


@njit(cache=True, nogil=True)
def _piece_cost(costs: UInt16s, pose: Float64s, curvature: float, length: float, out: Float64s) -> float:
    """Cost of a piece from a pose, or BLOCKED; `out` becomes its last pose."""
    n = max(ceil(length / MAX_CHORD_CELLS), 1)
    out[:] = pose
    here = pose.copy()
    total = 0.0
    for _ in range(n):
        here[:] = out
        pose_after(here, curvature, length / n, out)
        cost = line_cost(costs, here[0], here[1], out[0], out[1], np.inf)
        if cost < 0:
            return BLOCKED
        total += cost
    return total


@njit(cache=True, nogil=True)
def _analytic_expansion(
    costs: UInt16s, start: Float64s, end: Float64s, radius: float, any_heading: bool, max_cost: float, min_cost: int,
    pieces: Float64s,
) -> float:  # fmt: skip
    """Cost, under `max_cost`, of the cheapest free Dubins word, which fills pieces (3, 2); or BLOCKED."""
    best = BLOCKED
    tried, out = np.empty((3, 2)), np.empty(3)
    for i in range(N_WORDS):
        if not dubins_word(i, start, end, radius, any_heading, tried):
            continue
        if tried[:, 1].sum() * min_cost >= max_cost:
            continue
        total, here = 0.0, start.copy()
        for k in range(3):
            if tried[k, 1] <= 0.0:
                continue
            cost = _piece_cost(costs, here, tried[k, 0], tried[k, 1], out)
            if cost < 0:
                total = inf
                break
            total += cost * (1.0 + TURN_PENALTY * abs(tried[k, 0]) * radius)
            here[:] = out
        if total < max_cost:
            best = max_cost = total
            pieces[:] = tried
    return best


@njit(cache=True, nogil=True)
def _slot(keys: Int64s, key: int) -> int:
    """Index of a key in the table, or of its free slot: Fibonacci hashing, linear probing (Knuth 1998, 6.4)."""
    slot = (key * HASH_MULTIPLIER >> 40) & (TABLE_SIZE - 1)
    while keys[slot] != -1 and keys[slot] != key:
        slot = (slot + 1) & (TABLE_SIZE - 1)
    return slot


@njit(cache=True, nogil=True)
def _search(
    costs: UInt16s,
    cost_to_go: Float64s,
    start: Float64s,
    goal: Float64s,
    radius: float,
    any_heading: bool,
    min_cost: int,
) -> Float64s:
    """(n, 2) pieces, curvature and length, from the start to the goal; n = 0 without a path."""
    step = min(max(3.0, 0.25 * radius), 6.0)
    side = step / 1.5  # cells: less than a step's share along an axis, so that each step leaves its state
    curvatures = np.array([0.0, 1.0, -1.0, 0.5, -0.5]) / radius
    poses, so_far = np.empty((MAX_NODES, 3)), np.empty(MAX_NODES)
    parents, arrivals = np.empty(MAX_NODES, np.int32), np.empty(MAX_NODES, np.int8)
    keys, nodes = np.full(TABLE_SIZE, -1, np.int64), np.empty(TABLE_SIZE, np.int32)
    poses[0], so_far[0], parents[0] = start, 0.0, -1
    n_nodes, n_more, n_popped = 1, 0, 0
    best, last = inf, -1
    shot, ending, there = np.empty((3, 2)), np.empty((3, 2)), np.empty(3)
    queue = [(0.0, 0)]
    while len(queue):
        total, node = heapq.heappop(queue)
        if total >= best or n_more > MAX_EXTRA_EXPANSIONS:
            break
        pose = poses[node]
        if node and nodes[_slot(keys, _state_key(pose, side, costs.shape[1]))] != node:
            continue  # reached at lower cost since
        n_popped += 1
        n_more += last >= 0
        away = hypot(goal[0] - pose[0], goal[1] - pose[1])
        if n_popped % (2 if away < 2.0 * radius else 10) == 1:
            cost = _analytic_expansion(costs, pose, goal, radius, any_heading, best - so_far[node], min_cost, shot)
            if cost >= 0:
                best, last = so_far[node] + cost, node
                ending[:] = shot
        for k in range(len(curvatures)):
            cost = _piece_cost(costs, pose, curvatures[k], step, there)
            if cost < 0:
                continue
            cost = so_far[node] + cost * (1.0 + TURN_PENALTY * abs(curvatures[k]) * radius)
            left = cost_to_go[int(there[1]) // HEURISTIC_CELLS, int(there[0]) // HEURISTIC_CELLS]
            if cost + left >= best or not left < inf:
                continue
            key = _state_key(there, side, costs.shape[1])
            slot = _slot(keys, key)
            if keys[slot] == key and so_far[nodes[slot]] <= cost:
                continue
            if n_nodes == MAX_NODES:
                queue.clear()
                break
            poses[n_nodes], so_far[n_nodes], parents[n_nodes], arrivals[n_nodes] = there, cost, node, k
            keys[slot], nodes[slot] = key, n_nodes
            heapq.heappush(queue, (cost + HEURISTIC_WEIGHT * left, n_nodes))
            n_nodes += 1
    if last < 0:
        return np.empty((0, 2))
    n, node = 0, last
    while parents[node] >= 0:
        n, node = n + 1, parents[node]
    pieces = np.empty((n + 3, 2))
    pieces[n:] = ending
    node = last
    for k in range(n - 1, -1, -1):
        pieces[k, 0], pieces[k, 1] = curvatures[arrivals[node]], step
        node = parents[node]
    return pieces


@njit(cache=True, nogil=True)
def _state_key(pose: Float64s, side: float, width: int) -> int:
    row, column = int(pose[1] / side), int(pose[0] / side)
    heading = int(pose[2] / (2 * pi) * N_HEADINGS + 0.5 + 64 * N_HEADINGS) % N_HEADINGS  # no path has 64 loops
    return (row * (int(width / side) + 1) + column) * N_HEADINGS + heading


@njit(cache=True, nogil=True)
def _shortcut(
    costs: UInt16s, start: Float64s, pieces: Float64s, radius: float, any_heading: bool, min_cost: int
) -> Float64s:
    """The pieces (n, 2), with cheaper Dubins words in place of the pieces between distant poses."""
    n = 1
    for i in range(len(pieces)):
        n += max(ceil(pieces[i, 1] / SHORTCUT_STEP_CELLS), 0)
    poses, so_far, steps = np.empty((n, 3)), np.zeros(n), np.zeros((n, 2))
    poses[0] = start
    n = 1
    for i in range(len(pieces)):
        parts = max(ceil(pieces[i, 1] / SHORTCUT_STEP_CELLS), 0)
        for _ in range(parts):
            curvature, length = pieces[i, 0], pieces[i, 1] / parts
            cost = _piece_cost(costs, poses[n - 1], curvature, length, poses[n])
            so_far[n] = so_far[n - 1] + max(cost, 0.0) * (1.0 + TURN_PENALTY * abs(curvature) * radius)
            steps[n, 0], steps[n, 1] = curvature, length
            n += 1
    out = np.empty((3 * n, 2))
    n_out, i = 0, 0
    shot, shortcut = np.empty((3, 2)), np.empty((3, 2))
    while i < n - 1:
        good, bad, step, has_shortcut = i + 1, n, 2, False
        while i + step < n:
            k = i + step
            max_cost = (so_far[k] - so_far[i]) * (1 + 1e-9) + 1e-9
            if (
                _analytic_expansion(
                    costs, poses[i], poses[k], radius, any_heading and k == n - 1, max_cost, min_cost, shot
                )
                < 0
            ):
                bad = k
                break
            good, has_shortcut = k, True
            shortcut[:] = shot
            step *= 2
        while bad - good > 1:
            k = (good + bad) // 2
            max_cost = (so_far[k] - so_far[i]) * (1 + 1e-9) + 1e-9
            if (
                _analytic_expansion(
                    costs, poses[i], poses[k], radius, any_heading and k == n - 1, max_cost, min_cost, shot
                )
                < 0
            ):
                bad = k
            else:
                good, has_shortcut = k, True
                shortcut[:] = shot
        for k in range(3 if has_shortcut else 1):
            out[n_out] = shortcut[k] if has_shortcut else steps[i + 1]
            n_out += 1
        i = good
    return out[:n_out]


@njit(cache=True, nogil=True)
def _sample_poses(start: Float64s, pieces: Float64s, spacing: float) -> Float64s:
    """(n, 3) poses at most `spacing` apart along pieces, their ends among them."""
    n = 1
    for i in range(len(pieces)):
        n += max(ceil(pieces[i, 1] / spacing), 0)
    poses = np.empty((n, 3))
    poses[0] = start
    n = 1
    for i in range(len(pieces)):
        parts = max(ceil(pieces[i, 1] / spacing), 0)
        for _ in range(parts):
            pose_after(poses[n - 1], pieces[i, 0], pieces[i, 1] / parts, poses[n])
            n += 1
    return poses
